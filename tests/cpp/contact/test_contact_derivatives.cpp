// Contacts with cloth; those of rigid bodies are in test_contact.cpp.
#include "contact/contact_derivatives.hpp"

#include <algorithm>
#include <map>
#include <string>

#include "cloth_fixtures.hpp"
#include "collision/ccd.hpp"

namespace test_contact_derivatives {

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

/// A contact of a rigid body or a cloth with a cloth, in the coordinates that its derivatives are taken along: the
/// twist of the body, the three nodes of a feature (an edge and a vertex leave some out).
struct Situation {
    bool body_a;  ///< what a is
    CollisionMesh mesh_a, mesh_b;
    Contact contact{0, 1, ContactType::vertex_patch, 0, 0};
    Pose pose{};  ///< of a body
    std::vector<Vec3> nodes_a, nodes_b;
    ContactRange range{};

    int size_a() const { return body_a ? 6 : 9; }
    int size() const { return size_a() + 9; }
    Surface surface_a() const {
        return body_a ? Surface{&mesh_a, &pose, nullptr} : Surface{&mesh_a, nullptr, nodes_a.data()};
    }
    Surface surface_b() const { return {&mesh_b, nullptr, nodes_b.data()}; }
    static void move_nodes(
        const CollisionMesh& mesh, const Feature& feature, const VectorX& x, std::vector<Vec3>& nodes) {
        const std::array<int, 3> vertices = feature_vertices(mesh, feature);
        for (int k = 0; k < 3; ++k)
            if (vertices[static_cast<std::size_t>(k)] >= 0)
                nodes[vertices[static_cast<std::size_t>(k)]] += x.segment<3>(3 * k);
    }
    Situation moved(const VectorX& x) const {
        Situation other = *this;
        if (body_a)
            other.pose = {exp_rotation(Vec3(x.head<3>())) * pose.R, pose.t + x.segment<3>(3)};
        else
            move_nodes(mesh_a, contact.on_a(), x.head<9>(), other.nodes_a);
        move_nodes(mesh_b, contact.on_b(), x.tail<9>(), other.nodes_b);
        return other;
    }
    ContactLaw law() const { return {range, {kStiffness, 0.0, 0.0}}; }
    ContactGeometry geometry() const { return {contact, surface_a(), surface_b(), 0.0}; }
    double energy() const { return contact_energy(geometry(), law()); }
    ClothSide side_a(const ContactGeometry& g) const {
        return cloth_side(g.closest.a, g.normal, contact.on_a(), surface_a());
    }
    ClothSide side_b(const ContactGeometry& g) const {
        return cloth_side(g.closest.b, g.normal, contact.on_b(), surface_b());
    }

