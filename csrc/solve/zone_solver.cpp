#include "solve/zone_solver.hpp"

#include <algorithm>
#include <cmath>
#include <optional>
#include <utility>

#include "parallel/interrupt.hpp"
#include "solve/model_direction.hpp"
#include "solve/multiplier_rounds.hpp"
#include "solve/newton_direction.hpp"
#include "solve/zone_balance.hpp"

namespace diffsim {
namespace {

constexpr double kArmijo = 1e-4;
constexpr int kMaxHalvings = 50;
constexpr double kExactTolerance = 1e-9;  // on an exact contact's distance, of its range
constexpr int kMaxMultiplierRounds = 50;
constexpr double kNearSolution = 1e-4;  // residual below which the plain Newton step ends it
constexpr int kMaxModelFactors = 1000;  // of a zone with cloth: from there on impacts just stop it
constexpr int kStagnantSteps = 6;       // without halving the residual: rounding's sign
constexpr int kFutileSteps = 50;        // without a lower energy: there is none to be found
constexpr double kContraction = 0.1;    // of the residual: steps with an old factor that do less are not worth it
constexpr double kHeld = 0.1;           // of the way to its target: a body that moved less is held by something
constexpr double kShortWay = 0.1;       // of a body's radius

/// State of one solve; the steps of solve_zone as members.
class ZoneSolver : private ZoneSearch {
public:
    using ZoneSearch::ZoneSearch;

    ZoneResult solve() {
        start();
        if (m_options.full_steps) {
            take_full_steps(*m_options.full_steps);
            return m_result;
        }
        m_work.friction.clear();
        if (m_result.status == StepStatus::bad_start || try_free_motion()) return m_result;
        go_to_warm_start();
        m_near = is_one_body();  // a factor costs hardly more than the gradient alone
        find_solution();
        if (m_zone.exact_contact) multiplier_rounds();
        return m_result;
    }

private:
    bool is_one_body() const { return m_zone.dynamic_count == 1 && m_zone.nodes.empty(); }

    // --- start -------------------------------------------------------------------------------------------------

    void start() {
        const std::size_t count = static_cast<std::size_t>(m_zone.dynamic_count);
        m_work.point.y.assign_zero(count, m_zone.nodes.size());
        m_work.y_end.resize(count, m_zone.nodes.size());
        set_to_expected_ends(m_work.y_end);
        m_path.list_contacts(m_work.y_end);
        evaluate(m_zone, m_work.point);
        bool rescue = false;  // some objects start the step below their floor
        for (std::size_t k = 0; k < m_zone.contacts.size(); ++k) {
            const ContactRange& range = m_zone.contacts.law(k).range;
            rescue = rescue || m_work.point.distances[k] < range.floor;
            if (m_work.point.distances[k] > range.limit + 4.0 * kEpsilon * range.rest) continue;
            m_result.status = StepStatus::bad_start;
            m_result.worst_contact = static_cast<int>(k);
            return;
        }
        if (rescue) m_path.rescue();
        m_swept.assign(count + m_zone.cloths.size(), Box());
        mark_swept();
        // That of one body is made if ever it is asked for, which at rest without friction it is not.
        if (is_one_body() && !m_zone.contacts.with_friction) return;
        make_model();
        m_model->start_from(m_work.point);
    }

    /// The targets, but for bodies that something seems to hold: they hardly moved in the last step, and lists that
    /// reach to their targets would be full of neighbours that they never meet.
    void set_to_expected_ends(Coordinates& y_end) const {
        m_path.set_to_targets(y_end);
        for (std::size_t i = 0; i < y_end.bodies.size(); ++i) {
            const ZoneBody& body = m_zone.bodies[i];
            const double radius = m_zone.mesh(static_cast<int>(i)).radius;
            const auto extent = [&](const Vec6& y) { return y.tail<3>().norm() + radius * y.head<3>().norm(); };
            const double falling = extent(body.target);
            if (falling < kShortWay * radius && extent(body.last_motion) < kHeld * falling)
                y_end.bodies[i] = body.last_motion;
        }
    }

