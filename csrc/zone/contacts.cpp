#include "zone/contacts.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <optional>
#include <type_traits>

#include "math/positive_part.hpp"
#include "zone/motion_bounds.hpp"
#include "zone/sides_of.hpp"

namespace diffsim {
namespace {

void sort_unique(IndexPairs& pairs) {
    std::sort(pairs.begin(), pairs.end());
    pairs.erase(std::unique(pairs.begin(), pairs.end()), pairs.end());
}

/// Find the distance of a contact, and add what it pushes with.
template <class A, class B>
void look_at(const Zone& zone, std::size_t k, const ZoneContact& contact, const A& a, const B& b, ZonePoint& point) {
    constexpr bool kBodyOnGround = std::is_same_v<A, SideOfBody> && std::is_same_v<B, SideOfGround>;
    Surface surface;
    if constexpr (kBodyOnGround) {
        const Pose& pose = point.poses[a.body()];
        const double height = pose.R.row(2).dot(a.mesh().vertices[a.feature().index]) + pose.t.z() - zone.ground_height;
        point.distances[k] = height;
        if (!(height < contact.law.range.rest)) return;
        surface = a.surface(point.poses, point.nodes);
    } else {
        surface = a.surface(point);
    }
    // Made where it stays if it is active.
    const ContactGeometry& geometry =
        point.active.emplace_back(static_cast<int>(k), contact.contact, surface, b.surface(point), zone.ground_height)
            .geometry;
    point.distances[k] = geometry.distance;
    if (geometry.distance < contact.law.range.rest)
        point.contact_energy += contact_energy(geometry, contact.law);
    else
        point.active.pop_back();
}

}  // namespace

void ensure_pattern(const Zone& zone, const std::vector<int>& contacts, BlockSystem& system) {
    if (zone.nodes.empty()) return;
    IndexPairs mixed, nodes;
    const auto couple = [&](int i, int j) {
        if (zone.nodes[i].pinned || zone.nodes[j].pinned) return;
        const std::pair<int, int> pair(std::min(i, j), std::max(i, j));
        if (system.find_node_pair(pair.first, pair.second) < 0) nodes.push_back(pair);
    };
    for (int index : contacts) {
        const ZoneContact& contact = zone.contacts[index];
        if (contact.contact.with_ground()) continue;
        std::array<int, 6> touched;
        int count = 0, body = kNobody;
        visit_movers(
            zone, contact, [&](int moved) { body = moved; },
            [&](int node) { touched[static_cast<std::size_t>(count++)] = node; });
        for (int i = 0; i < count; ++i) {
            const int node = touched[static_cast<std::size_t>(i)];
            for (int j = i + 1; j < count; ++j) couple(node, touched[static_cast<std::size_t>(j)]);
            if (zone.yields(body) && !zone.nodes[node].pinned && system.find_mixed_pair(body, node) < 0)
                mixed.emplace_back(body, node);
        }
    }
    if (mixed.empty() && nodes.empty()) return;
    BlockPattern pattern = system.pattern();
    const auto merge = [](IndexPairs& into, IndexPairs& more) {
        sort_unique(more);
        IndexPairs merged;
        merged.reserve(into.size() + more.size());
        std::merge(into.begin(), into.end(), more.begin(), more.end(), std::back_inserter(merged));
        into = std::move(merged);
    };
    merge(pattern.mixed_pairs, mixed);
    merge(pattern.node_pairs, nodes);
    system.set_pattern(std::move(pattern));
}

void evaluate_contacts(const Zone& zone, ZonePoint& point, const ZonePoint* before) {
    point.distances.resize(zone.contacts.size());
    point.active.clear();
    point.contact_energy = 0.0;
    std::optional<MotionBounds> motion;
    if (before != nullptr) motion.emplace(zone, before->y, point.y);
    for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
        const ZoneContact& contact = zone.contacts[k];
        if (motion) {
            const double at_least = before->distances[k] - motion->approach(contact);
            if (at_least > contact.law.range.rest) {
                point.distances[k] = at_least;
                continue;
            }
        }
        with_sides(zone, contact, [&](const auto& a, const auto& b) { look_at(zone, k, contact, a, b, point); });
    }
}

