#include "zone/friction_term.hpp"

#include <cmath>

#include "fixtures.hpp"
#include "math/rotation.hpp"
#include "solve/zone_solver.hpp"
#include "zone/zone_contacts.hpp"

namespace test_friction_term {

using namespace diffsim;

namespace {

constexpr double kThickness = 1e-3;
constexpr double kStep = 1e-7;

/// Two boxes that push each other and have turned and slipped since the step began: by an edge
/// of each, or a corner in a face.
struct Boxes {
    Model model;
    std::vector<ClothParameters> materials;
    std::vector<double> friction = {0.6, 0.3};
    Zone zone;
    ZonePoint point;
    ContactFriction state{Vec3(0.3, -0.2, 0.1), false};

    explicit Boxes(bool by_edges) {
        model.thickness = kThickness;
        const Vec3 half(0.4, 0.3, 0.2);
        model.bodies.push_back(fixtures::body(fixtures::box(half), 0.3 * kThickness));
        model.bodies.push_back(fixtures::body(fixtures::box(half), 0.7 * kThickness));
        make_zone(zone, model, materials, kDefaultCompliance, Vec3::Zero());
        zone.friction = &friction;
        const Mat3 on_edge = exp_rotation(Vec3(0.0, 0.8, 0.0));
        const Mat3 upper =
            by_edges ? Mat3(exp_rotation(Vec3(0.0, 0.0, 1.4)) * on_edge) : exp_rotation(Vec3(0.5, 0.7, 0.2));
        const Mat3 lower = by_edges ? on_edge : Mat3(exp_rotation(Vec3(0.0, 0.0, 0.3)));
        const auto lowest = [&](const Mat3& R) {
            double z = 0.0;
            for (const Vec3& v : model.bodies[0].mesh.vertices) z = std::min(z, (R * v).z());
            return -z;
        };
        const double height = lowest(upper) + (by_edges ? lowest(lower) : half.z()) + 0.6 * kThickness;
        point.y.bodies.resize(2);
        point.y.bodies[0] << 0.02, -0.03, 0.05, 0.004, 0.002, -0.001;
        point.y.bodies[1] << -0.01, 0.02, 0.03, -0.001, 0.003, 0.002;
        const std::array<Pose, 2> ends = {Pose{upper, Vec3(0.01, 0.02, height)}, Pose{lower, Vec3::Zero()}};
        for (int i = 0; i < 2; ++i) {
            const Vec6& y = point.y.bodies[static_cast<std::size_t>(i)];
            const Pose& end = ends[static_cast<std::size_t>(i)];
            const Pose start{exp_rotation(-y.head<3>()) * end.R, end.t - y.tail<3>()};
            zone.bodies.push_back(fixtures::zone_body(i, start, 2.0, fixtures::box_inertia(half, 2.0)));
        }
        zone.dynamic_count = 2;
        Coordinates begin, end;
        begin.assign_zero(2, 0);
        end = point.y;
        ContactCoverage coverage;
        collect_contacts(zone, PassiveBodies(), begin, end, coverage);
        evaluate(zone, point);
    }
    FrictionTerm term() const {
        FrictionTerm term;
        const ActiveContact& active = point.active.front();
        const double force = contact_force(active.geometry, zone.contacts[active.index].law);
        make_friction_term(zone, point, active.index, active.geometry, force, state, term);
        return term;
    }

    /// The same with a body elsewhere, moved as it was: by a twist at its end.
    Boxes placed(int coordinate, double by) const {
        Boxes moved = *this;
        moved.zone.friction = &moved.friction;
        moved.zone.model = &moved.model;
        ZoneBody& body = moved.zone.bodies[static_cast<std::size_t>(coordinate / 6)];
        Vec6 twist = Vec6::Zero();
        twist[coordinate % 6] = by;
        const Mat3 turn = exp_rotation(point.y.bodies[static_cast<std::size_t>(coordinate / 6)].head<3>());
        body.start.R = turn.transpose() * exp_rotation(twist.head<3>()) * turn * body.start.R;
        body.start.t += twist.tail<3>();
        evaluate(moved.zone, moved.point);
        return moved;
    }
    /// The same with a body that moved otherwise, to the same place.
    Boxes with_motion(int coordinate, double by) const {
        Boxes moved = *this;
        moved.zone.friction = &moved.friction;
        moved.zone.model = &moved.model;
        const std::size_t i = static_cast<std::size_t>(coordinate / 6);
        const Pose end = pose_at(zone.bodies[i], point.y.bodies[i]);
        Vec6& y = moved.point.y.bodies[i];
        y[coordinate % 6] += by;
        moved.zone.bodies[i].start = {exp_rotation(-y.head<3>()) * end.R, end.t - y.tail<3>()};
        evaluate(moved.zone, moved.point);
        return moved;
    }
};

template <class Value>
auto difference(const Value& value, const Boxes& up, const Boxes& down) {
    return ((value(up) - value(down)) / (2.0 * kStep)).eval();
}

}  // namespace

TEST(the_force_of_a_slipping_contact_changes_with_place_and_motion_as_its_derivatives_say) {
    for (const bool by_edges : {true, false}) {
        Boxes boxes(by_edges);
        CHECK(boxes.point.active.size() == 1);
        boxes.state.slips = true;
        const FrictionTerm term = boxes.term();
        CHECK(!term.sticks);
        CHECK(term.force.norm() > 0.0);
        const double scale = term.force_of_place.cwiseAbs().maxCoeff();
        const auto force = [](const Boxes& b) { return b.term().force; };
        for (int k = 0; k < 12; ++k) {
            const SmallVector place = difference(force, boxes.placed(k, kStep), boxes.placed(k, -kStep));
            CHECK_NEAR(term.force_of_place.col(k), place, 1e-6 * scale);
            const SmallVector motion = difference(force, boxes.with_motion(k, kStep), boxes.with_motion(k, -kStep));
            CHECK_NEAR(term.force_of_motion.col(k), motion, 1e-6 * term.force_of_motion.cwiseAbs().maxCoeff());
        }
    }
}

TEST(the_slip_of_a_sticking_contact_changes_with_the_motion_by_its_rows) {
    for (const bool by_edges : {true, false}) {
        const Boxes boxes(by_edges);
        const FrictionTerm term = boxes.term();
        CHECK(term.sticks);
        // Jᵀ T and T J are transposes of each other but for the Jacobian of the turn: what it holds is what it feels.
        const Mat3 Jt = left_jacobian(boxes.point.y.bodies[0].head<3>()).transpose();
        for (int k = 0; k < 2; ++k) {
            CHECK_NEAR(term.rows.col(k).segment<3>(3), term.slip_of_motion.row(k).segment<3>(3).transpose(), 1e-14);
            CHECK_NEAR(term.rows.col(k).head<3>(), Vec3(Jt * term.slip_of_motion.row(k).head<3>().transpose()), 1e-14);
        }
    }
}

}  // namespace test_friction_term
