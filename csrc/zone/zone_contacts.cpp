#include "zone/zone_contacts.hpp"

#include <algorithm>
#include <cmath>

#include "collision/ccd.hpp"
#include "zone/motion_bounds.hpp"
#include "zone/sides_of.hpp"

namespace diffsim {
namespace {

constexpr double kRoom = 0.05;     // of its thickness: room on all sides of a body at rest
constexpr double kSidestep = 0.1;  // of a body's motion: room on all sides of it. More lists neighbours it never meets.
constexpr double kStray = 0.5;  // of its motion: where a way of the body has left a list, which its next ones do, too
constexpr double kOfFeature = 0.2;    // of the size of its features, at most: more lists them in numbers
constexpr double kWholeMotion = 0.5;  // of a cloth's motion in the step: counts as motion yet to come

SweptMesh swept_mesh(const Zone& zone, int body, const Vec6& begin, const Vec6& end, double slack) {
    const ZoneBody& b = zone.bodies[body];
    return {&zone.mesh(body), {pose_at(b, begin), pose_at(b, end)}, zone.model->bodies[b.id].margin + slack};
}

/// A cloth between two places, in the zone's frame.
struct SweptCloth {
    std::vector<Vec3> begin, end;
    BoxTree tree;

    /// Valid as long as this object stays where it is.
    SweptMesh mesh(const Cloth& cloth, double reach) const {
        return {&cloth.surface, {}, reach, begin.data(), end.data(), tree.empty() ? nullptr : &tree};
    }
};

/// Largest motion of a cloth's node relative to their mean.
double uneven_motion(const ZoneCloth& cloth, int count, const Coordinates& begin, const Coordinates& end) {
    const Vec3 mean = mean_motion(cloth, count, begin, end);
    double uneven_sq = 0.0;
    for (int i = cloth.first_node; i < cloth.first_node + count; ++i)
        uneven_sq = std::max(uneven_sq, (end.nodes[i] - begin.nodes[i] - mean).squaredNorm());
    return std::sqrt(uneven_sq);
}

SweptCloth sweep_cloth(
    const Zone& zone, int index, const Coordinates& begin, const Coordinates& end, const Vec3& shift, double reach) {
    const Cloth& cloth = zone.cloth(index);
    const int first = zone.cloths[index].first_node;
    SweptCloth swept;
    for (int i = first; i < first + cloth.node_count(); ++i) {
        swept.begin.push_back(zone.nodes[i].start + begin.nodes[i]);
        swept.end.push_back(zone.nodes[i].start + end.nodes[i] - shift);
    }
    swept.tree = refitted_tree(swept.mesh(cloth, reach));
    return swept;
}

/// Let bodies that do not yield join the zone where its moving bodies come near them.
void join_passive(
    Zone& zone, const PassiveBodies& passive, const std::vector<Box>& dynamic_boxes, Coordinates& begin,
    Coordinates& end) {
    std::vector<int> near;
    for (Box box : dynamic_boxes) {
        box.lower += zone.origin;
        box.upper += zone.origin;
        query(passive.tree, box, near);
    }
    std::sort(near.begin(), near.end());
    near.erase(std::unique(near.begin(), near.end()), near.end());
    for (int k : near) {
        const PassiveBody& body = passive.bodies[k];
        const auto is_it = [&](const ZoneBody& other) { return other.id == body.id; };
        if (std::any_of(zone.bodies.begin() + zone.dynamic_count, zone.bodies.end(), is_it)) continue;
        ZoneBody joined;
        joined.id = body.id;
        joined.start = {body.start.R, body.start.t - zone.origin};
        joined.target = body.target;
        zone.bodies.push_back(joined);
        begin.bodies.push_back(Vec6::Zero());
        end.bodies.push_back(body.target);
    }
}

/// Of two objects the geometric mean.
void set_friction(const Zone& zone, const Contact& contact, ContactLaw& law) {
    const Model& model = *zone.model;
    const std::size_t a = static_cast<std::size_t>(contact.object_a);
    const double mu_b =
        contact.with_ground() ? zone.friction->back() : (*zone.friction)[static_cast<std::size_t>(contact.object_b)];
    law.friction = std::sqrt((*zone.friction)[a] * mu_b);
    const double margins = model.margin_sum(contact.object_a, contact.object_b);
    if (margins > 0.0) law.margin_share = model.margin(contact.object_a) / margins;
}

}  // namespace

double contact_margins(const Model& model, const Contact& contact) {
    const double margins = model.margin_sum(contact.object_a, contact.object_b);
    if (contact.object_a != contact.object_b) return margins;
    const Cloth& cloth = model.cloth_of(contact.object_a);
    const Surface rest{&cloth.surface, nullptr, cloth.rest.data()};
    return std::min(margins, 0.5 * ContactGeometry(contact, rest, rest, 0.0).distance);
}

void add_contact(Zone& zone, const Contact& contact, ZoneObject a, ZoneObject b) {
    ContactSet& set = zone.contacts;
    const bool own_law = a.cloth >= 0 || b.cloth >= 0 || zone.exact_contact;
    if (set.append(contact, a, b, own_law)) {
        const ContactRange range = contact_range(
            contact_margins(*zone.model, contact), zone.model->pair_thickness(contact.object_a, contact.object_b));
        set.laws.push_back({range, {}});
        set.laws.back().stiffness = with_sides(zone, set[set.size() - 1], [&](const auto& side_a, const auto& side_b) {
            return contact_stiffness(side_a.mass(), side_b.mass(), zone.contacts.memory.compliance);
        });
        if (zone.friction != nullptr) {
            set_friction(zone, contact, set.laws.back());
            set.with_friction = set.with_friction || set.laws.back().friction > 0.0;
        }
    }
    list_feature_vertices(zone, set[set.size() - 1]);
}

namespace {

/// How far a vertex of a body at most is from where it is listed for.
double deviation(const Zone& zone, const ContactCoverage& coverage, const Coordinates& y, int body) {
    const std::size_t i = static_cast<std::size_t>(body);
    const Vec6 segment = coverage.end.bodies[i] - coverage.begin.bodies[i];
    const Vec6 offset = y.bodies[i] - coverage.begin.bodies[i];
    const double radius = zone.mesh(body).radius;
    // Nearest point of the segment, with turns weighed by the radius.
    Vec6 weighed = segment;
    weighed.head<3>() *= radius * radius;
    const double length_sq = weighed.dot(segment);
    const double s = length_sq > 0.0 ? std::clamp(weighed.dot(offset) / length_sq, 0.0, 1.0) : 0.0;
    return motion_bound(offset - s * segment, radius);
}

/// Collects the contacts of a zone; its steps as members.
class ContactLister {
public:
    ContactLister(
        Zone& zone, const PassiveBodies& passive, Coordinates& begin, Coordinates& end, ContactCoverage& coverage)
        : m_zone(zone),
          m_passive(passive),
          m_begin(begin),
          m_end(end),
          m_coverage(coverage),
          m_meshes(coverage.scratch.meshes),
          m_boxes(coverage.scratch.boxes),
          m_feature_boxes(coverage.scratch.feature_boxes),
          m_vertices(coverage.scratch.vertices),
          m_features(coverage.scratch.features) {}