    /// Nothing touches on the way to the target and there: done without an iteration.
    bool try_free_motion() {
        m_work.y_end.bodies.resize(m_zone.bodies.size());
        m_path.set_to_targets(m_work.y_end);
        const bool touching = !m_work.point.active.empty();
        if (touching && !may_pass(m_zone, m_work.y_end)) return false;
        m_path.ensure_covered(m_work.y_end);
        if ((m_zone.dynamic_count > 0 || !m_zone.elastic) &&
            allowed_step(m_zone, m_work.point, m_work.y_end, nullptr) < 1.0) {
            m_result.fast_impacts = m_path.set_gates(m_work.y_end);
            return false;
        }
        if (touching) return false;
        if (!m_zone.cloths.empty() && m_zone.elastic) return false;
        m_work.trial.y = m_work.y_end;
        evaluate(m_zone, m_work.trial, &m_work.point);
        if (!m_work.trial.active.empty()) return false;
        accept_trial();
        return true;
    }

    /// Last step's motion already respected last step's contacts: it is the natural first iterate.
    void go_to_warm_start() {
        m_work.y_end = y();
        for (int i = 0; i < m_zone.dynamic_count; ++i) m_work.y_end.bodies[i] = m_zone.bodies[i].last_motion;
        for (int i = 0; i < m_zone.node_count(); ++i)
            if (!m_zone.nodes[i].pinned)
                m_work.y_end.nodes[i] = m_zone.nodes[i].guess.value_or(m_zone.nodes[i].last_motion);
        if (largest_move() < kEpsilon * m_path.position()) return;
        m_path.ensure_covered(m_work.y_end);
        // Impacts on the way stop it short of the contacts. Near their poles it would start with more energy than y = 0
        // has, and descend from there to minimisers that no motion of that energy can reach.
        const double step = m_path.clear_step(m_work.y_end, Clearance::landing);
        if (step > 0.0 && m_work.trial.energy <= m_work.point.energy) accept_trial();
    }

    // --- Newton ------------------------------------------------------------------------------------------------

    double slope(const Coordinates& gradient) const {
        double sum = 0.0;
        for (int i = 0; i < m_zone.dynamic_count; ++i)
            sum += gradient.bodies[i].dot(m_work.y_end.bodies[i] - m_work.point.y.bodies[i]);
        for (int i = 0; i < m_zone.node_count(); ++i)
            sum += gradient.nodes[i].dot(m_work.y_end.nodes[i] - m_work.point.y.nodes[i]);
        return sum;
    }

    double largest_move() const {
        double largest = 0.0;
        for (int i = 0; i < m_zone.dynamic_count; ++i) {
            const Vec6 move = m_work.y_end.bodies[i] - m_work.point.y.bodies[i];
            largest = std::max({largest, move.tail<3>().norm(), move.head<3>().norm() * m_zone.mesh(i).radius});
        }
        for (int i = 0; i < m_zone.node_count(); ++i)
            largest = std::max(largest, (m_work.y_end.nodes[i] - m_work.point.y.nodes[i]).norm());
        return largest;
    }

    /// Backtrack along the way to y_end until the energy falls. At rest its fall drowns in rounding: there the slope
    /// tells. False if no step does.
    bool line_search(double first_step) {
        m_trial_is_differentiated = false;
        const double slope0 = slope(m_work.derivatives.gradient);
        const double noise = current_noise();
        double step = first_step;
        for (int k = 0; k < kMaxHalvings && step > 0.0; ++k, step *= 0.5) {
            if (step == 1.0)
                m_work.trial.y = m_work.y_end;
            else
                m_path.set_trial(m_work.y_end, step);
            if (step < 1.0 && k > 0 && allowed_step(m_zone, m_work.point, m_work.trial.y, nullptr) < 1.0) continue;
            evaluate(m_zone, m_work.trial, &m_work.point);
            const double change = m_work.trial.energy - m_work.point.energy;
            m_newton_full = step == 1.0;
            if (change <= kArmijo * step * slope0) return true;
            if (change <= noise) {
                differentiate(m_zone, m_work.trial, Curvature::none, m_work.trial_derivatives, nullptr);
                const double slope1 = std::abs(slope(m_work.trial_derivatives.gradient));
                if (slope1 <= std::max(0.9 * std::abs(slope0), noise)) {
                    m_trial_is_differentiated = true;
                    return true;
                }
            }
        }
        return false;
    }

