#include "scene_queries.hpp"

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <stdexcept>
#include <string>

#include "math/rotation.hpp"
#include "model/number_text.hpp"
#include "solve/separation.hpp"
#include "step/cloth_step.hpp"
#include "zone/zone_contacts.hpp"

namespace diffsim {
namespace {

constexpr double kGoodEnough =
    0.01;  // of the contact's depth that may be missing after separation: a step can do with it

[[noreturn]] void refuse_separation(
    const Model& model, const std::string& what, int a, int b, const std::string& mend) {
    throw std::invalid_argument(what + " '" + model.name(a) + "' and '" + model.name(b) + "'" + mend);
}

void check_separation(const Model& model, const Separation& separation, const SceneState& result) {
    const CrossingObjects crossing = find_crossing(model, result);
    if (crossing.a != kNobody)
        refuse_separation(
            model, "cannot separate", crossing.a, crossing.b,
            ": their meshes cross; move them apart by hand until they touch at most");
    if (separation.complete || separation.lack <= kGoodEnough) return;
    const int a = separation.worst.object_a, b = separation.worst.object_b;
    refuse_separation(
        model, "there is no room between", a, b,
        " for the thickness: their meshes are " + number_text(separation.distance) + " m apart where they need " +
            number_text(separation.rest) + " m, and moving them brings them too near to something else; they lack " +
            number_text(separation.rest - separation.distance) + " m. Give a smaller thickness (it is " +
            number_text(model.pair_thickness(a, b)) + " m), or make room");
}

}  // namespace

SceneState separate_state(
    const Model& model, const Options& options, const Parameters& parameters, const SceneState& state) {
    Zone zone;
    make_zone(zone, model, parameters.cloths, options.compliance, Vec3::Zero());
    PassiveBodies passive;
    std::vector<Box> boxes;
    for (int i = 0; i < model.body_count(); ++i) {
        const Pose pose{quaternion_to_matrix(state.bodies[i].orientation), state.bodies[i].position};
        if (!model.bodies[i].is_dynamic()) {
            passive.bodies.push_back({i, pose, Vec6::Zero()});
            boxes.push_back(swept_box({&model.bodies[i].mesh, {pose, pose}, model.bodies[i].margin}));
            continue;
        }
        ZoneBody body;
        body.id = i;
        body.start = pose;
        body.mass = parameters.mass[i];
        body.inertia = pose.R * parameters.inertia[i] * pose.R.transpose();
        body.inverse_inertia = body.inertia.inverse();
        zone.bodies.push_back(body);
    }
    passive.tree = build_box_tree(boxes);
    zone.dynamic_count = zone.body_count();
    if (!model.cloths.empty()) {
        SceneControl control;
        control.node_force.assign(state.node_position.size(), Vec3::Zero());
        control.node_velocity = control.node_force;
        const StepSetting setting{model, parameters, 0.0, StepPart::whole};
        for (int c = 0; c < model.cloth_count(); ++c) add_cloth(zone, c, setting, state, control);
    }
    if (zone.bodies.empty() && zone.nodes.empty()) return state;
    const Separation separation = separate(zone, passive);
    SceneState result = state;
    result.node_position = separation.nodes;
    for (std::size_t k = 0; k < separation.poses.size(); ++k) {
        const Pose &from = zone.bodies[k].start, &to = separation.poses[k];
        BodyState& body = result.bodies[zone.bodies[k].id];
        body.position = to.t;
        const Mat3 turn = to.R * from.R.transpose();
        if (turn.isIdentity(4.0 * kEpsilon)) continue;
        body.orientation = quaternion_multiply(exp_quaternion(log_rotation(turn)), body.orientation).normalized();
    }
    check_separation(model, separation, result);
    return result;
}

namespace {

Pose pose_of(const BodyState& body) { return {quaternion_to_matrix(body.orientation), body.position}; }

/// An object where a state has it, relative to some origin.
struct PlacedObject {
    const CollisionMesh* mesh;
    Pose pose;
    std::vector<Vec3> nodes;  // of a cloth
    BoxTree tree;

    PlacedObject(const Model& model, const SceneState& state, int object, const Vec3& origin) {
        if (model.is_cloth(object)) {
            const Cloth& cloth = model.cloth_of(object);
            mesh = &cloth.surface;
            for (int i = 0; i < cloth.node_count(); ++i)
                nodes.push_back(state.node_position[cloth.first_node + i] - origin);
        } else {
            mesh = &model.bodies[object].mesh;
            pose = pose_of(state.bodies[object]);
            pose.t -= origin;
        }
    }
    Surface surface() const {
        return nodes.empty() ? Surface{mesh, &pose, nullptr} : Surface{mesh, nullptr, nodes.data()};
    }
    /// Valid as long as this object stays where it is, until the next call.
    SweptMesh swept(double reach) {
        if (nodes.empty()) return {mesh, {pose, pose}, reach};
        SweptMesh result{mesh, {}, reach, nodes.data(), nodes.data()};
        tree = refitted_tree(result);
        result.tree = &tree;
        return result;
    }
    Box box() const {
        if (nodes.empty()) return transformed(mesh->tree.nodes[0].box, pose);
        Box result;
        for (const Vec3& x : nodes) result.include(x);
        return result;
    }
    /// The vertex nearest to x.
    Vec3 nearest_vertex(const Vec3& x) const {
        const Surface here = surface();
        Vec3 nearest = here.vertex(mesh->active_vertices[0]);
        for (int v : mesh->active_vertices) {
            const Vec3 vertex = here.vertex(v);
            if ((vertex - x).squaredNorm() < (nearest - x).squaredNorm()) nearest = vertex;
        }
        return nearest;
    }
};

/// The search of nearest_objects, one pair of objects after the other.
class NearestSearch {
public:
    NearestSearch(const Model& model, const SceneState& state) : m_model(model), m_state(state) {}