    void run() {
        mark_strays();
        m_zone.contacts.clear();
        m_coverage.slack.clear();
        m_coverage.cloth_slack.clear();
        m_meshes.clear();
        m_boxes.clear();
        for (int i = 0; i < m_zone.dynamic_count; ++i) add_body(i);
        if (m_zone.contacts_off) {
            m_coverage.cloth_slack.assign(m_zone.cloths.size(), kInfinity);
            m_coverage.begin = m_begin;
            m_coverage.end = m_end;
            return;
        }
        const std::size_t cloth_count = m_zone.cloths.size();
        m_cloths.reserve(cloth_count);  // meshes point into it
        std::vector<SweptMesh> cloth_meshes;
        for (int c = 0; c < static_cast<int>(cloth_count); ++c) cloth_meshes.push_back(add_cloth(c));
        if (!m_passive.bodies.empty()) {
            std::vector<Box> yielding = m_boxes;
            for (const SweptMesh& mesh : cloth_meshes) yielding.push_back(swept_box(mesh));
            join_passive(m_zone, m_passive, yielding, m_begin, m_end);
        }
        for (int i = m_zone.dynamic_count; i < m_zone.body_count(); ++i) add_body(i);
        for (const SweptMesh& mesh : cloth_meshes) {
            m_meshes.push_back(mesh);
            m_boxes.push_back(swept_box(mesh));
        }
        if (m_zone.model->ground.present) list_ground();
        if (m_meshes.size() > 1) list_pairs();
        for (int c = 0; c < static_cast<int>(cloth_count); ++c) list_self(c);
        m_coverage.begin = m_begin;
        m_coverage.end = m_end;
    }

private:
    /// Objects by their place in m_meshes: the bodies, then the cloths.
    ZoneObject object(int i) const {
        return i < m_zone.body_count() ? ZoneObject{i, -1} : ZoneObject{kNobody, i - m_zone.body_count()};
    }
    int id(int i) const {
        return i < m_zone.body_count() ? m_zone.bodies[i].id
                                       : m_zone.model->body_count() + m_zone.cloths[i - m_zone.body_count()].id;
    }
    bool yields(int i) const { return i < m_zone.dynamic_count || i >= m_zone.body_count(); }

