#include "contact/contact_derivatives.hpp"

#include <algorithm>
#include <map>
#include <string>

#include "collision/ccd.hpp"
#include "fixtures.hpp"

namespace test_contact {

using namespace diffsim;
using fixtures::random_rotation;
using fixtures::random_vec3;

namespace {

constexpr double kStiffness = 100.0;
constexpr double kStep = 1e-4;  // [rad or m]; smaller than the features by 1e4, so that truncation is 1e-16 of them
constexpr double kDifferences = 1e-7;
// Between nearly parallel edges all scales are an angle of 0.01 rad: truncation is (kStep / 0.01)⁴, and the closest
// points carry rounding of eps / 0.01².
constexpr double kMollifiedDifferences = 1e-5;

Model two_bodies() {
    Model model;
    model.bodies.push_back(fixtures::body(fixtures::box(Vec3(0.6, 0.5, 0.4)), 0.0));
    model.bodies.push_back(fixtures::body(fixtures::tetrahedron(0.7), 0.0));
    return model;
}

/// A contact at two poses, and its energy along the twists (turn a, shift a, turn b, shift b).
struct Situation {
    const Model& model;
    Contact contact;
    Pose a, b;
    ContactRange range{};

    Pose moved(const Pose& pose, const Vec6& twist) const {
        return {exp_rotation(twist.head<3>()) * pose.R, pose.t + twist.tail<3>()};
    }
    Situation moved(const VectorX& x) const {
        Situation other = *this;
        other.a = moved(a, x.head<6>());
        other.b = moved(b, x.tail<6>());
        return other;
    }
    ContactLaw law() const { return {range, {kStiffness, 0.0, 0.0}}; }
    ContactGeometry geometry() const { return contact_geometry(model, contact, a, b, 0.0); }
    double energy() const { return contact_energy(geometry(), law()); }
    ContactDerivatives<12> derivatives(bool with_curvature = true) const {
        return contact_derivatives(geometry(), law(), BodySide{a.t}, BodySide{b.t}, true, with_curvature);
    }
    /// Gradient in the chart of the poses from which x counts: a turn's is Jᵀ of that along the twist at x.
    VectorX gradient(const VectorX& x) const {
        VectorX g = moved(x).derivatives().gradient;
        g.head<3>() = left_jacobian(x.head<3>()).transpose() * g.head<3>();
        g.segment<3>(6) = left_jacobian(x.segment<3>(6)).transpose() * g.segment<3>(6);
        return g;
    }
    /// Which sub-features are closest, and whether the mollifier acts.
    std::pair<std::uint32_t, bool> code() const {
        const ContactGeometry g = geometry();
        return {g.closest.feature_code, g.sine_sq < kParallelLimit};
    }
    bool is_stable() const {
        for (int i = 0; i < 12; ++i)
            for (const double by : {2.0 * kStep, -2.0 * kStep})
                if (moved(by * VectorX::Unit(12, i)).code() != code()) return false;
        return true;
    }
    /// Make the contact act at its distance, by `part` of the way from rest to pole.
    void press(double part) {
        const double distance = geometry().distance;
        range.pole = 0.5 * distance;
        range.rest = range.pole + (distance - range.pole) / (1.0 - part);
    }
    std::string kind() const {
        const ContactGeometry g = geometry();
        if (g.sine_sq < kParallelLimit) return "mollified";
        const int slides = g.closest.a.slide_count + g.closest.b.slide_count;
        if (contact.type == ContactType::edge_edge) return std::string("edge-edge ") + "021"[slides];
        return std::string("vertex-") + (slides == 2 ? "face" : slides == 1 ? "edge" : "vertex");
    }
};

Situation random_situation(const Model& model, check::Random& random, int k) {
    Situation s{model, {0, 1, static_cast<ContactType>(k % 3), 0, 0}, {}, {}};
    const CollisionMesh &mesh_a = model.bodies[0].mesh, &mesh_b = model.bodies[1].mesh;
    const auto pick = [&](std::size_t count) {
        return static_cast<int>(random.uniform(0.0, 1.0) * static_cast<double>(count));
    };
    s.contact.feature_a = pick(
        k % 3 == 0   ? mesh_a.vertices.size()
        : k % 3 == 1 ? mesh_a.patches.size()
                     : mesh_a.edges.size());
    s.contact.feature_b = pick(
        k % 3 == 0   ? mesh_b.patches.size()
        : k % 3 == 1 ? mesh_b.vertices.size()
                     : mesh_b.edges.size());
    s.a = {random_rotation(random), random_vec3(random)};
    s.b = {random_rotation(random), random_vec3(random, 1.5)};
    return s;
}

/// Turn body a until the two edges are this angle from parallel, and hold it so that their middles are `gap` apart.
void make_parallel(Situation& s, check::Random& random, double angle, double gap) {
    const auto edge = [](const CollisionMesh& mesh, int e) {
        return std::pair(mesh.vertices[mesh.edges[e].p0], mesh.vertices[mesh.edges[e].p1]);
    };
    const auto [a0, a1] = edge(s.model.bodies[0].mesh, s.contact.feature_a);
    const auto [b0, b1] = edge(s.model.bodies[1].mesh, s.contact.feature_b);
    const Vec3 direction = s.b.R * (b1 - b0).normalized();
    const Vec3 normal = direction.cross(fixtures::random_direction(random)).normalized();
    const Vec3 aim = exp_rotation(angle * normal) * direction;
    const Mat3 align = Eigen::Quaterniond::FromTwoVectors(s.a.R * (a1 - a0), aim).toRotationMatrix();
    s.a.R = align * s.a.R;
    s.a.t = s.b * (0.5 * (b0 + b1)) + gap * normal - s.a.R * (0.5 * (a0 + a1));
}

void check_derivatives(const Situation& s, double tolerance) {
    const ContactDerivatives<12> d = s.derivatives();
    const VectorX zero = VectorX::Zero(12);
    CHECK(d.gradient.norm() > 0.0);
    CHECK(d.hessian.norm() > 0.0);
    CHECK_NEAR(d.hessian, d.hessian.transpose(), 1e-12 * d.hessian.norm());
    const auto energy = [&](const VectorX& x) { return s.moved(x).energy(); };
    CHECK_NEAR(d.gradient, fixtures::numeric_gradient(energy, zero, kStep), tolerance * d.gradient.norm());
    const auto gradient = [&](const VectorX& x) { return s.gradient(x); };
    CHECK_NEAR(d.hessian, fixtures::numeric_jacobian(gradient, zero, kStep), tolerance * d.hessian.norm());
    const auto distance = [&](const VectorX& x) { return s.moved(x).geometry().distance; };
    CHECK_NEAR(d.row, fixtures::numeric_gradient(distance, zero, kStep), tolerance * d.row.norm());
}

}  // namespace

TEST(contact_derivatives_agree_with_differences_for_every_type) {
    const Model model = two_bodies();
    check::Random random(1);
    std::map<std::string, int> cases_hit;
    for (int k = 0; k < 600; ++k) {
        NOTE(k);
        Situation s = random_situation(model, random, k);
        if (s.geometry().distance < 0.1 || !s.is_stable()) continue;
        if (cases_hit[s.kind()] >= 12) continue;
        NOTE(s.kind());
        s.press(k % 2 == 0 ? 0.05 : 0.6);
        check_derivatives(s, kDifferences);
        ++cases_hit[s.kind()];
    }
    for (const char* kind :
         {"vertex-vertex", "vertex-edge", "vertex-face", "edge-edge 0", "edge-edge 1", "edge-edge 2"}) {
        NOTE(kind);
        CHECK(cases_hit[kind] >= 8);
    }
}

TEST(contact_derivatives_agree_with_differences_for_nearly_parallel_edges) {
    const Model model = two_bodies();
    check::Random random(2);
    int inside = 0, at_ends = 0;
    for (int k = 0; k < 120; ++k) {
        NOTE(k);
        Situation s = random_situation(model, random, 3 * k + 2);
        make_parallel(s, random, random.uniform(0.008, 0.03), 0.3);
        if (k % 2 == 0) s.a.t += random_vec3(random, 0.5);
        if (s.kind() != "mollified" || s.geometry().distance < 0.1 || !s.is_stable()) continue;
        s.press(0.4);
        check_derivatives(s, kMollifiedDifferences);
        const ContactGeometry g = s.geometry();
        (g.closest.a.slide_count + g.closest.b.slide_count == 2 ? inside : at_ends) += 1;
    }
    CHECK(inside >= 15);
    CHECK(at_ends >= 15);
}

TEST(energy_is_continuously_differentiable_where_the_type_changes) {
    // Moving along a random path, bisect every change of type: energy and gradient must be the same on both sides.
    constexpr double kInterval = 1e-12;  // of the path
    constexpr double kJump = 1e-8;       // relative; what the Hessian makes of kInterval, at conditioning of 1e3
    const Model model = two_bodies();
    check::Random random(3);
    std::map<std::string, int> cases_hit;
    for (int k = 0; k < 200; ++k) {
        NOTE(k);
        Situation s = random_situation(model, random, k);
        if (k % 6 == 5) make_parallel(s, random, 0.02, 0.3);
        s.range = {8.0, 8.0, 0.0, 0.0, 0.0};  // acts everywhere on the path
        const VectorX velocity = k % 6 == 5 ? VectorX(0.3 * random.vector(12)) : VectorX(random.vector(12));
        const auto at = [&](double t) { return s.moved(t * velocity); };
        constexpr int kSamples = 40;
        for (int i = 0; i < kSamples; ++i) {
            double low = static_cast<double>(i) / kSamples, high = (i + 1.0) / kSamples;
            if (at(low).code() == at(high).code()) continue;
            const auto code = at(low).code();
            while (high - low > kInterval) {
                const double middle = 0.5 * (low + high);
                (at(middle).code() == code ? low : high) = middle;
            }
            const Situation before = at(low), after = at(high);
            if (before.geometry().distance < 0.05) continue;  // a passage through the surface
            const ContactDerivatives<12> d0 = before.derivatives(), d1 = after.derivatives();
            CHECK(d0.gradient.norm() > 0.0);
            CHECK_NEAR(after.energy(), before.energy(), kJump * before.energy());
            const bool mollified = before.code().second || after.code().second;
            CHECK_NEAR(d1.gradient, d0.gradient, (mollified ? 100.0 : 1.0) * kJump * d0.gradient.norm());
            ++cases_hit[mollified ? "mollified" : s.contact.type == ContactType::edge_edge ? "edges" : "vertex"];
        }
    }
    CHECK(cases_hit["vertex"] >= 50);
    CHECK(cases_hit["edges"] >= 30);
    CHECK(cases_hit["mollified"] >= 10);
}

TEST(curvature_can_be_left_out) {
    const Model model = two_bodies();
    check::Random random(4);
    Situation s = random_situation(model, random, 0);
    s.press(0.3);
    const ContactDerivatives<12> full = s.derivatives(), dropped = s.derivatives(false);
    CHECK(dropped.gradient == full.gradient);
    CHECK_NEAR(dropped.hessian, full.stiffness * full.row * full.row.transpose(), 1e-12 * full.hessian.norm());
    CHECK((full.hessian - dropped.hessian).norm() > 1e-3 * full.hessian.norm());
    CHECK_NEAR(full.gradient, -full.force * full.row, 1e-14 * full.gradient.norm());
}

TEST(exactly_parallel_edges_have_no_energy) {
    const Model model = two_bodies();
    Situation s{model, {0, 0, ContactType::edge_edge, 0, 0}, {}, {Mat3::Identity(), Vec3(0, 0, 1.0)}};
    s.range = {3.0, 3.0, 0.0, 0.0, 0.0};
    CHECK(s.geometry().sine_sq == 0.0);
    CHECK(s.energy() == 0.0);
}

TEST(derivatives_of_edges_that_are_parallel_up_to_rounding_are_finite) {
    // The sine of such edges is rounding, and another one for the edges as they are and for their directions.
    const Model model = two_bodies();
    check::Random random(7);
    int exactly = 0, nearly = 0;
    for (int k = 0; k < 4000; ++k) {
        NOTE(k);
        const Mat3 R = k < 1000 ? random_rotation(random) : Mat3(Mat3::Identity());
        const Vec3 gap = Vec3(0.1, 0.2, 0.9);
        Situation s{model, {0, 0, ContactType::edge_edge, 0, 0}, {R, Vec3::Zero()}, {R, R * gap}};
        s.contact.feature_a = s.contact.feature_b = static_cast<int>(random.uniform(0.0, 12.0));
        const double angle = std::pow(10.0, -random.uniform(10.0, k % 4 == 1 ? 18.0 : 320.0));
        if (k % 2 == 1) s.a.R = s.a.R + skew(angle * fixtures::random_direction(random)) * s.a.R;
        s.range = {3.0, 3.0, 0.0, 0.0, 0.0};
        const ContactDerivatives<12> d = s.derivatives();
        CHECK(d.hessian.allFinite());
        CHECK(d.hessian.norm() < 1e4 * kStiffness / kParallelLimit);
        CHECK_NEAR(d.gradient, VectorX::Zero(12), 1e-3 * kStiffness);
        (s.geometry().sine_sq == 0.0 ? exactly : nearly) += 1;
    }
    CHECK(exactly >= 500);
    CHECK(nearly >= 50);
}

TEST(on_the_border_of_a_feature_second_derivatives_are_the_mean_of_both_sides) {
    // Equal boxes, one exactly above the other or shifted along a side: corners above corners and edges, edges that
    // cross at their ends. Central differences of the gradient take the mean, too, and are
    // exact to the first order there.
    constexpr double kSmallStep = 1e-6, kFirstOrder = 1e-4;
    const Model model = two_bodies();
    const CollisionMesh& mesh = model.bodies[0].mesh;
    check::Random random(8);
    int vertices = 0, edges = 0;
    const auto check = [&](Situation s) {
        const ContactGeometry g = s.geometry();
        const ClosestPoints& closest = g.closest;
        if (g.distance > 0.35 || g.sine_sq < kParallelLimit || closest.a.border_count + closest.b.border_count == 0)
            return false;
        NOTE(s.kind());
        s.range = {1.0, 1.0, 0.0, 0.0, 0.0};
        const auto gradient = [&](const VectorX& x) { return s.gradient(x); };
        const MatrixX hessian = s.derivatives().hessian;
        CHECK_NEAR(
            hessian, fixtures::numeric_jacobian(gradient, VectorX::Zero(12), kSmallStep), kFirstOrder * hessian.norm());
        return true;
    };
    for (int k = 0; k < 6; ++k) {
        NOTE(k);
        const Mat3 R = k == 0 ? Mat3(Mat3::Identity()) : random_rotation(random);
        const Vec3 gap(k % 3 == 1 ? 0.3 : 0.0, k % 3 == 2 ? 0.3 : 0.0, 2.0 * 0.4 + 0.3);
        Situation s{model, {0, 0, ContactType::edge_edge, 0, 0}, {R, R * gap}, {R, Vec3::Zero()}};
        for (int a = 0; a < static_cast<int>(mesh.edges.size()); ++a)
            for (int b = 0; b < static_cast<int>(mesh.edges.size()); ++b) {
                s.contact = {0, 0, ContactType::edge_edge, a, b};
                edges += check(s) ? 1 : 0;
            }
        for (int v = 0; v < static_cast<int>(mesh.vertices.size()); ++v)
            for (int p = 0; p < static_cast<int>(mesh.patches.size()); ++p) {
                s.contact = {0, 0, ContactType::vertex_patch, v, p};
                vertices += check(s) ? 1 : 0;
                s.contact = {0, 0, ContactType::patch_vertex, p, v};
                vertices += check(s) ? 1 : 0;
            }
    }
    CHECK(vertices >= 60);
    CHECK(edges >= 60);
}

TEST(exactly_parallel_edges_resist_turning) {
    // Their energy is the mollifier's c / kParallelLimit, quadratic in the angle between them.
    const Model model = two_bodies();
    Situation s{model, {0, 0, ContactType::edge_edge, 0, 0}, {}, {Mat3::Identity(), Vec3(0.1, 0.2, 1.2)}};
    s.range = {3.0, 3.0, 0.0, 0.0, 0.0};
    for (int edge = 0; edge < 12; ++edge) {
        NOTE(edge);
        s.contact.feature_a = s.contact.feature_b = edge;
        CHECK(s.geometry().sine_sq == 0.0);
        const ContactDerivatives<12> d = s.derivatives();
        CHECK(d.gradient.isZero(1e-12 * kStiffness));
        const auto gradient = [&](const VectorX& x) { return s.gradient(x); };
        CHECK(d.hessian.norm() > kStiffness);
        CHECK_NEAR(d.hessian, fixtures::numeric_jacobian(gradient, VectorX::Zero(12), 1e-6), 1e-4 * d.hessian.norm());
    }
}

TEST(ground_derivatives_agree_with_differences) {
    const Model model = two_bodies();
    check::Random random(5);
    const ContactLaw law{{2.0, 2.0, -2.0, -2.0, -2.0}, {kStiffness, 0.0, 0.0}};
    constexpr std::array<int, 3> kVertices = {3, 0, 1};
    for (int k = 0; k < 10; ++k) {
        NOTE(k);
        const Pose pose{random_rotation(random), random_vec3(random)};
        const double ground_height = random.uniform(-0.5, 0.5);
        const auto center = [&](const VectorX& x) -> Vec3 { return pose.t + x.tail<3>(); };
        const auto at = [&](const VectorX& x, int vertex) {
            const Pose moved{exp_rotation(Vec3(x.head<3>())) * pose.R, center(x)};
            return contact_geometry(
                model, {0, kGround, ContactType::vertex_patch, vertex, -1}, moved, {}, ground_height);
        };
        const auto contacts = [&](const VectorX& x) {
            GroundSums result;
            for (const int vertex : kVertices) {
                const ContactGeometry g = at(x, vertex);
                result.add(g.distance, g.closest.a.point - center(x), law);
            }
            return result;
        };
        const auto gradient = [&](const VectorX& x) -> VectorX {
            VectorX g = contacts(x).gradient();
            g.head<3>() = left_jacobian(x.head<3>()).transpose() * g.head<3>();
            return g;
        };
        const auto energy = [&](const VectorX& x) {
            double sum = 0.0;
            for (const int vertex : kVertices) sum += contact_energy(at(x, vertex), law);
            return sum;
        };
        const VectorX zero = VectorX::Zero(6), g = gradient(zero);
        const Mat6 full = contacts(zero).hessian(true), flat = contacts(zero).hessian(false);
        Mat6 rows = Mat6::Zero();
        for (const int vertex : kVertices) {
            const ContactGeometry geometry = at(zero, vertex);
            const Vec6 row = GroundSums::row(geometry.closest.a.point - pose.t);
            rows += normal_force(law, geometry.distance).stiffness * row * row.transpose();
        }
        CHECK(g.head<3>().norm() > 1e-3);
        CHECK_NEAR(g, fixtures::numeric_gradient(energy, zero, kStep), kDifferences * g.norm());
        CHECK_NEAR(full, fixtures::numeric_jacobian(gradient, zero, kStep), kDifferences * full.norm());
        CHECK_NEAR(flat, rows, 1e-13 * full.norm());
        CHECK((full - flat).norm() > 1e-3 * full.norm());
    }
}

TEST(contact_toi_stops_every_type_at_its_floor) {
    const Model model = two_bodies();
    check::Random random(6);
    const CcdOptions options{0.05, 1e-6};
    int cases_hit[3] = {0, 0, 0};
    for (int k = 0; k < 300; ++k) {
        NOTE(k);
        const Situation s = random_situation(model, random, k);
        if (s.geometry().distance < 0.1) continue;
        Vec6 twist = 0.2 * random.vector(6);
        twist.tail<3>() -= 1.5 * s.geometry().distance * s.geometry().normal;
        const Sweep sweep_a{s.a, s.moved(s.a, twist)};
        const CollisionMesh &mesh_a = model.bodies[s.contact.object_a].mesh,
                            &mesh_b = model.bodies[s.contact.object_b].mesh;
        const Surface still{&mesh_b, &s.b, nullptr};
        const double toi = contact_toi(
            s.contact, {{&mesh_a, &sweep_a.begin, nullptr}, {&mesh_a, &sweep_a.end, nullptr}}, {still, still}, 0.0,
            options);
        if (toi == kNoImpact) continue;
        CHECK(toi > 0.0);
        // Vertices go straight: the pose between is an affine map, which Pose can hold.
        const double t = toi;
        Situation there = s;
        there.a = {(1.0 - t) * sweep_a.begin.R + t * sweep_a.end.R, (1.0 - t) * sweep_a.begin.t + t * sweep_a.end.t};
        if (s.contact.type != ContactType::patch_vertex) {  // whose normal an affine map would have to renormalise
            const double distance = there.geometry().distance;
            CHECK(distance >= options.min_distance);
            CHECK(distance <= options.min_distance + 1.001 * options.tolerance);
        }
        ++cases_hit[k % 3];
    }
    for (const int cases : cases_hit) CHECK(cases >= 5);
    const Contact ground{0, kGround, ContactType::vertex_patch, 0, -1};
    const Pose high{Mat3::Identity(), Vec3(0, 0, 2)}, low{Mat3::Identity(), Vec3(0, 0, -2)};
    const double toi = contact_toi(
        ground, {{&model.bodies[0].mesh, &high, nullptr}, {&model.bodies[0].mesh, &low, nullptr}}, {}, 0.0,
        options);  // the vertex from 1.6 to -2.4
    CHECK(toi <= 1.55 / 4.0);
    CHECK(toi >= 1.55 / 4.0 - options.tolerance);
}

}  // namespace test_contact