    /// Whether the gradient alone says that a Newton step reached the minimum, or came so near that further steps with
    /// the factor at hand reach it. If so, takes the last of them past the tolerance: another factor would
    /// only show the same. The gradient is worth its price where factors are dear, with cloth, and where
    /// the line search has it anyway.
    bool converge_with_factor() {
        const bool with_cloth = !m_zone.nodes.empty() && m_zone.elastic;
        if (!m_newton.has_factor() || !(with_cloth || (m_newton.is_exact() && m_trial_is_differentiated))) return false;
        const double stiffness = m_work.derivatives.largest_stiffness;  // known only with a Hessian
        for (double before = m_result.residual;;) {
            if (m_trial_is_differentiated)
                std::swap(m_work.derivatives, m_work.trial_derivatives);
            else
                differentiate(m_zone, m_work.point, Curvature::none, m_work.derivatives, nullptr);
            m_trial_is_differentiated = false;
            m_work.derivatives.largest_stiffness = stiffness;
            const Accuracy now = current_accuracy();
            const bool done = now.residual < std::max(m_options.tolerance, now.floor);
            if (!done && !(with_cloth && now.residual < kContraction * before)) return false;
            if (!m_newton.repeat(m_zone, m_work.derivatives, m_work.system, m_work.step)) return false;
            set_step_end();
            m_result.residual = before = now.residual;
            const bool moved = polish();
            if (done) return true;
            if (!moved) return false;
        }
    }

    /// Where the Newton step ends.
    void set_step_end() {
        m_work.y_end = y();
        for (int i = 0; i < m_zone.dynamic_count; ++i) m_work.y_end.bodies[i] += m_work.step.bodies[i];
        for (int i = 0; i < m_zone.node_count(); ++i)
            if (!m_zone.nodes[i].pinned) m_work.y_end.nodes[i] += m_work.step.nodes[i];
    }

    /// By descent for as long as no contact with friction is near, then by balance.
    void find_solution() {
        if (!m_zone.contacts.with_friction) iterate();
        if (!m_zone.contacts.with_friction || m_result.status != StepStatus::converged) return;
        if (!m_model) make_model();
        find_balance(*this, *m_model);
    }

    void make_model() { m_model.emplace(m_zone, m_path, m_work.point, m_work.system); }