    void mark_strays() {
        const std::size_t count = static_cast<std::size_t>(m_zone.dynamic_count);
        std::vector<char>& strays = m_coverage.strays;
        if (strays.empty()) {
            strays.assign(count, 0);
            return;
        }
        for (std::size_t i = 0; i < count; ++i)
            strays[i] = strays[i] || deviation(m_zone, m_coverage, m_end, static_cast<int>(i)) > m_coverage.slack[i];
    }

    /// Room on all sides of the way of a body that yields.
    double room(int i, double motion) const {
        const CollisionMesh& mesh = m_zone.mesh(i);
        double sidestep = kSidestep * motion;
        if (m_coverage.strays[static_cast<std::size_t>(i)]) {
            const double feature = mesh.radius / std::sqrt(static_cast<double>(mesh.patches.size()));
            sidestep = std::max(sidestep, std::min(kStray * motion, kOfFeature * feature));
        }
        return kRoom * m_zone.model->own_thickness(id(i)) + sidestep;
    }

    void add_body(int i) {
        const double radius = m_zone.mesh(i).radius;
        const bool yields = i < m_zone.dynamic_count;
        // A driven body goes all its way sooner or later, whatever the way at hand.
        const Vec6& end = yields ? m_end.bodies[i] : m_zone.bodies[i].target;
        const Vec6 change = end - m_begin.bodies[i];
        // Late ways are short, but they may turn: room in proportion to the step's whole motion, too.
        const double motion = std::max(motion_bound(change, radius), motion_bound(end, radius));
        const double slack = yields ? room(i, motion) : 0.0;
        if (yields) m_coverage.slack.push_back(slack);
        m_meshes.push_back(swept_mesh(m_zone, i, m_begin.bodies[i], end, slack + sagitta(change, radius)));
        m_boxes.push_back(swept_box(m_meshes.back()));
    }

    SweptMesh add_cloth(int c) {
        const ZoneCloth& cloth = m_zone.cloths[c];
        const Cloth& model = m_zone.cloth(c);
        // Late iterations are short, but they may turn: room in proportion to the step's whole motion, too.
        Coordinates start;
        start.assign_zero(0, m_zone.nodes.size());
        const double uneven = std::max(
            uneven_motion(cloth, model.node_count(), m_begin, m_end),
            kWholeMotion * uneven_motion(cloth, model.node_count(), start, m_end));
        const double thickness = m_zone.model->own_thickness(m_zone.model->body_count() + cloth.id);
        const double slack = 0.5 * thickness + 0.25 * uneven;
        m_coverage.cloth_slack.push_back(slack);
        m_cloths.push_back(sweep_cloth(m_zone, c, m_begin, m_end, Vec3::Zero(), model.margin + slack));
        return m_cloths.back().mesh(model, model.margin + slack);
    }

    void list_ground() {
        for (int i = 0; i < static_cast<int>(m_meshes.size()); ++i) {
            if (!yields(i)) continue;
            m_vertices.clear();
            collect_vertices_below(m_meshes[i], m_zone.ground_height + m_zone.model->ground_margin(id(i)), m_vertices);
            for (int v : m_vertices)
                add_contact(m_zone, {id(i), kGround, ContactType::vertex_patch, v, -1}, object(i), {kGround, -1});
        }
    }

    void list_pairs() {
        if (m_feature_boxes.size() < m_meshes.size()) m_feature_boxes.resize(m_meshes.size());
        for (std::size_t i = 0; i < m_meshes.size(); ++i) m_feature_boxes[i].assign(m_meshes[i]);
        for (const auto& [i, j] : overlapping_pairs(m_boxes)) {
            if (!yields(i) && !yields(j)) continue;
            m_features.clear();
            collect_feature_pairs(m_feature_boxes[i], m_feature_boxes[j], m_features);
            if (j >= m_zone.body_count()) drop_distant_pairs(m_meshes[i], m_meshes[j], m_features);
            if (m_features.empty()) continue;
            for (const FeaturePair& f : m_features)
                add_contact(m_zone, {id(i), id(j), f.type, f.feature_a, f.feature_b}, object(i), object(j));
            if (j >= m_zone.dynamic_count) continue;
            m_zone.contacts.pairs.back().block = static_cast<int>(m_zone.contacts.blocks.size());
            m_zone.contacts.blocks.emplace_back(i, j);
        }
    }

    /// A cloth with itself: what it does as a whole brings none of its features together.
    void list_self(int c) {
        const Cloth& model = m_zone.cloth(c);
        const Vec3 mean = mean_motion(m_zone.cloths[c], model.node_count(), m_begin, m_end);
        const double reach = model.margin + m_coverage.cloth_slack[c];
        const SweptCloth swept = sweep_cloth(m_zone, c, m_begin, m_end, mean, reach);
        m_features.clear();
        const SweptMesh mesh = swept.mesh(model, reach);
        collect_self_pairs(mesh, m_features);
        drop_distant_pairs(mesh, mesh, m_features);
        const int object_id = m_zone.model->body_count() + m_zone.cloths[c].id;
        for (const FeaturePair& f : m_features)
            add_contact(m_zone, {object_id, object_id, f.type, f.feature_a, f.feature_b}, {kNobody, c}, {kNobody, c});
    }