namespace {

/// |L⁻¹ r|² of a body's part r of a row.
double scaled_norm_sq(const ZoneBody& body, const Vec3& turn, const Vec3& shift) {
    return turn.dot(body.inverse_inertia * turn) + shift.squaredNorm() / body.mass;
}

/// Adds up the contacts' derivatives along the bodies' twists and the nodes.
class Assembler {
public:
    Assembler(
        const Zone& zone, const ZonePoint& point, Curvature curvature, CutShare cut, ZoneDerivatives& derivatives,
        BlockSystem* system)
        : m_zone(zone),
          m_point(point),
          m_with_curvature(curvature != Curvature::dropped),
          m_cut(cut),
          m_derivatives(derivatives),
          m_system(system) {}

    void run() {
        for (const ActiveContact& active : m_point.active) add(active.index, active.geometry);
        end();
    }

    /// Contacts that push with forces of their own, instead of the active ones.
    void run(const std::vector<PushingContact>& pushing) {
        for (const PushingContact& contact : pushing) {
            m_own_force = contact.force;
            add(contact.index, *contact.geometry);
        }
        end();
    }

private:
    void end() {
        end_bodies();
        end_ground();
        m_derivatives.largest_force = std::max(m_derivatives.largest_force, std::sqrt(m_force_sq));
        m_derivatives.largest_stiffness = std::max(m_derivatives.largest_stiffness, std::sqrt(m_stiffness_sq));
    }

    void add(int index, const ContactGeometry& geometry) {
        const ZoneContact& contact = m_zone.contacts[index];
        with_placed_sides(m_zone, contact, geometry, m_point.poses, m_point.nodes, [&](const auto& a, const auto& b) {
            add_pair(contact, geometry, a, b);
        });
    }

    void note_scale(double scale_sq, double force, double stiffness) {
        m_force_sq = std::max(m_force_sq, force * force * scale_sq);
        m_stiffness_sq = std::max(m_stiffness_sq, stiffness * stiffness * scale_sq);
    }

    // --- two bodies --------------------------------------------------------------------------------------------

    /// Contacts of the same two bodies follow each other. They are added up along the bodies' relative motion.
    void add_pair(
        const ZoneContact& contact, const ContactGeometry& geometry, const PlacedSide<BodySide>& placed_a,
        const PlacedSide<BodySide>& placed_b) {
        if (placed_a.body != m_a || placed_b.body != m_b) begin_bodies(contact, placed_a.body, placed_b.body);
        const BodySide &a = placed_a.side, &b = placed_b.side;
        const ContactForce<9> d = m_own_force ? add_relative_curvature(geometry, *m_own_force, a, b, m_hessian)
                                              : add_relative_derivatives(
                                                    geometry, contact.law, a, b, m_with_curvature,
                                                    m_system != nullptr ? &m_hessian : nullptr);
        m_gradient += d.gradient;
        const Vec3 shift = d.row.tail<3>();
        if (placed_a.yields)
            note_scale(scaled_norm_sq(m_zone.bodies[m_a], d.row.head<3>(), shift), d.force, d.stiffness);
        if (placed_b.yields)
            note_scale(scaled_norm_sq(m_zone.bodies[m_b], d.row.segment<3>(3), shift), d.force, d.stiffness);
    }

    void begin_bodies(const ZoneContact& contact, int a, int b) {
        end_bodies();
        m_a = a;
        m_b = b;
        m_pair = contact.block;
        m_stiffness = &contact.law.stiffness;
        m_gradient.setZero();
        m_hessian.set_zero();
    }

    void end_bodies() {
        if (m_a == kNobody) return;
        const bool a_yields = m_zone.yields(m_a), b_yields = m_zone.yields(m_b);
        const Vector<12> gradient = both_twists(m_gradient);
        if (a_yields) m_derivatives.gradient.bodies[m_a] += gradient.head<6>();
        if (b_yields) m_derivatives.gradient.bodies[m_b] += gradient.tail<6>();
        m_derivatives.pair_sums.push_back({m_a, m_b, *m_stiffness, gradient});
        if (m_system != nullptr) {
            Square<9> relative = m_hessian.whole();
            if (a_yields && b_yields) cut_negative_part<9>(m_cut, relative);
            const Square<12> hessian = both_twists(relative);
            if (a_yields) add_diagonal(m_a, hessian.topLeftCorner<6, 6>(), a_yields && b_yields);
            if (b_yields) add_diagonal(m_b, hessian.bottomRightCorner<6, 6>(), a_yields && b_yields);
            if (a_yields && b_yields) {
                if (m_a < m_b)
                    m_system->off_diagonal(m_pair) += hessian.topRightCorner<6, 6>();
                else
                    m_system->off_diagonal(m_pair) += hessian.bottomLeftCorner<6, 6>();
            }
        }
        m_a = m_b = kNobody;
    }

