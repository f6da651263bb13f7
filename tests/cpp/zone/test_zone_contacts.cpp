#include "zone/zone_contacts.hpp"

#include <algorithm>
#include <set>
#include <tuple>

#include "cloth_fixtures.hpp"

namespace test_zone_contacts {

using namespace diffsim;
using fixtures::random_direction;
using fixtures::random_rotation;
using fixtures::random_vec3;

namespace {

constexpr double kThickness = 0.05;  // [m]

using Key = std::tuple<int, int, int, int, int>;

/// Whatever feature comes first: of one cloth, vertex before patch and the smaller edge first.
Key key(const Contact& c) {
    const bool same = c.object_a == c.object_b;
    const bool swap = same && (c.type == ContactType::patch_vertex ||
                               (c.type == ContactType::edge_edge && c.feature_a > c.feature_b));
    const ContactType type = same && c.type == ContactType::patch_vertex ? ContactType::vertex_patch : c.type;
    return {
        c.object_a, c.object_b, static_cast<int>(type), swap ? c.feature_b : c.feature_a,
        swap ? c.feature_a : c.feature_b};
}

/// Two free bodies, a fixed and a driven one, two cloths, above the ground.
struct Room {
    Model model;
    std::vector<ClothParameters> materials = {{0.5, 60.0, 20.0, 0.05, 0.0}, {0.5, 60.0, 20.0, 0.05, 0.0}};

    Room() {
        model.thickness = kThickness;
        model.ground = {true, -0.8, 0.5 * kThickness};
        const BodyKind kinds[] = {BodyKind::dynamic, BodyKind::dynamic, BodyKind::static_, BodyKind::kinematic};
        for (const BodyKind kind : kinds)
            model.bodies.push_back(
                fixtures::body(
                    kind == BodyKind::kinematic ? fixtures::tetrahedron(0.3) : fixtures::box(Vec3(0.3, 0.2, 0.1)),
                    0.5 * kThickness, kind));
        model.cloths.push_back(fixtures::cloth(fixtures::grid(6, 2, 0.2), 0.5 * kThickness));
        model.cloths.push_back(fixtures::cloth(fixtures::hexagon(0.3), 0.5 * kThickness));
        model.cloths[0].pinned[0] = 1;
        model.cloths[1].first_node = model.cloths[0].node_count();
    }
};

struct Case {
    Zone zone;
    PassiveBodies passive;
    Coordinates begin, end;
    ContactCoverage coverage;
};

Vec6 random_motion(check::Random& random, double size) {
    Vec6 y;
    y << random_vec3(random, 2.0 * size), random_vec3(random, size);
    return y;
}

Case random_case(const Room& room, check::Random& random, double motion) {
    Case c;
    Zone& zone = c.zone;
    make_zone(zone, room.model, room.materials, kDefaultCompliance, random_vec3(random));
    const auto pose = [&] { return Pose{random_rotation(random), random_vec3(random, 0.7) - zone.origin}; };
    for (int i = 0; i < 2; ++i) {
        zone.bodies.push_back(fixtures::zone_body(i, pose(), 1.0, 0.1 * Mat3::Identity()));
        c.begin.bodies.push_back(random_motion(random, 0.5 * motion));
        c.end.bodies.push_back(random_motion(random, motion));
    }
    zone.dynamic_count = 2;
    std::vector<PassiveBody> passive = {{2, pose(), Vec6::Zero()}, {3, pose(), random_motion(random, motion)}};
    for (PassiveBody& body : passive) body.start.t += zone.origin;
    c.passive = fixtures::passive_bodies(room.model, passive);
    for (int i = 0; i < 2; ++i) {
        const Cloth& cloth = room.model.cloths[i];
        const Pose place = pose();
        const std::vector<Vec3> roll =
            fixtures::shaken(i == 0 ? fixtures::rolled(cloth.rest, 0.15, 0.08) : cloth.rest, random, 0.02);
        fixtures::add_zone_cloth(zone, i, fixtures::moved(roll, place.R, place.t), room.materials[i], 0.01);
        const Vec3 common = random_vec3(random, 2.0 * motion);
        for (int k = 0; k < cloth.node_count(); ++k) {
            c.begin.nodes.push_back(random_vec3(random, 0.3 * motion));
            c.end.nodes.push_back(common + random_vec3(random, 0.5 * motion));
        }
    }
    collect_contacts(zone, c.passive, c.begin, c.end, c.coverage);
    return c;
}

/// Coordinates somewhere along the segment, each object at a time of its own, and off it by a part of the slack.
Coordinates random_coordinates(const Case& c, check::Random& random) {
    Coordinates y = c.begin;
    const auto between = [](double s, const auto& a, const auto& b) { return (a + s * (b - a)).eval(); };
    for (int i = 0; i < c.zone.body_count(); ++i) {
        y.bodies[i] = between(random.uniform(0.0, 1.0), c.begin.bodies[i], c.end.bodies[i]);
        if (i < c.zone.dynamic_count)
            y.bodies[i].tail<3>() += random.uniform(0.0, 1.0) * c.coverage.slack[i] * random_direction(random);
    }
    for (std::size_t k = 0; k < c.zone.cloths.size(); ++k) {
        const double s = random.uniform(0.0, 1.0);
        const int first = c.zone.cloths[k].first_node;
        for (int i = first; i < first + c.zone.cloth(static_cast<int>(k)).node_count(); ++i)
            y.nodes[i] = between(s, c.begin.nodes[i], c.end.nodes[i]) +
                         random.uniform(0.0, 1.0) * c.coverage.cloth_slack[k] * random_direction(random);
    }
    return y;
}

/// Everything that a zone could be in contact with, by its object; bodies that did not join are where they are told.
struct Placed {
    std::vector<Pose> poses;
    std::vector<Vec3> nodes;
    std::vector<Surface> surfaces;
    std::vector<char> yields;