    void iterate() {
        int stalls = 0;
        double best_residual = kInfinity;
        int stagnant = 0;  // steps since the residual last halved
        double lowest_energy = kInfinity;
        int futile = 0;  // steps since it fell by more than rounding may do
        for (;; ++m_result.iterations) {
            if (m_options.interrupt != nullptr) m_options.interrupt->throw_if_asked();
            if (m_zone.contacts.with_friction) return;
            const bool driven = drives_done();
            if (m_result.iterations < m_options.max_iterations) {
                const ModelStep step = take_model_step(driven, stalls);
                if (step == ModelStep::blocked) return fail(StepStatus::blocked);
                if (step == ModelStep::taken) continue;
            }
            if (!m_newton.compute(m_zone, m_work.point, m_work.derivatives, m_work.system, m_work.step))
                return fail(StepStatus::no_descent);
            const Accuracy now = current_accuracy();
            m_result.residual = now.residual;
            if (driven && leave_saddle(now)) continue;
            set_step_end();
            const double rounding_step = 16.0 * kEpsilon * m_path.position();
            if (driven && (now.residual < std::max(m_options.tolerance, now.floor) || largest_move() < rounding_step)) {
                polish();
                return;
            }
            if (m_near && m_result.iterations == 0 && now.residual > kNearSolution) {
                m_near = false;
                --m_result.iterations;
                continue;
            }
            const double good = kGoodEnough * std::max(m_options.tolerance, now.floor);
            stagnant = now.residual < 0.5 * best_residual ? 0 : stagnant + 1;
            best_residual = std::min(best_residual, now.residual);
            if (driven && stagnant >= kStagnantSteps && now.residual < good) return;
            const bool lower = m_work.point.energy < lowest_energy - current_noise();
            futile = driven && !lower ? futile + 1 : 0;
            if (lower || !driven) lowest_energy = m_work.point.energy;
            if (futile >= kFutileSteps) return fail(StepStatus::no_descent);
            if (m_result.iterations >= m_options.max_iterations) return fail(StepStatus::too_many_iterations);

            // The step's end may lie where contacts have not been listed yet. New ones are beyond their rest distance
            // here, so energy and derivatives stand.
            m_path.ensure_covered(m_work.y_end);
            double step = allowed_step(m_zone, m_work.point, m_work.y_end, nullptr);
            if (step < 1.0 || !m_path.gates_hold(m_work.y_end)) step = m_path.arc_step(m_work.y_end, step);
            if (line_search(step)) {
                m_near = m_newton.is_exact() && m_newton_full;
                accept_trial();
                const bool is_last = m_result.iterations + 1 >= m_options.max_iterations;
                if (driven && !is_last && converge_with_factor()) {
                    ++m_result.iterations;
                    return;
                }
            } else if (driven) {
                if (now.residual >= good) fail(StepStatus::no_descent);
                return;
            }
        }
    }

    /// Near a point of balance that is a saddle of the energy, where descent hardly moves: go off it along
    /// negative curvature, by the largest part of the contacts' range that lowers the energy. Once is
    /// enough: from there descent goes on.
    bool leave_saddle(const Accuracy& now) {
        if (m_left_saddle || !m_zone.nodes.empty() || m_newton.is_exact() || now.residual > kNearSolution) return false;
        m_left_saddle = true;
        const Coordinates newton_step = m_work.step;
        if (m_newton.off_saddle(m_zone, m_work.derivatives, m_work.system, m_work.step) && follow_off_saddle())
            return true;
        m_work.step = newton_step;
        return false;
    }

    /// Go along the direction in m_work.step. False where that lowers the energy nowhere.
    bool follow_off_saddle() {
        if (m_work.point.active.empty()) return false;
        set_step_end();
        double range = kInfinity;
        for (const ActiveContact& active : m_work.point.active) {
            const ContactRange& r = m_zone.contacts.law(active.index).range;
            range = std::min(range, r.rest - r.floor);
        }
        const double scale = range / largest_move();
        for (Vec6& s : m_work.step.bodies) s *= scale;
        set_step_end();
        m_path.ensure_covered(m_work.y_end);
        if (!line_search(m_path.arc_step(m_work.y_end, 1.0))) return false;
        accept_trial();
        return true;
    }

    /// (M + dt² K) Δy = -dE/dy, so often. From y = 0 that is  (M + dt² K) v1 = M v0 + dt f  [Qiao et al. 2020, Eq. 3].
    void take_full_steps(int count) {
        for (int i = 0; i < m_zone.node_count(); ++i)
            if (m_zone.nodes[i].pinned) y().nodes[i] = m_zone.nodes[i].target;
        evaluate(m_zone, m_work.point);
        for (m_result.iterations = 0; m_result.iterations < count; ++m_result.iterations) {
            if (!m_newton.compute(m_zone, m_work.point, m_work.derivatives, m_work.system, m_work.step))
                return fail(StepStatus::no_descent);
            m_work.trial.y = y();
            for (int i = 0; i < m_zone.node_count(); ++i) m_work.trial.y.nodes[i] += m_work.step.nodes[i];
            evaluate(m_zone, m_work.trial, &m_work.point);
            if (!std::isfinite(m_work.trial.energy)) return fail(StepStatus::no_descent);
            std::swap(m_work.point, m_work.trial);
        }
        differentiate(m_zone, m_work.point, Curvature::none, m_work.derivatives, nullptr);
        m_result.residual = current_accuracy().residual;
    }

