#include "check.hpp"
#include "step/touching_zones.hpp"

namespace test_touching_zones {

using namespace diffsim;

namespace {

using Ints = std::vector<int>;

/// Bodies 0 to 5, of which 2 is static, and cloths 6 and 7.
Model model() {
    Model result;
    result.bodies.resize(6);
    result.bodies[2].kind = BodyKind::static_;
    result.cloths.resize(2);
    return result;
}

/// `tag` tells contacts apart.
Contact contact(int a, int b, int tag) { return {a, b, ContactType::vertex_patch, tag, -1}; }

TouchingZones zones_of(const std::vector<std::vector<Contact>>& groups, bool with_exact, bool one_zone) {
    std::vector<ExactContact> exact;
    for (int tag = 0; tag < 10; ++tag) exact.push_back({0.5 * tag, 1.0 * tag});
    std::vector<ContactList> lists;
    for (const std::vector<Contact>& group : groups)
        lists.push_back({group.data(), exact.data(), nullptr, static_cast<int>(group.size())});
    TouchingZones zones;
    ZoneFinder().find(model(), {0, 1, 3, 4, 5, 6, 7}, lists, {with_exact, false, one_zone}, zones);
    return zones;
}

Ints tags(const TouchingZones& zones) {
    Ints result;
    for (const Contact& c : zones.contacts) result.push_back(c.feature_a);
    return result;
}

}  // namespace

TEST(zones_are_of_what_touches) {
    // 5 touches 1 and the static body, 3 the ground, cloth 6 touches 4; 0 nothing, and neither does cloth 7.
    const TouchingZones zones = zones_of(
        {{contact(5, 1, 0), contact(3, kGround, 1)}, {contact(4, 6, 2), contact(2, 5, 3)}, {contact(1, 5, 4)}}, false,
        false);
    CHECK(zones.count() == 4);
    CHECK(zones.bodies == Ints({1, 5, 3, 4}));
    CHECK(zones.body_end == Ints({2, 3, 4, 4}));
    CHECK(zones.cloths == Ints({0, 1}));
    CHECK(zones.cloth_end == Ints({0, 0, 1, 2}));
    CHECK(tags(zones) == Ints({0, 3, 4, 1, 2}));
    CHECK(zones.contact_end == Ints({3, 4, 5, 5}));
    CHECK(zones.exact.empty());
}

TEST(multipliers_go_with_their_contacts) {
    const TouchingZones zones =
        zones_of({{contact(3, kGround, 0), contact(1, 5, 1), contact(3, kGround, 2)}}, true, false);
    CHECK(tags(zones) == Ints({1, 0, 2}));
    CHECK(zones.exact.size() == 3);
    for (std::size_t k = 0; k < 3; ++k) {
        CHECK(zones.exact[k].shift == 0.5 * tags(zones)[k]);
        CHECK(zones.exact[k].compliance == 1.0 * tags(zones)[k]);
    }
}

TEST(one_zone_holds_everything_that_yields) {
    const TouchingZones zones = zones_of({{contact(3, kGround, 0)}, {contact(5, 1, 1)}}, false, true);
    CHECK(zones.count() == 1);
    CHECK(zones.bodies == Ints({0, 1, 3, 4, 5}));
    CHECK(zones.cloths == Ints({0, 1}));
    CHECK(zones.contact_end == Ints({2}));
}

TEST(what_a_finder_held_before_does_not_show) {
    ZoneFinder finder;
    TouchingZones zones;
    const Contact first = contact(0, 1, 0), second = contact(4, kGround, 1);
    const ExactContact exact{0.0, 1.0};
    finder.find(model(), {0, 1, 3, 4, 5, 6, 7}, {{&first, &exact, nullptr, 1}}, {true, false, false}, zones);
    finder.find(model(), {0, 1, 3, 4, 5, 6, 7}, {{&second, &exact, nullptr, 1}}, {}, zones);
    CHECK(zones.bodies == Ints({4}));
    CHECK(zones.count() == 3);
    CHECK(zones.exact.empty());
}

}  // namespace test_touching_zones
