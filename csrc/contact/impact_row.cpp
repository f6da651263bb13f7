#include "contact/impact_row.hpp"

namespace diffsim {

ImpactRow make_row(
    const Zone& zone, const ZoneContact& contact, const ContactGeometry& geometry, const Placement& at,
    const Coordinates& y_now, double wanted) {
    ImpactRow row;
    row.pair = contact.pair;
    row.stiffness = contact.stiffness.value;
    row.missing = wanted - geometry.distance;
    const auto add_body = [&](int body, const Vec3& point, const Vec3& normal, int& slot, Vec6& out) {
        Vec6 twist;
        twist << (point - at.poses[body].t).cross(normal), normal;
        const Vec6& y = at.y.bodies[body];
        out = chart_jacobian(y).transpose() * twist;
        if (zone.yields(body)) {
            slot = body;
            row.missing += out.dot(y - y_now.bodies[body]);
        } else {
            row.missing -= out.dot(zone.bodies[body].target - y);
        }
    };
    const auto add_cloth = [&](bool of_a, const Vec3& normal) {
        const Surface surface =
            of_a ? surface_a(zone, contact, at.poses, at.nodes) : surface_b(zone, contact, at.poses, at.nodes);
        const Vec3 weights = cloth_side(contact.contact, geometry, surface, of_a).weights;
        const std::array<int, 3> nodes = feature_nodes(zone, contact, of_a);
        for (int k = 0; k < 3; ++k) {
            const int node = nodes[static_cast<std::size_t>(k)];
            if (node < 0 || weights[k] == 0.0) continue;
            const Vec3 part = weights[k] * normal;
            if (zone.nodes[node].pinned) {
                row.missing -= part.dot(zone.nodes[node].target - at.y.nodes[node]);
                continue;
            }
            row.missing += part.dot(at.y.nodes[node] - y_now.nodes[node]);
            row.nodes[static_cast<std::size_t>(row.node_count)] = node;
            row.node_rows[static_cast<std::size_t>(row.node_count)] = part;
            ++row.node_count;
        }
    };
    if (contact.cloth_a >= 0)
        add_cloth(true, geometry.normal);
    else
        add_body(contact.a, geometry.closest.point_a, geometry.normal, row.a, row.row_a);
    if (contact.contact.with_ground()) return row;
    if (contact.cloth_b >= 0)
        add_cloth(false, -geometry.normal);
    else
        add_body(contact.b, geometry.closest.point_b, -geometry.normal, row.b, row.row_b);
    return row;
}

double row_times(const ImpactRow& row, const Coordinates& p) {
    double sum =
        (row.a >= 0 ? row.row_a.dot(p.bodies[row.a]) : 0.0) + (row.b >= 0 ? row.row_b.dot(p.bodies[row.b]) : 0.0);
    for (std::size_t k = 0; k < static_cast<std::size_t>(row.node_count); ++k)
        sum += row.node_rows[k].dot(p.nodes[row.nodes[k]]);
    return sum;
}

void add_row(const ImpactRow& row, double force, Coordinates& sum) {
    if (row.a >= 0) sum.bodies[row.a] += force * row.row_a;
    if (row.b >= 0) sum.bodies[row.b] += force * row.row_b;
    for (std::size_t k = 0; k < static_cast<std::size_t>(row.node_count); ++k)
        sum.nodes[row.nodes[k]] += force * row.node_rows[k];
}

}  // namespace diffsim