    struct Derivatives {
        VectorX gradient, row;
        MatrixX hessian;
    };
    template <class A>
    Derivatives derivatives_with(const ContactGeometry& g, const A& a, bool with_curvature) const {
        const auto d = contact_derivatives(g, law(), a, side_b(g), true, with_curvature);
        const ClothSide b = side_b(g);
        CHECK(d.row == relative_row(motion_of(a, g.closest.a.point), motion_of(b, g.closest.b.point), g.normal));
        return {d.gradient, d.row, d.hessian};
    }
    Derivatives derivatives(bool with_curvature = true) const {
        const ContactGeometry g = geometry();
        return body_a ? derivatives_with(g, BodySide{pose.t}, with_curvature)
                      : derivatives_with(g, side_a(g), with_curvature);
    }
    /// Gradient in the chart of the pose from which x counts.
    VectorX gradient(const VectorX& x) const {
        VectorX g = moved(x).derivatives().gradient;
        if (body_a) g.head<3>() = left_jacobian(Vec3(x.head<3>())).transpose() * g.head<3>();
        return g;
    }
    std::pair<std::uint32_t, bool> code() const {
        const ContactGeometry g = geometry();
        return {g.closest.feature_code, g.sine_sq < kParallelLimit};
    }
    bool is_stable() const {
        for (int i = 0; i < size(); ++i)
            for (const double by : {2.0 * kStep, -2.0 * kStep})
                if (moved(by * VectorX::Unit(size(), i)).code() != code()) return false;
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
        const std::string partner = body_a ? "body-" : "cloth-";
        if (g.sine_sq < kParallelLimit) return partner + "mollified";
        const int slides = g.closest.a.slide_count + g.closest.b.slide_count;
        const char* const type = contact.type == ContactType::edge_edge      ? "edges "
                                 : contact.type == ContactType::vertex_patch ? "vertex-patch "
                                                                             : "patch-vertex ";
        return partner + type + std::to_string(slides);
    }
};

Situation random_situation(check::Random& random, bool body_a, ContactType type) {
    Situation s;
    s.body_a = body_a;
    const Cloth cloth = fixtures::cloth(fixtures::hexagon(1.0)), other = fixtures::cloth(fixtures::grid(2, 1, 0.8));
    s.mesh_a = body_a ? fixtures::collision_mesh(fixtures::box(Vec3(0.6, 0.5, 0.4))) : other.surface;
    s.mesh_b = cloth.surface;
    s.contact.type = type;
    const auto pick = [&](const CollisionMesh& mesh, bool vertex) {
        const std::size_t count = type == ContactType::edge_edge ? mesh.edges.size()
                                  : vertex                       ? mesh.vertices.size()
                                                                 : mesh.patches.size();
        return static_cast<int>(random.uniform(0.0, 1.0) * static_cast<double>(count));
    };
    s.contact.feature_a = pick(s.mesh_a, type == ContactType::vertex_patch);
    s.contact.feature_b = pick(s.mesh_b, type == ContactType::patch_vertex);
    s.pose = {random_rotation(random), random_vec3(random)};
    s.nodes_a =
        fixtures::moved(fixtures::shaken(s.mesh_a.vertices, random, 0.2), random_rotation(random), random_vec3(random));
    s.nodes_b = fixtures::moved(
        fixtures::shaken(s.mesh_b.vertices, random, 0.2), random_rotation(random), random_vec3(random, 1.2));
    return s;
}

/// Lay the edge of b at this angle from parallel to that of a, and so that their middles are `gap` apart.
void make_parallel(Situation& s, check::Random& random, double angle, double gap) {
    const Edge &a = s.mesh_a.edges[s.contact.feature_a], &b = s.mesh_b.edges[s.contact.feature_b];
    const Vec3 a0 = s.surface_a().vertex(a.p0), a1 = s.surface_a().vertex(a.p1);
    const Vec3 direction = (a1 - a0).normalized();
    const Vec3 normal = direction.cross(fixtures::random_direction(random)).normalized();
    const double half = 0.5 * (s.nodes_b[b.p1] - s.nodes_b[b.p0]).norm();
    const Vec3 middle = 0.5 * (a0 + a1) + gap * normal, along = half * (exp_rotation(angle * normal) * direction);
    s.nodes_b[b.p0] = middle - along;
    s.nodes_b[b.p1] = middle + along;
}

void check_derivatives(const Situation& s, double tolerance) {
    const Situation::Derivatives d = s.derivatives();
    const VectorX zero = VectorX::Zero(s.size());
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

constexpr ContactType kTypes[] = {ContactType::vertex_patch, ContactType::patch_vertex, ContactType::edge_edge};

}  // namespace

TEST(contact_derivatives_with_cloth_agree_with_differences_for_every_type) {
    check::Random random(1);
    std::map<std::string, int> cases_hit;
    for (int k = 0; k < 1200; ++k) {
        NOTE(k);
        Situation s = random_situation(random, k % 2 == 0, kTypes[k % 3]);
        if (s.geometry().distance < 0.1 || cases_hit[s.kind()] >= 6 || !s.is_stable()) continue;
        NOTE(s.kind());
        s.press(k % 4 < 2 ? 0.05 : 0.6);
        check_derivatives(s, kDifferences);
        ++cases_hit[s.kind()];
    }
    for (const std::string partner : {"body-", "cloth-"})
        for (const std::string type : {"edges ", "vertex-patch ", "patch-vertex "})
            for (const char* slides : {"0", "1", "2"}) {
                NOTE(partner + type + slides);
                CHECK(cases_hit[partner + type + slides] == 6);
            }
}

TEST(contact_derivatives_with_cloth_agree_with_differences_for_nearly_parallel_edges) {
    check::Random random(2);
    std::map<std::string, int> cases_hit;
    for (int k = 0; k < 200; ++k) {
        NOTE(k);
        Situation s = random_situation(random, k % 2 == 0, ContactType::edge_edge);
        make_parallel(s, random, random.uniform(0.008, 0.03), 0.3);
        if (k % 4 < 2) {
            const Edge& edge = s.mesh_b.edges[s.contact.feature_b];
            const Vec3 shift = random_vec3(random, 0.6);
            s.nodes_b[edge.p0] += shift;
            s.nodes_b[edge.p1] += shift;
        }
        if (s.geometry().sine_sq >= kParallelLimit || s.geometry().distance < 0.1 || !s.is_stable()) continue;
        const ContactGeometry g = s.geometry();
        int& hit = cases_hit[s.kind() + (g.closest.a.slide_count + g.closest.b.slide_count == 2 ? " inside" : " end")];
        if (hit >= 8) continue;
        s.press(0.4);
        check_derivatives(s, kMollifiedDifferences);
        ++hit;
    }
    for (const char* kind :
         {"body-mollified inside", "body-mollified end", "cloth-mollified inside", "cloth-mollified end"}) {
        NOTE(kind);
        CHECK(cases_hit[kind] == 8);
    }
}

TEST(a_cloth_side_holds_the_closest_point_and_how_it_slides) {
    check::Random random(3);
    std::map<int, int> cases_hit;
    for (int k = 0; k < 1500; ++k) {
        NOTE(k);
        const Situation s = random_situation(random, false, kTypes[k % 3]);
        const ContactGeometry g = s.geometry();
        for (const bool of_a : {true, false}) {
            NOTE(of_a);
            const Surface surface = of_a ? s.surface_a() : s.surface_b();
            const ClosestPoint& closest = of_a ? g.closest.a : g.closest.b;
            const Feature feature = of_a ? s.contact.on_a() : s.contact.on_b();
            const ClothSide side = cloth_side(closest, g.normal, feature, surface);
            const std::array<int, 3> vertices = feature_vertices(*surface.mesh, feature);
            const int slides = closest.slide_count;
            Mat3 nodes = Mat3::Zero();
            for (int i = 0; i < 3; ++i) {
                if (vertices[static_cast<std::size_t>(i)] >= 0)
                    nodes.col(i) = surface.vertex(vertices[static_cast<std::size_t>(i)]);
                else
                    CHECK(side.weights[i] == 0.0);
            }
            CHECK_NEAR(side.weights.sum(), 1.0, 1e-12);
            CHECK(side.weights.minCoeff() >= -1e-12);
            CHECK_NEAR(nodes * side.weights, closest.point, 1e-12);
            for (int i = 0; i < slides; ++i) {
                const Vec3& rate = side.slide[static_cast<std::size_t>(i)];
                const Vec3 slide = nodes * rate;
                CHECK_NEAR(slide.norm(), 1.0, 1e-12);
                CHECK_NEAR(slide.dot(g.normal), 0.0, 1e-9);
                CHECK_NEAR(rate.sum(), 0.0, 1e-12);
                for (int j = 0; j < i; ++j)
                    CHECK_NEAR(slide.dot(nodes * side.slide[static_cast<std::size_t>(j)]), 0.0, 1e-12);
            }
            if (s.contact.type == ContactType::edge_edge)
                CHECK_NEAR(side.edge_length, (nodes.col(1) - nodes.col(0)).norm(), 1e-15);
            ++cases_hit[slides];
        }
    }
    for (int slides = 0; slides < 3; ++slides) CHECK(cases_hit[slides] >= 20);
}

TEST(curvature_of_contacts_with_cloth_can_be_left_out) {
    check::Random random(4);
    int cases_hit = 0;
    for (int k = 0; k < 20; ++k) {
        Situation s = random_situation(random, k % 2 == 0, kTypes[k % 3]);
        if (s.geometry().distance < 0.1 || s.geometry().sine_sq < kParallelLimit) continue;
        s.press(0.3);
        const Situation::Derivatives full = s.derivatives(), dropped = s.derivatives(false);
        const double stiffness = normal_force(s.law(), s.geometry().distance).stiffness;
        CHECK(dropped.gradient == full.gradient);
        CHECK_NEAR(dropped.hessian, stiffness * full.row * full.row.transpose(), 1e-12 * full.hessian.norm());
        CHECK((full.hessian - dropped.hessian).norm() > 1e-3 * full.hessian.norm());
        ++cases_hit;
    }
    CHECK(cases_hit >= 12);
}

TEST(contact_toi_with_cloth_stops_every_type_at_its_floor) {
    check::Random random(5);
    const CcdOptions options{0.05, 1e-6};
    int cases_hit[6] = {0, 0, 0, 0, 0, 0};
    for (int k = 0; k < 300; ++k) {
        NOTE(k);
        const Situation s = random_situation(random, k % 2 == 0, kTypes[k % 3]);
        if (s.geometry().distance < 0.1) continue;
        Situation end = s;
        for (Vec3& x : end.nodes_b) x += 1.5 * s.geometry().distance * s.geometry().normal + random_vec3(random, 0.2);
        const double toi =
            contact_toi(s.contact, {s.surface_a(), s.surface_a()}, {s.surface_b(), end.surface_b()}, 0.0, options);
        if (toi == kNoImpact) continue;
        CHECK(toi > 0.0);
        for (const double part : {0.25, 0.5, 0.75, 1.0}) {
            Situation there = s;
            for (std::size_t i = 0; i < s.nodes_b.size(); ++i)
                there.nodes_b[i] = (1.0 - part * toi) * s.nodes_b[i] + part * toi * end.nodes_b[i];
            CHECK(there.geometry().distance >= options.min_distance);
            if (part == 1.0) CHECK(there.geometry().distance <= options.min_distance + 1.001 * options.tolerance);
        }
        ++cases_hit[k % 6];
    }
    for (const int cases : cases_hit) CHECK(cases >= 5);
}

}  // namespace test_contact_derivatives