    NearestObjects run() {
        const int count = m_model.body_count() + m_model.cloth_count();
        for (int a = 0; a < count; ++a) {
            if (m_model.ground.present && m_model.yields(a)) measure_ground(a);
            if (m_model.is_cloth(a)) measure_self(a);
            for (int b = a + 1; b < count; ++b)
                if (m_model.yields(a) || m_model.yields(b)) measure_pair(a, b);
        }
        return m_nearest;
    }

private:
    void consider(double distance, int a, int b) {
        if (distance < m_nearest.distance) m_nearest = {distance, a, b};
    }

    Vec3 origin_of(int object) const {
        return m_model.is_cloth(object) ? m_state.node_position[m_model.cloth_of(object).first_node]
                                        : m_state.bodies[object].position;
    }

    void measure_ground(int object) {
        const PlacedObject placed(m_model, m_state, object, Vec3::Zero());
        const Surface surface = placed.surface();
        const double keep = m_model.ground.height + m_model.margin_sum(object, kGround);
        for (int v : placed.mesh->active_vertices) consider(surface.vertex(v).z() - keep, object, kGround);
    }

    void measure_pair(int a, int b) {
        const Vec3 origin = origin_of(a);
        PlacedObject placed_a(m_model, m_state, a, origin), placed_b(m_model, m_state, b, origin);
        const double margins = m_model.margin_sum(a, b);
        const Box box_a = placed_a.box(), box_b = placed_b.box();
        const Vec3 gap = (box_a.lower - box_b.upper).cwiseMax(box_b.lower - box_a.upper).cwiseMax(0.0);
        if (gap.norm() - margins >= m_nearest.distance) return;
        // Two vertices near each other bound the distance from above, and so how far to look for nearer features.
        const Vec3 vertex_b = placed_b.nearest_vertex(placed_a.nearest_vertex(box_b.center()));
        consider((placed_a.nearest_vertex(vertex_b) - vertex_b).norm() - margins, a, b);
        m_pairs.clear();
        const double reach = 0.5 * (m_nearest.distance + margins);
        collect_feature_pairs(placed_a.swept(reach), placed_b.swept(reach), m_pairs);
        for (const FeaturePair& f : m_pairs) {
            const Contact contact{a, b, f.type, f.feature_a, f.feature_b};
            consider(ContactGeometry(contact, placed_a.surface(), placed_b.surface(), 0.0).distance - margins, a, b);
        }
    }

    void measure_self(int object) {
        const Cloth& cloth = m_model.cloth_of(object);
        PlacedObject placed(m_model, m_state, object, origin_of(object));
        // A corner of a hinge is no further from the triangle across than from its corner.
        const Box box = placed.box();
        double bound = (box.upper - box.lower).norm();
        for (const ClothHinge& hinge : cloth.hinges)
            bound = std::min(bound, (placed.nodes[hinge.nodes[2]] - placed.nodes[hinge.nodes[3]]).norm());
        m_pairs.clear();
        // A little further than need be, for rounding.
        const double reach = 0.5 * std::min(m_nearest.distance, bound) + cloth.margin + 0.01 * bound;
        collect_self_pairs(placed.swept(reach), m_pairs);
        for (const FeaturePair& f : m_pairs) {
            const Contact contact{object, object, f.type, f.feature_a, f.feature_b};
            const double distance = ContactGeometry(contact, placed.surface(), placed.surface(), 0.0).distance;
            if (distance < m_nearest.distance + 2.0 * cloth.margin)
                consider(distance - contact_margins(m_model, contact), object, object);
        }
    }

    const Model& m_model;
    const SceneState& m_state;
    NearestObjects m_nearest;
    std::vector<FeaturePair> m_pairs;
};

}  // namespace

CrossingObjects find_crossing(const Model& model, const SceneState& state) {
    const std::size_t cloth_count = model.cloths.size();
    std::vector<SweptMesh> meshes;
    std::vector<BoxTree> trees;
    std::vector<Box> boxes;
    for (int i = 0; i < model.body_count(); ++i) {
        const Pose pose = pose_of(state.bodies[i]);
        meshes.push_back({&model.bodies[i].mesh, {pose, pose}, 0.0});
        boxes.push_back(transformed(model.bodies[i].mesh.tree.nodes[0].box, pose));
    }
    trees.reserve(cloth_count);  // meshes point into it
    for (const Cloth& cloth : model.cloths) {
        const Vec3* nodes = state.node_position.data() + cloth.first_node;
        SweptMesh mesh{&cloth.surface, {}, 0.0, nodes, nodes};
        trees.push_back(refitted_tree(mesh));
        mesh.tree = &trees.back();
        meshes.push_back(mesh);
        boxes.push_back(swept_box(mesh));
    }
    std::vector<std::pair<int, int>> pairs = overlapping_pairs(build_box_tree(boxes));
    for (int c = 0; c < model.cloth_count(); ++c) pairs.emplace_back(model.body_count() + c, model.body_count() + c);
    if (cloth_count > 0) std::sort(pairs.begin(), pairs.end());
    for (const auto& [a, b] : pairs) {
        if (!model.yields(a) && !model.yields(b)) continue;
        if (a == b ? crosses_itself(meshes[a]) : meshes_cross(meshes[a], meshes[b])) return {a, b};
    }
    return {};
}

NearestObjects nearest_objects(const Model& model, const SceneState& state) {
    return NearestSearch(model, state).run();
}

}  // namespace diffsim