    void add_diagonal(int body, Mat6 block, bool is_cut) {
        if (!is_cut) cut_negative_part<6>(m_cut, block);
        m_system->diagonal(body) += block;
    }

    // --- cloth -------------------------------------------------------------------------------------------------

    static bool yields(const PlacedSide<BodySide>& place) { return place.yields; }
    static bool yields(const PlacedSide<ClothSide>&) { return true; }

    void add_gradient(
        const PlacedSide<BodySide>& place, const Vec6& row, const Vec6& gradient, double force, double stiffness) {
        m_derivatives.gradient.bodies[place.body] += gradient;
        note_scale(scaled_norm_sq(m_zone.bodies[place.body], row.head<3>(), row.tail<3>()), force, stiffness);
    }
    void add_gradient(
        const PlacedSide<ClothSide>& place, const Vector<9>& row, const Vector<9>& gradient, double force,
        double stiffness) {
        for (int k = 0; k < 3; ++k) {
            const int node = place.nodes[k];
            if (node < 0 || m_zone.nodes[node].pinned) continue;
            m_derivatives.gradient.nodes[node] += gradient.segment<3>(3 * k);
            note_scale(row.segment<3>(3 * k).squaredNorm() / m_zone.nodes[node].mass, force, stiffness);
        }
    }

    void add_block(const PlacedSide<BodySide>& place, const Mat6& block) { m_system->diagonal(place.body) += block; }
    void add_block(const PlacedSide<ClothSide>& place, const Square<9>& block) {
        for (int r = 0; r < 3; ++r)
            for (int c = r; c < 3; ++c)
                if (place.nodes[r] >= 0 && place.nodes[c] >= 0)
                    add_node_block(m_zone, place.nodes[r], place.nodes[c], block.block<3, 3>(3 * r, 3 * c), *m_system);
    }
    void add_cross(
        const PlacedSide<BodySide>& a, const PlacedSide<ClothSide>& b, const Eigen::Matrix<double, 6, 9>& block) {
        for (int k = 0; k < 3; ++k)
            if (b.nodes[k] >= 0 && !m_zone.nodes[b.nodes[k]].pinned)
                m_system->mixed_pair(m_system->find_mixed_pair(a.body, b.nodes[k])) += block.middleCols<3>(3 * k);
    }
    void add_cross(const PlacedSide<ClothSide>& a, const PlacedSide<ClothSide>& b, const Square<9>& block) {
        for (int r = 0; r < 3; ++r)
            for (int c = 0; c < 3; ++c)
                if (a.nodes[r] >= 0 && b.nodes[c] >= 0)
                    add_node_block(m_zone, a.nodes[r], b.nodes[c], block.block<3, 3>(3 * r, 3 * c), *m_system);
    }

    template <class A>
    void add_pair(
        const ZoneContact& contact, const ContactGeometry& geometry, const A& a, const PlacedSide<ClothSide>& b) {
        constexpr int kA = decltype(a.side)::kSize, kB = ClothSide::kSize;
        ContactDerivatives<kA + kB> d =
            m_own_force
                ? contact_curvature(geometry, *m_own_force, a.side, b.side)
                : contact_derivatives(geometry, contact.law, a.side, b.side, m_system != nullptr, m_with_curvature);
        if (yields(a)) add_gradient(a, d.row.template head<kA>(), d.gradient.template head<kA>(), d.force, d.stiffness);
        add_gradient(b, d.row.template tail<kB>(), d.gradient.template tail<kB>(), d.force, d.stiffness);
        if (m_system == nullptr) return;
        if (yields(a)) {
            cut_negative_part<kA + kB>(m_cut, d.hessian);
            add_block(a, d.hessian.template topLeftCorner<kA, kA>());
            add_block(b, d.hessian.template bottomRightCorner<kB, kB>());
            add_cross(a, b, d.hessian.template topRightCorner<kA, kB>());
        } else {
            Square<kB> hessian = d.hessian.template bottomRightCorner<kB, kB>();
            cut_negative_part<kB>(m_cut, hessian);
            add_block(b, hessian);
        }
    }

    // --- ground ------------------------------------------------------------------------------------------------

