#include "zone/contact_row.hpp"

#include <Eigen/Geometry>
#include <type_traits>

#include "math/rotation.hpp"
#include "zone/sides_of.hpp"

namespace diffsim {

ContactRow make_row(
    const Zone& zone, const ZoneContact& contact, const ContactGeometry& geometry, const Placement& at,
    const Coordinates& y_now, double wanted) {
    ContactRow row;
    row.pair = contact.block;
    row.stiffness = contact.law.stiffness.value;
    row.missing = wanted - geometry.distance;
    row.relative.tail<3>() = -geometry.normal;
    const auto add_body = [&](const SideOfBody& side, const Vec3& point, const Vec3& normal, int& slot, int turn) {
        const int body = side.body();
        const Vec6& y = at.y.bodies[body];
        Vec6 out;
        out << left_jacobian(y.head<3>()).transpose() * (point - at.poses[body].t).cross(normal), normal;
        if (side.yields()) {
            row.relative.segment<3>(turn) = out.head<3>();
            slot = body;
            row.missing += out.dot(y - y_now.bodies[body]);
        } else {
            row.missing -= out.dot(zone.bodies[body].target - y);
        }
    };
    const auto add_cloth = [&](const SideOfCloth& side, const ClosestPoint& closest, const Vec3& normal) {
        const PlacedSide<ClothSide> placed = placed_side(side, closest, geometry.normal, at.poses, at.nodes);
        for (int k = 0; k < 3; ++k) {
            const int node = placed.nodes[static_cast<std::size_t>(k)];
            const double weight = placed.side.weights[k];
            if (node < 0 || weight == 0.0) continue;
            const Vec3 part = weight * normal;
            if (zone.nodes[node].pinned) {
                row.missing -= part.dot(zone.nodes[node].target - at.y.nodes[node]);
                continue;
            }
            row.missing += part.dot(at.y.nodes[node] - y_now.nodes[node]);
            row.nodes.push_back(node);
            row.node_rows.push_back(part);
        }
    };
    const auto add = [&](const auto& side, const ClosestPoint& closest, const Vec3& normal, int& slot, int turn) {
        using Side = std::decay_t<decltype(side)>;
        if constexpr (std::is_same_v<Side, SideOfBody>) add_body(side, closest.point, normal, slot, turn);
        if constexpr (std::is_same_v<Side, SideOfCloth>) add_cloth(side, closest, normal);
    };
    with_sides(zone, contact, [&](const auto& a, const auto& b) {
        add(a, geometry.closest.a, geometry.normal, row.a, 0);
        add(b, geometry.closest.b, -geometry.normal, row.b, 3);
    });
    return row;
}

Vector<9> relative_motion(const ContactRow& row, const Coordinates& p) {
    Vector<9> motion = Vector<9>::Zero();
    if (row.a >= 0) {
        motion.head<3>() = p.bodies[row.a].head<3>();
        motion.tail<3>() = -p.bodies[row.a].tail<3>();
    }
    if (row.b >= 0) {
        motion.segment<3>(3) = p.bodies[row.b].head<3>();
        motion.tail<3>() += p.bodies[row.b].tail<3>();
    }
    return motion;
}

namespace {

double row_times(const ContactRow& row, const Vector<9>& motion, const Coordinates& p) {
    double sum = row.relative.dot(motion);
    for (std::size_t k = 0; k < row.nodes.size(); ++k) sum += row.node_rows[k].dot(p.nodes[row.nodes[k]]);
    return sum;
}

}  // namespace

double row_times(const ContactRow& row, const Coordinates& p) { return row_times(row, relative_motion(row, p), p); }

void rows_times(const std::vector<ContactRow>& rows, const Coordinates& p, std::vector<double>& products) {
    products.resize(rows.size());
    visit_runs(rows, [&](std::size_t first, std::size_t last) {
        const Vector<9> motion = relative_motion(rows[first], p);
        for (std::size_t r = first; r < last; ++r) products[r] = row_times(rows[r], motion, p);
    });
}

void add_row(const ContactRow& row, double force, Coordinates& sum) {
    if (row.a >= 0) sum.bodies[row.a] += force * row.row_a();
    if (row.b >= 0) sum.bodies[row.b] += force * row.row_b();
    for (std::size_t k = 0; k < row.nodes.size(); ++k) sum.nodes[row.nodes[k]] += force * row.node_rows[k];
}

}  // namespace diffsim
