#include "zone/gmres.hpp"

namespace diffsim {

double mass_dot(const Zone& zone, const Coordinates& a, const Coordinates& b) {
    double sum = 0.0;
    for (std::size_t i = 0; i < a.bodies.size(); ++i) sum += a.bodies[i].dot(mass_times(zone.bodies[i], b.bodies[i]));
    for (std::size_t i = 0; i < a.nodes.size(); ++i) sum += zone.nodes[i].mass * a.nodes[i].dot(b.nodes[i]);
    return sum;
}

}  // namespace diffsim