    void add_pair(
        const ZoneContact& contact, const ContactGeometry& geometry, const PlacedSide<BodySide>& a,
        const PlacedSide<GroundSide>&) {
        if (a.body != m_on_ground) {
            end_ground();
            m_on_ground = a.body;
            m_ground = {};
            m_ground_stiffness = &contact.law.stiffness;
        }
        const Vec3 arm = geometry.closest.a.point - a.side.center;
        if (m_own_force) return m_ground.add_force(*m_own_force, arm);
        const PotentialValue d = m_ground.add(geometry.distance, arm, contact.law);
        const ZoneBody& body = m_zone.bodies[a.body];
        const Vec3 turn = GroundSums::row(arm).head<3>();
        note_scale(turn.dot(body.inverse_inertia * turn) + 1.0 / body.mass, d.force, d.stiffness);
    }

    void end_ground() {
        if (m_on_ground == kNobody) return;
        Vector<12> gradient = Vector<12>::Zero();
        gradient.head<6>() = m_ground.gradient();
        m_derivatives.gradient.bodies[m_on_ground] += gradient.head<6>();
        m_derivatives.pair_sums.push_back({m_on_ground, kGround, *m_ground_stiffness, gradient});
        if (m_system != nullptr) {
            Mat6 hessian = m_ground.hessian(m_with_curvature);
            cut_negative_part<6>(m_cut, hessian);
            m_system->diagonal(m_on_ground) += hessian;
        }
        m_on_ground = kNobody;
    }

    void add_pair(
        const ZoneContact& contact, const ContactGeometry& geometry, const PlacedSide<ClothSide>& a,
        const PlacedSide<GroundSide>&) {
        if (m_own_force) return;  // it has no curvature
        const int node = a.nodes[0];
        if (m_zone.nodes[node].pinned) return;
        const PotentialValue potential = normal_force(contact.law, geometry.distance);
        m_derivatives.gradient.nodes[node].z() -= potential.force;
        note_scale(1.0 / m_zone.nodes[node].mass, potential.force, potential.stiffness);
        if (m_system != nullptr) m_system->node_diagonal(node)(2, 2) += potential.stiffness;
    }

    const Zone& m_zone;
    const ZonePoint& m_point;
    bool m_with_curvature;
    CutShare m_cut;
    ZoneDerivatives& m_derivatives;
    BlockSystem* m_system;
    std::optional<double> m_own_force;              // of the contact at hand
    double m_force_sq = 0.0, m_stiffness_sq = 0.0;  // largest so far
    int m_a = kNobody, m_b = kNobody, m_pair = -1;  // the two bodies at hand
    Vector<9> m_gradient;
    HalfSymmetric<9> m_hessian;
    const ContactStiffness* m_stiffness = nullptr;
    int m_on_ground = kNobody;  // the body at hand there
    GroundSums m_ground;
    const ContactStiffness* m_ground_stiffness = nullptr;
};

}  // namespace

void add_contact_derivatives(
    const Zone& zone, const ZonePoint& point, Curvature curvature, CutShare cut, ZoneDerivatives& derivatives,
    BlockSystem* system) {
    Assembler(zone, point, curvature, cut, derivatives, system).run();
}

void add_contact_curvature(
    const Zone& zone, const ZonePoint& point, const std::vector<PushingContact>& pushing, CutShare cut,
    ZoneDerivatives& derivatives, BlockSystem& system) {
    Assembler(zone, point, Curvature::full, cut, derivatives, &system).run(pushing);
}

double contact_force_sum(const Zone& zone, const ZonePoint& point, std::vector<double>& pushed) {
    // The errors of one body's contacts may all add up. Those of different bodies are independent: their sum grows
    // with the root of their number.
    double force_sum = 0.0;
    pushed.assign(static_cast<std::size_t>(zone.dynamic_count), 0.0);
    for (const ActiveContact& active : point.active) {
        if (active.geometry.sine_sq == 0.0) continue;  // parallel edges push nothing
        const ZoneContact& contact = zone.contacts[active.index];
        const double force = normal_force(contact.law, active.geometry.distance).force;
        bool on_body = false;
        visit_movers(
            zone, contact,
            [&](int body) {
                if (!zone.yields(body)) return;
                pushed[body] += force;
                on_body = true;
            },
            [](int) {});
        if (!on_body) force_sum += force;
    }
    double square_sum = 0.0;
    for (double force : pushed) square_sum += force * force;
    return force_sum + std::sqrt(square_sum);
}

}  // namespace diffsim
