#include <algorithm>

#include "solve/model_direction.hpp"
#include "zone/sides_of.hpp"

/// Which bodies and nodes the models of a zone hold back.
namespace diffsim {
namespace {

constexpr double kProximal = 1.0;  // of the inertia: the first damping of a body
constexpr double kMoreProximal = 4.0;
constexpr double kExcess = 0.1;  // of the largest excess of energy: contacts that ask for damping

}  // namespace

void ModelDirection::damp(const ZonePoint& trial, double rise) {
    std::vector<double> excess(trial.active.size());
    double largest = 0.0, sum = 0.0;
    for (std::size_t k = 0; k < trial.active.size(); ++k) {
        const ActiveContact& active = trial.active[k];
        const ZoneContact& contact = m_zone.contacts[active.index];
        const double force = m_forces[active.index];
        excess[k] = contact_energy(active.geometry, contact.law) - 0.5 * force * force / contact.law.stiffness.value;
        largest = std::max(largest, excess[k]);
        sum += std::max(excess[k], 0.0);
    }
    // Where that does not explain the rise, all bodies are damped.
    std::vector<char> marked(m_weight.size(), sum < 0.5 * rise ? 1 : 0);
    for (std::size_t k = 0; k < trial.active.size(); ++k) {
        if (!(excess[k] > kExcess * largest)) continue;
        const ZoneContact& contact = m_zone.contacts[trial.active[k].index];
        visit_movers(
            m_zone, contact,
            [&](int body) {
                if (m_zone.yields(body)) marked[body] = 1;
            },
            [&](int node) { marked[static_cast<std::size_t>(m_zone.dynamic_count + node)] = 1; });
    }
    for (std::size_t i = 0; i < m_weight.size(); ++i)
        if (marked[i]) m_weight[i] = std::max(kProximal, kMoreProximal * m_weight[i]);
}

void ModelDirection::relax() {
    for (double& weight : m_weight) weight = weight > kProximal ? weight / kMoreProximal : 0.0;
}

void ModelDirection::forget_damping() { std::fill(m_weight.begin(), m_weight.end(), 0.0); }

}  // namespace diffsim