    Zone& m_zone;
    const PassiveBodies& m_passive;
    Coordinates &m_begin, &m_end;
    ContactCoverage& m_coverage;
    std::vector<SweptMesh>& m_meshes;
    std::vector<Box>& m_boxes;
    std::vector<SweptBoxes>& m_feature_boxes;
    std::vector<int>& m_vertices;
    std::vector<FeaturePair>& m_features;
    std::vector<SweptCloth> m_cloths;
};

/// Whether a cloth's nodes are near the points that they pass at one and the same time of the segment.
bool is_cloth_covered(const Zone& zone, const ContactCoverage& coverage, int index, const Coordinates& y) {
    const int first = zone.cloths[index].first_node, end = first + zone.cloth(index).node_count();
    double along = 0.0, length_sq = 0.0;
    for (int i = first; i < end; ++i) {
        const Vec3 segment = coverage.end.nodes[i] - coverage.begin.nodes[i];
        along += segment.dot(y.nodes[i] - coverage.begin.nodes[i]);
        length_sq += segment.squaredNorm();
    }
    const double s = length_sq > 0.0 ? std::clamp(along / length_sq, 0.0, 1.0) : 0.0;
    const double slack_sq = coverage.cloth_slack[index] * coverage.cloth_slack[index];
    for (int i = first; i < end; ++i) {
        const Vec3 segment = coverage.end.nodes[i] - coverage.begin.nodes[i];
        if ((y.nodes[i] - coverage.begin.nodes[i] - s * segment).squaredNorm() > slack_sq) return false;
    }
    return true;
}

}  // namespace

void collect_contacts(
    Zone& zone, const PassiveBodies& passive, Coordinates& begin, Coordinates& end, ContactCoverage& coverage) {
    ContactLister(zone, passive, begin, end, coverage).run();
}

bool is_covered(const Zone& zone, const ContactCoverage& coverage, const Coordinates& y) {
    for (int i = 0; i < zone.dynamic_count; ++i)
        if (deviation(zone, coverage, y, i) > coverage.slack[static_cast<std::size_t>(i)]) return false;
    for (int c = 0; c < static_cast<int>(zone.cloths.size()); ++c)
        if (!is_cloth_covered(zone, coverage, c, y)) return false;
    return true;
}

namespace {

/// Where everything is at the end of a motion; found when first asked for, since most motions bring no pair near.
class MotionEnd {
public:
    MotionEnd(const Zone& zone, const Coordinates& y) : m_zone(zone), m_y(y) {}

    template <class Side>
    Surface surface(const Side& side) {
        if (m_poses.empty() && m_nodes.empty()) place(m_zone, m_y, m_poses, m_nodes);
        return side.surface(m_poses, m_nodes);
    }

private:
    const Zone& m_zone;
    const Coordinates& m_y;
    std::vector<Pose> m_poses;
    std::vector<Vec3> m_nodes;
};

}  // namespace

double allowed_step(
    const Zone& zone, const ZonePoint& point, const Coordinates& y_end, std::vector<Impact>* impacts,
    Clearance clearance) {
    if (impacts != nullptr) impacts->clear();
    if (zone.contacts.empty()) return 1.0;
    MotionBounds motion(zone, point.y, y_end);
    MotionEnd end(zone, y_end);
    double step = 1.0;
    for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
        const ZoneContact& contact = zone.contacts[k];
        // A pair that is already nearer than the floor may use up most of what is left above the pole.
        const double room = point.distances[k] - contact.law.range.pole;
        CcdOptions ccd;
        const double wanted = clearance == Clearance::floor ? contact.law.range.floor : contact.law.range.landing;
        const double keep =
            std::min(wanted - contact.law.range.pole, (clearance == Clearance::floor ? 0.1 : 0.8) * room);
        ccd.min_distance = contact.law.range.pole + keep;
        ccd.tolerance = 0.2 * keep;
        if (impacts == nullptr) ccd.until = step;
        if (ccd.until * motion.approach(contact) < room - 1.2 * keep) continue;
        const double toi = with_sides(zone, contact, [&](const auto& a, const auto& b) {
            return contact_toi(
                contact.contact, {a.surface(point.poses, point.nodes), end.surface(a)},
                {b.surface(point.poses, point.nodes), end.surface(b)}, zone.ground_height, ccd);
        });
        if (toi == kNoImpact) continue;
        step = std::min(step, toi);
        if (impacts != nullptr) impacts->push_back({static_cast<int>(k), toi});
    }
    return step;
}

}  // namespace diffsim
