#include "zone/friction_row.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <type_traits>

#include "math/rotation.hpp"
#include "zone/sides_of.hpp"

namespace diffsim {

void FrictionRow::set_state(const FrictionState& state) {
    for (int k = 0; k < 2; ++k) {
        share[k] = tangents[static_cast<std::size_t>(k)].dot(state.share);
        multiplier[k] = tangents[static_cast<std::size_t>(k)].dot(state.multiplier);
    }
    slips = state.slips;
    is_known = state.is_known;
    // The normal has turned since.
    if (slips && share.squaredNorm() > 0.0) share.normalize();
}

FrictionState FrictionRow::state() const {
    FrictionState state;
    state.share = share[0] * tangents[0] + share[1] * tangents[1];
    state.slips = slips;
    state.multiplier = multiplier[0] * tangents[0] + multiplier[1] * tangents[1];
    state.is_known = true;
    return state;
}

FrictionRow make_friction_row(
    const Zone& zone, const ZoneContact& contact, const ContactGeometry& geometry, const Placement& at,
    const Coordinates& y_now) {
    const FrictionFrame frame = friction_frame(geometry, contact.law);
    FrictionRow row;
    row.coefficient = contact.law.friction;
    row.tangents = frame.tangents;
    for (std::size_t k = 0; k < 2; ++k) {
        row.relative[k].setZero();
        row.relative[k].tail<3>() = -frame.tangents[k];
    }
    Vec3 slip = Vec3::Zero();  // where the rows are made
    const auto add_body = [&](const SideOfBody& side, double sign, int turn) {
        const int body = side.body();
        const Vec6& y = at.y.bodies[body];
        const Vec6& moved = side.yields() ? y : zone.bodies[body].target;
        const Vec3 arm = frame.point - at.poses[body].t;
        slip += sign * (moved.tail<3>() + moved.head<3>().cross(arm));
        if (!side.yields()) return;
        const Mat3 J = left_jacobian(y.head<3>());
        for (std::size_t k = 0; k < 2; ++k) {
            Vec6 out;
            out << J.transpose() * arm.cross(frame.tangents[k]), frame.tangents[k];
            out *= sign;
            row.relative[k].segment<3>(turn) = out.head<3>();
            row.slip[static_cast<int>(k)] -= out.dot(y - y_now.bodies[body]);
        }
    };
    const auto add_cloth = [&](const SideOfCloth& side, const ClosestPoint& closest, double sign) {
        const PlacedSide<ClothSide> placed = placed_side(side, closest, geometry.normal, at.poses, at.nodes);
        for (int n = 0; n < 3; ++n) {
            const int node = placed.nodes[static_cast<std::size_t>(n)];
            const double weight = sign * placed.side.weights[n];
            if (node < 0 || weight == 0.0) continue;
            if (zone.nodes[node].pinned) {
                slip += weight * zone.nodes[node].target;
                continue;
            }
            slip += weight * at.y.nodes[node];
            row.node_weights.push_back(weight);
            for (std::size_t k = 0; k < 2; ++k)
                row.slip[static_cast<int>(k)] -= weight * frame.tangents[k].dot(at.y.nodes[node] - y_now.nodes[node]);
        }
    };
    const auto add = [&](const auto& side, const ClosestPoint& closest, double sign, int turn) {
        using Side = std::decay_t<decltype(side)>;
        if constexpr (std::is_same_v<Side, SideOfBody>) add_body(side, sign, turn);
        if constexpr (std::is_same_v<Side, SideOfCloth>) add_cloth(side, closest, sign);
    };
    with_sides(zone, contact, [&](const auto& a, const auto& b) {
        add(a, geometry.closest.a, 1.0, 0);
        add(b, geometry.closest.b, -1.0, 3);
    });
    for (std::size_t k = 0; k < 2; ++k) row.slip[static_cast<int>(k)] += frame.tangents[k].dot(slip);
    return row;
}

void slips_times(
    const std::vector<FrictionRow>& friction, const std::vector<ContactRow>& rows, const Coordinates& p,
    std::vector<Vec2>& products) {
    products.resize(friction.size());
    int a = -2, b = -2;
    Vector<9> motion = Vector<9>::Zero();
    for (std::size_t f = 0; f < friction.size(); ++f) {
        const FrictionRow& slip = friction[f];
        const ContactRow& row = rows[slip.normal];
        if (row.a != a || row.b != b) {
            a = row.a;
            b = row.b;
            motion = relative_motion(row, p);
        }
        Vec3 of_nodes = Vec3::Zero();
        for (std::size_t n = 0; n < row.nodes.size(); ++n) of_nodes += slip.node_weights[n] * p.nodes[row.nodes[n]];
        for (std::size_t k = 0; k < 2; ++k)
            products[f][static_cast<int>(k)] = slip.relative[k].dot(motion) + slip.tangents[k].dot(of_nodes);
    }
}

void add_friction(const FrictionRow& friction, const ContactRow& row, const Vec2& force, Coordinates& sum) {
    if (row.a >= 0 || row.b >= 0) {
        const Vector<12> twists =
            both_twists(Vector<9>(force[0] * friction.relative[0] + force[1] * friction.relative[1]));
        if (row.a >= 0) sum.bodies[row.a] += twists.head<6>();
        if (row.b >= 0) sum.bodies[row.b] += twists.tail<6>();
    }
    if (row.nodes.empty()) return;
    const Vec3 along = force[0] * friction.tangents[0] + force[1] * friction.tangents[1];
    for (std::size_t n = 0; n < row.nodes.size(); ++n) sum.nodes[row.nodes[n]] += friction.node_weights[n] * along;
}

void add_friction_node_stiffness(
    const FrictionRow& friction, const ContactRow& row, const Vec2& direction, double stiffness, BlockSystem& system) {
    const Vec3 along = direction[0] * friction.tangents[0] + direction[1] * friction.tangents[1];
    const Mat3 square = stiffness * along * along.transpose();
    Mat63 of_body = Mat63::Zero();
    if (row.a >= 0)
        of_body = both_twists(relative_along(friction, direction)).head<6>() * (stiffness * along).transpose();
    for (std::size_t k = 0; k < row.nodes.size(); ++k) {
        const int node = row.nodes[k];
        if (row.a >= 0) system.mixed_pair(system.find_mixed_pair(row.a, node)) += friction.node_weights[k] * of_body;
        for (std::size_t l = k; l < row.nodes.size(); ++l) {
            const int other = row.nodes[l];
            const Mat3 block = (friction.node_weights[k] * friction.node_weights[l]) * square;
            if (node == other)
                system.node_diagonal(node) += block;
            else
                system.node_pair(system.find_node_pair(std::min(node, other), std::max(node, other))) += block;
        }
    }
}

}  // namespace diffsim