    Placed(const Case& c, const Coordinates& y) {
        const Model& model = *c.zone.model;
        poses.resize(model.bodies.size());
        for (const PassiveBody& body : c.passive.bodies) {
            ZoneBody driven;
            driven.start = {body.start.R, body.start.t - c.zone.origin};
            poses[body.id] = pose_at(driven, body.target);
        }
        std::vector<Pose> zone_poses;
        place(c.zone, y, zone_poses, nodes);
        for (int i = 0; i < c.zone.body_count(); ++i) poses[c.zone.bodies[i].id] = zone_poses[i];
        for (std::size_t i = 0; i < poses.size(); ++i) {
            surfaces.push_back({&model.bodies[i].mesh, &poses[i], nullptr});
            yields.push_back(model.bodies[i].is_dynamic());
        }
        for (const ZoneCloth& cloth : c.zone.cloths) {
            surfaces.push_back({&model.cloths[cloth.id].surface, nullptr, nodes.data() + cloth.first_node});
            yields.push_back(1);
        }
    }
};

/// Call visit(contact, distance) for every pair of features that contact may act on.
template <class Visit>
void for_each_contact(const Case& c, const Placed& placed, const Visit& visit) {
    const int count = static_cast<int>(placed.surfaces.size());
    for (int a = 0; a < count; ++a) {
        const Surface& surface_of_a = placed.surfaces[a];
        if (placed.yields[a])
            for (int v : surface_of_a.mesh->active_vertices)
                visit(
                    Contact{a, kGround, ContactType::vertex_patch, v, -1},
                    surface_of_a.vertex(v).z() - c.zone.ground_height);
        for (int b = a; b < count; ++b) {
            if ((!placed.yields[a] && !placed.yields[b]) || (a == b && !c.zone.model->is_cloth(a))) continue;
            const Surface& surface_of_b = placed.surfaces[b];
            fixtures::for_each_pair_of_features(
                a, *surface_of_a.mesh, b, *surface_of_b.mesh, [&](const Contact& contact) {
                    visit(contact, ContactGeometry(contact, surface_of_a, surface_of_b, 0.0).distance);
                });
        }
    }
}

}  // namespace

TEST(every_pair_that_comes_to_rest_within_the_coverage_is_listed_once) {
    const Room room;
    check::Random random(1);
    int covered = 0;
    std::size_t cases_hit[4] = {0, 0, 0, 0};  // bodies, with cloth, cloth with itself, ground
    std::size_t listed = 0, all = 0;
    for (int k = 0; k < 40; ++k) {
        NOTE(k);
        const Case c = random_case(room, random, k % 4 == 0 ? 0.0 : 0.1);
        std::set<Key> keys;
        for (const ZoneContact& contact : c.zone.contacts) CHECK(keys.insert(key(contact.contact)).second);
        for (int sample = 0; sample < 8; ++sample) {
            NOTE(sample);
            const Coordinates y = random_coordinates(c, random);
            if (!is_covered(c.zone, c.coverage, y)) continue;
            ++covered;
            for_each_contact(c, Placed(c, y), [&](const Contact& contact, double distance) {
                ++all;
                if (!(distance < contact_margins(room.model, contact))) return;
                NOTE(contact.object_a);
                NOTE(contact.object_b);
                CHECK(keys.count(key(contact)) == 1);
                ++cases_hit
                    [contact.with_ground()                   ? 3
                     : contact.object_a == contact.object_b  ? 2
                     : room.model.is_cloth(contact.object_b) ? 1
                                                             : 0];
            });
        }
        listed += 8 * keys.size();
    }
    CHECK(covered >= 200);
    CHECK(listed < all / 2);
    for (const std::size_t hit : cases_hit) CHECK(hit >= 50);
}

TEST(coordinates_off_the_segment_are_not_covered) {
    const Room room;
    check::Random random(2);
    for (int k = 0; k < 20; ++k) {
        NOTE(k);
        const Case c = random_case(room, random, 0.1);
        CHECK(is_covered(c.zone, c.coverage, c.begin));
        CHECK(is_covered(c.zone, c.coverage, c.end));
        Coordinates y = c.end;
        y.bodies[k % 2].tail<3>() += 2.0 * c.coverage.slack[k % 2] * random_direction(random) +
                                     2.0 * (c.end.bodies[k % 2] - c.begin.bodies[k % 2]).tail<3>();
        CHECK(!is_covered(c.zone, c.coverage, y));
        y = c.end;
        y.nodes[k % c.zone.node_count()].x() += 10.0;
        CHECK(!is_covered(c.zone, c.coverage, y));
    }
}

TEST(a_body_whose_way_has_left_a_list_gets_more_room_in_the_next_one) {
    const Room room;
    check::Random random(4);
    for (int k = 0; k < 20; ++k) {
        NOTE(k);
        Case c = random_case(room, random, 0.02);
        const std::size_t stray = static_cast<std::size_t>(k % 2);
        c.end.bodies[stray].tail<3>() += 2.0 * c.coverage.slack[stray] * Vec3::UnitZ() +
                                         2.0 * (c.end.bodies[stray] - c.begin.bodies[stray]).tail<3>();
        CHECK(!is_covered(c.zone, c.coverage, c.end));
        ContactCoverage first;
        collect_contacts(c.zone, c.passive, c.begin, c.end, first);
        collect_contacts(c.zone, c.passive, c.begin, c.end, c.coverage);
        CHECK(c.coverage.slack[1 - stray] == first.slack[1 - stray]);
        CHECK(c.coverage.slack[stray] > first.slack[stray]);
        const CollisionMesh& mesh = c.zone.mesh(static_cast<int>(stray));
        CHECK(c.coverage.slack[stray] < first.slack[stray] + mesh.radius / 3.0);
        // It keeps that in all lists of the step.
        const double slack = c.coverage.slack[stray];
        collect_contacts(c.zone, c.passive, c.begin, c.end, c.coverage);
        CHECK(c.coverage.slack[stray] == slack);
    }
}

TEST(contacts_name_their_objects_and_blocks) {
    const Room room;
    check::Random random(3);
    std::size_t cases_hit = 0;
    for (int k = 0; k < 20; ++k) {
        const Case c = random_case(room, random, 0.1);
        const Zone& zone = c.zone;
        for (const ZoneContact& contact : zone.contacts) {
            const auto check_side = [&](int object, int body, int cloth) {
                if (object == kGround) {
                    CHECK(body == kGround);
                } else if (room.model.is_cloth(object)) {
                    CHECK(body == kNobody);
                    CHECK(room.model.body_count() + zone.cloths[cloth].id == object);
                } else {
                    CHECK(cloth == -1);
                    CHECK(zone.bodies[body].id == object);
                }
            };
            check_side(contact.contact.object_a, contact.a, contact.cloth_a);
            check_side(contact.contact.object_b, contact.b, contact.cloth_b);
            const bool two_bodies = zone.yields(contact.a) && zone.yields(contact.b);
            CHECK((contact.block >= 0) == two_bodies);
            if (two_bodies)
                CHECK(
                    zone.contacts.blocks[contact.block] ==
                    std::pair(std::min(contact.a, contact.b), std::max(contact.a, contact.b)));
            CHECK(contact.law.range.rest == contact_margins(room.model, contact.contact));
            cases_hit += contact.cloth_b >= 0 ? 1 : 0;
        }
    }
    CHECK(cases_hit >= 100);
}

TEST(features_that_are_near_at_rest_keep_half_their_distance) {
    Model model;
    model.thickness = 0.2;
    model.cloths.push_back(fixtures::cloth(fixtures::grid(4, 1, 0.1), 0.1));
    // A vertex and the triangle across the diagonal, 0.1 / √2 from each other; one at the other end of the sheet.
    const Contact near{0, 0, ContactType::vertex_patch, 1, 1}, far{0, 0, ContactType::vertex_patch, 4, 1};
    CHECK_NEAR(contact_margins(model, near), 0.05 / std::sqrt(2.0), 1e-15);
    CHECK_NEAR(contact_margins(model, far), 0.5 * std::sqrt(0.1), 1e-15);
    model.cloths[0].margin = 0.01;
    CHECK(contact_margins(model, near) == 0.02);
}

TEST(pairs_left_out_have_not_come_near) {
    const Room room;
    check::Random random(6);
    int left_out = 0, looked_at = 0, active = 0;
    for (int k = 0; k < 60; ++k) {
        NOTE(k);
        const Case c = random_case(room, random, k % 3 == 0 ? 0.003 : 0.03);
        ZonePoint before;
        before.y = random_coordinates(c, random);
        evaluate(c.zone, before);
        // On from there, twice: bounds may follow from bounds.
        for (int hop = 0; hop < 2; ++hop) {
            ZonePoint all, some;
            all.y = some.y = random_coordinates(c, random);
            evaluate(c.zone, all);
            evaluate(c.zone, some, &before);
            CHECK(some.energy == all.energy);
            CHECK(some.contact_energy == all.contact_energy);
            CHECK(some.active.size() == all.active.size());
            for (std::size_t i = 0; i < all.active.size(); ++i) CHECK(some.active[i].index == all.active[i].index);
            for (std::size_t i = 0; i < all.distances.size(); ++i) {
                const bool known = some.distances[i] == all.distances[i];
                CHECK((known || some.distances[i] > c.zone.contacts.law(i).range.rest));
                CHECK(some.distances[i] <= all.distances[i] + 1e-15);
                (known ? looked_at : left_out) += 1;
            }
            active += static_cast<int>(all.active.size());
            before = some;
        }
    }
    CHECK(left_out > 1000);
    CHECK(looked_at > 1000);
    CHECK(active > 100);
}

TEST(an_allowed_step_keeps_cloth_above_its_floor) {
    const Room room;
    check::Random random(4);
    int stopped = 0, allowed = 0;
    for (int k = 0; k < 300 && stopped < 25; ++k) {
        NOTE(k);
        Case c = random_case(room, random, k % 3 == 0 ? 0.01 : 0.3);
        // Bodies stay, so that all vertices go straight.
        for (Vec6& y : c.begin.bodies) y.setZero();
        c.end.bodies = c.begin.bodies;
        for (PassiveBody& body : c.passive.bodies) body.target.setZero();
        c.zone.bodies.resize(2);
        c.begin.bodies.resize(2);
        c.end.bodies.resize(2);
        collect_contacts(c.zone, c.passive, c.begin, c.end, c.coverage);
        ZonePoint point;
        point.y = c.begin;
        evaluate(c.zone, point);
        bool apart = true;
        for (std::size_t i = 0; i < c.zone.contacts.size(); ++i)
            apart = apart && point.distances[i] > c.zone.contacts.law(i).range.floor;
        if (!apart) continue;
        std::vector<Impact> impacts;
        const double step = allowed_step(c.zone, point, c.end, &impacts);
        CHECK(step > 0.0);
        CHECK((step < 1.0 || impacts.empty()));
        CHECK(allowed_step(c.zone, point, c.end, nullptr) == step);
        double nearest = kInfinity;
        for (const double part : {0.25, 0.5, 0.75, 0.9, 1.0}) {
            Coordinates y = c.begin;
            for (int i = 0; i < c.zone.node_count(); ++i)
                y.nodes[i] += part * step * (c.end.nodes[i] - c.begin.nodes[i]);
            for_each_contact(c, Placed(c, y), [&](const Contact& contact, double distance) {
                const ContactRange range = contact_range(contact_margins(room.model, contact), kThickness);
                if (contact.object_b < room.model.body_count() && contact.object_b != kGround) return;
                if (contact.object_b == kGround && contact.object_a < room.model.body_count()) return;
                NOTE(contact.object_a);
                NOTE(contact.object_b);
                CHECK(distance > range.pole);
                if (part == 1.0) nearest = std::min(nearest, (distance - range.pole) / (range.floor - range.pole));
            });
        }
        if (step < 1.0) {
            CHECK(nearest < 1.3);  // it ends where something is about to touch
            ++stopped;
        } else {
            ++allowed;
        }
    }
    CHECK(stopped >= 15);
    CHECK(allowed >= 1);
}

TEST(contacts_with_a_driven_body_are_listed_for_all_its_way) {
    // A free box that stands, and a driven one that comes near it: by a way on which it stands still, too.
    Model model;
    model.thickness = kThickness;
    for (const BodyKind kind : {BodyKind::dynamic, BodyKind::kinematic})
        model.bodies.push_back(fixtures::body(fixtures::box(Vec3(0.3, 0.2, 0.1)), 0.5 * kThickness, kind));
    std::vector<ClothParameters> materials;
    Zone zone;
    make_zone(zone, model, materials, kDefaultCompliance, Vec3::Zero());
    zone.bodies.push_back(fixtures::zone_body(0, Pose(), 1.0, Mat3::Identity()));
    zone.dynamic_count = 1;
    const Vec6 target = -0.4 * Vec6::Unit(3);  // and so ends half the thickness from the other
    const Vec3 place(1.0 + 0.5 * kThickness, 0.0, 0.0);
    const PassiveBodies passive = fixtures::passive_bodies(model, {{1, {Mat3::Identity(), place}, target}});
    Coordinates begin, end;
    begin.assign_zero(1, 0);
    end.assign_zero(1, 0);
    ContactCoverage coverage;
    collect_contacts(zone, passive, begin, end, coverage);
    CHECK(zone.body_count() == 2);
    CHECK(end.bodies[1] == target);
    const auto listed = [&] {
        std::set<Key> keys;
        for (const ZoneContact& contact : zone.contacts) keys.insert(key(contact.contact));
        return keys;
    };
    const std::set<Key> all = listed();
    CHECK(all.size() >= 8);
    end.bodies[1].setZero();
    collect_contacts(zone, passive, begin, end, coverage);
    CHECK(listed() == all);
    begin.bodies[1] = end.bodies[1] = 0.5 * target;
    collect_contacts(zone, passive, begin, end, coverage);
    CHECK(listed() == all);
}

}  // namespace test_zone_contacts