    /// Far from the solution: go where the model of all near contacts leads, the whole way.
    enum class ModelStep { taken, near, blocked };
    ModelStep take_model_step(bool driven, int& stalls) {
        if ((m_near || m_model_factors > kMaxModelFactors) && driven) return ModelStep::near;
        differentiate(m_zone, m_work.point, Curvature::none, m_work.derivatives, nullptr);
        m_result.residual = current_accuracy().residual;
        if (driven && m_result.residual < kNearSolution) return ModelStep::near;
        m_newton.lose_factor();
        if (!m_model) make_model();
        const ModelDirection::Way way = m_model->find(m_work.derivatives.gradient, driven, m_work.y_end);
        if (!m_zone.nodes.empty()) m_model_factors += way.newton_steps;
        if (!way.found) return ModelStep::near;
        const double step = m_path.covered_step(m_work.y_end, way.free);
        if (!driven) {
            const DriveProgress progress = advance_drives(step, stalls);
            if (progress == DriveProgress::blocked) return ModelStep::blocked;
            if (progress == DriveProgress::moved) accept_trial();
            return way.squeezes && step < kSqueeze ? ModelStep::blocked : ModelStep::taken;
        }
        if (!(step > 0.0)) return ModelStep::near;
        m_path.set_trial(m_work.y_end, step);
        if (step == 1.0) m_work.trial.y = m_work.y_end;
        evaluate(m_zone, m_work.trial, &m_work.point);
        const double change = m_work.trial.energy - m_work.point.energy, noise = current_noise();
        if (change > noise) {
            // What rises with bodies is the contacts' energy, where rows are not true to them. Cloth
            // buckles: a shorter step will do.
            if (m_zone.nodes.empty() || !line_search(m_path.arc_step(m_work.y_end, 0.5 * step))) {
                m_model->damp(m_work.trial, change);
                return ModelStep::taken;
            }
        }
        accept_trial();
        m_model->relax();
        m_near = change > -noise || (step == 1.0 && m_model->knew_who_pushes());
        return ModelStep::taken;
    }

    /// One more full step, also past the tolerance: it takes the solution to rounding, which gradients feel.
    /// False if there is nothing to gain.
    bool polish() {
        if (m_work.derivatives.largest_force == 0.0 && m_result.residual == 0.0) return false;
        if (!m_path.covers(m_work.y_end)) return false;
        if (allowed_step(m_zone, m_work.point, m_work.y_end, nullptr) < 1.0) return false;
        m_work.trial.y = m_work.y_end;
        evaluate(m_zone, m_work.trial, &m_work.point);
        if (!(m_work.trial.energy <= m_work.point.energy + current_noise())) return false;
        accept_trial();
        return true;
    }

    /// Rounds of multipliers until exact contacts are at their rest distance.
    void multiplier_rounds() {
        for (int round = 0; m_result.status == StepStatus::converged; ++round) {
            const double violation = MultiplierRounds::violation(m_zone, m_work.point, m_path.position());
            if (violation <= kExactTolerance) return;
            if (round >= kMaxMultiplierRounds) return fail(StepStatus::too_many_iterations);
            m_path.shift_contacts(m_rounds.stiffening(m_zone, violation));
            find_solution();
        }
    }

    MultiplierRounds m_rounds;
    std::optional<ModelDirection> m_model;  // made when first asked: most bodies at rest never do
    NewtonDirection m_newton;
    bool m_trial_is_differentiated = false;  // the one that the line search accepted
    bool m_newton_full = false;              // the last line search took the whole step
    int m_model_factors = 0;                 // of models with cloth so far
    bool m_left_saddle = false;
    bool m_near = false;  // the last model step was a Newton step: nothing that pushes changed
};

}  // namespace

ZoneResult solve_zone(
    Zone& zone, const PassiveBodies& passive, const ZoneOptions& options, ZoneWorkspace& workspace,
    std::vector<Box>& swept) {
    return ZoneSolver(zone, passive, options, workspace, swept).solve();
}

}  // namespace diffsim
