#include "contact/zone_solver.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>
#include <tuple>

#include "contact/impact_gate.hpp"

namespace diffsim {
namespace {

constexpr double kArmijo = 1e-4;
constexpr int kMaxHalvings = 50;
constexpr int kMaxStalls = 3;            // steps in a row that get a driven body nowhere
constexpr double kStall = 1e-3;          // of the way that is left
constexpr double kHardTolerance = 1e-9;  // on a hard contact's distance, of its range
constexpr int kMaxHardRounds = 50;
constexpr double kSlowRound = 0.1;          // of what was left of a violation: stiffer contacts leave less
constexpr double kStiffening = 10.0;        // of contacts, after a slow round
constexpr double kLeastCompliance = 1e-10;  // of contacts that were stiffened
constexpr int kRelaxations = 8;             // Newton steps after driven bodies were stopped, before they go on
constexpr double kRelaxed = 1e-2;           // residual at which they may go on earlier
constexpr double kGoodEnough = 1e3;         // times the tolerance: enough where rounding hides all further descent
constexpr int kStagnantSteps = 6;           // without halving the residual: rounding's sign
constexpr int kFutileSteps = 50;            // without a lower energy: there is none to be found
constexpr int kMaxQpSteps = 6000;           // Newton steps of a cloth's impact QPs: from there on impacts just stop it,
constexpr int kStepsWithoutQp = 200;        // so many steps
constexpr CutShare kSmallestCut = 1.0 / 256.0;
constexpr CutShare kFirstCut = 1.0 / 16.0;  // where the exact Hessian is found to be indefinite
constexpr double kCutFactor = 4.0;
constexpr double kContraction = 0.1;       // of the residual: steps with an old factor that do less are not worth it
constexpr double kUnsettling = 1e-10;      // of the largest force: as little as the tolerance lets pass
constexpr double kClampedStep = 0.999999;  // a step this long was not stopped by CCD in any way that matters

/// A hard contact and the shift of its rest distance.
struct ShiftedContact {
    Contact contact;
    double shift;

    bool operator<(const ShiftedContact& other) const {
        const Contact &c = contact, &d = other.contact;
        return std::tie(c.object_a, c.object_b, c.type, c.feature_a, c.feature_b) <
               std::tie(d.object_a, d.object_b, d.type, d.feature_a, d.feature_b);
    }
};

/// State of one solve; the steps of solve_zone as members.
class ZoneSolver {
public:
    ZoneSolver(
        Zone& zone, const PassiveBodies& passive, const ZoneOptions& options, ZoneWorkspace& workspace,
        std::vector<Box>& visited)
        : m_zone(zone),
          m_passive(passive),
          m_options(options),
          m_w(workspace),
          m_visited(visited),
          m_coverage(workspace.coverage) {}

    ZoneResult solve() {
        start();
        if (m_options.full_steps) {
            take_full_steps(*m_options.full_steps);
            return m_result;
        }
        if (m_result.status == ZoneStatus::bad_start || try_free_motion()) return m_result;
        go_to_warm_start();
        iterate();
        if (m_zone.hard) harden();
        return m_result;
    }

private:
    Coordinates& y() { return m_w.point.y; }

    // --- start -------------------------------------------------------------------------------------------------

    void start() {
        const std::size_t count = static_cast<std::size_t>(m_zone.dynamic_count);
        m_zone.bodies.resize(count);  // those that do not yield join anew
        m_w.point.y.assign_zero(count, m_zone.nodes.size());
        m_w.y_end.resize(count, m_zone.nodes.size());
        set_to_targets(m_w.y_end);
        list_contacts(m_w.y_end);
        evaluate(m_zone, m_w.point);
        for (std::size_t k = 0; k < m_zone.contacts.size(); ++k) {
            const ContactRange& range = m_zone.contacts[k].range;
            m_rescue = m_rescue || m_w.point.distances[k] < range.floor;
            if (m_w.point.distances[k] > range.limit + 4.0 * kEpsilon * range.rest) continue;
            m_result.status = ZoneStatus::bad_start;
            m_result.worst_contact = static_cast<int>(k);
            return;
        }
        if (m_rescue) {
            rescue_contacts(m_zone);
            evaluate(m_zone, m_w.point);
        }
        m_visited.assign(count + m_zone.cloths.size(), Box());
        mark_visited();
    }

    void set_to_targets(Coordinates& y_end) const {
        for (std::size_t i = 0; i < y_end.bodies.size(); ++i) y_end.bodies[i] = m_zone.bodies[i].target;
        for (std::size_t i = 0; i < y_end.nodes.size(); ++i) y_end.nodes[i] = m_zone.nodes[i].target;
    }

    /// List contacts for the way from the current point to y_end.
    void list_contacts(Coordinates& y_end) {
        collect_contacts(m_zone, m_passive, y(), y_end, m_coverage);
        if (m_rescue) rescue_contacts(m_zone);
        restore_shifts();
        m_position = m_zone.model->thickness;
        if (m_zone.model->ground.present) m_position = std::max(m_position, std::abs(m_zone.ground_height));
        for (int i = 0; i < m_zone.body_count(); ++i) {
            const ZoneBody& body = m_zone.bodies[i];
            m_position = std::max(m_position, body.start.t.cwiseAbs().maxCoeff() + m_zone.mesh(i).radius);
        }
        for (const ZoneNode& node : m_zone.nodes) m_position = std::max(m_position, node.start.cwiseAbs().maxCoeff());
        m_w.system.set_pattern(base_pattern(m_zone));
    }

    /// Make the list complete for a step to y_end; true if it had to be made anew.
    bool ensure_covered(Coordinates& y_end) {
        if (is_covered(m_zone, m_coverage, y()) && is_covered(m_zone, m_coverage, y_end)) return false;
        list_contacts(y_end);
        evaluate(m_zone, m_w.point);
        return true;
    }

    void mark_visited() {
        for (int i = 0; i < m_zone.dynamic_count; ++i)
            m_visited[i].include(transformed(m_zone.mesh(i).tree.nodes[0].box, m_w.point.poses[i]));
        for (int c = 0; c < static_cast<int>(m_zone.cloths.size()); ++c) {
            Box& box = m_visited[static_cast<std::size_t>(m_zone.dynamic_count + c)];
            const int first = m_zone.cloths[c].first_node;
            for (int i = first; i < first + m_zone.cloth(c).node_count(); ++i) box.include(m_w.point.nodes[i]);
        }
    }

    /// Nothing touches on the way to the target and there: done without an iteration.
    bool try_free_motion() {
        m_w.y_end.bodies.resize(m_zone.bodies.size());
        set_to_targets(m_w.y_end);
        const bool touching = !m_w.point.active.empty();
        if (touching && !may_pass(m_zone, m_w.y_end)) return false;
        if ((m_zone.dynamic_count > 0 || !m_zone.elastic) &&
            allowed_step(m_zone, m_w.point, m_w.y_end, nullptr) < 1.0) {
            m_gates = find_impact_gates(m_zone, m_w.point, m_w.y_end);
            for (const ImpactGate& gate : m_gates) m_result.fast_impacts += gate.fast ? 1 : 0;
            return false;
        }
        if (touching) return false;
        if (!m_zone.cloths.empty() && m_zone.elastic) return false;
        m_w.trial.y = m_w.y_end;
        evaluate(m_zone, m_w.trial);
        if (!m_w.trial.active.empty()) return false;
        accept_trial();
        return true;
    }

    /// Last step's motion already respected last step's contacts: it is the natural first iterate.
    void go_to_warm_start() {
        m_w.y_end = y();
        for (int i = 0; i < m_zone.dynamic_count; ++i) m_w.y_end.bodies[i] = m_zone.bodies[i].warm;
        for (int i = 0; i < m_zone.node_count(); ++i)
            if (!m_zone.nodes[i].pinned) m_w.y_end.nodes[i] = m_zone.nodes[i].warm;
        if (largest_move() < kEpsilon * m_position) return;
        ensure_covered(m_w.y_end);
        // Impacts on the way stop it short of the contacts. Near their poles it would start with more energy than y = 0 has, and
        // descend from there to minimisers that no motion of that energy can reach.
        const double step = clear_step(m_w.y_end, Clearance::landing);
        if (step > 0.0 && m_w.trial.energy <= m_w.point.energy) accept_trial();
    }

    // --- moving ------------------------------------------------------------------------------------------------

    void accept_trial() {
        std::swap(m_w.point, m_w.trial);
        mark_visited();
    }

    /// Evaluate the trial at the longest allowed part of the way to y_end. A shortened arc is not on the chord that was
    /// checked, so it is checked again. 0 if no part is allowed.
    double clear_step(const Coordinates& y_end, Clearance clearance = Clearance::floor) {
        double step = 1.0;
        m_w.trial.y = y_end;
        for (int k = 0; k < kMaxHalvings; ++k) {
            const double allowed = allowed_step(m_zone, m_w.point, m_w.trial.y, nullptr, clearance);
            if (allowed == 1.0 && gates_hold(m_gates, m_zone, m_w.trial.y)) {
                evaluate(m_zone, m_w.trial);
                if (m_w.trial.energy < kInfinity) return step;
            }
            step *= allowed < 1.0 ? allowed : 0.5;
            set_trial(y_end, step);
        }
        return 0.0;
    }

    void set_trial(const Coordinates& y_end, double step) {
        m_w.trial.y.resize(y_end.bodies.size(), y_end.nodes.size());
        for (std::size_t i = 0; i < y_end.bodies.size(); ++i)
            m_w.trial.y.bodies[i] = y().bodies[i] + step * (y_end.bodies[i] - y().bodies[i]);
        for (std::size_t i = 0; i < y_end.nodes.size(); ++i)
            m_w.trial.y.nodes[i] = y().nodes[i] + step * (y_end.nodes[i] - y().nodes[i]);
    }

    bool drives_done() const {
        for (int i = m_zone.dynamic_count; i < m_zone.body_count(); ++i)
            if (m_w.point.y.bodies[i] != m_zone.bodies[i].target) return false;
        for (int i = 0; i < m_zone.node_count(); ++i)
            if (m_zone.nodes[i].pinned && m_w.point.y.nodes[i] != m_zone.nodes[i].target) return false;
        return true;
    }

    // --- Newton ------------------------------------------------------------------------------------------------

    struct Accuracy {
        double residual;  ///< relative
        double floor;     ///< what rounding leaves of it
    };

    Accuracy accuracy() const {
        double residual = 0.0, reference = m_w.derivatives.largest_force;
        for (int i = 0; i < m_zone.dynamic_count; ++i) {
            const ZoneBody& body = m_zone.bodies[i];
            const Vec6& g = m_w.derivatives.gradient.bodies[i];
            residual = std::max(residual, scaled(body.inverse_inertia, 1.0 / body.mass, g));
            reference = std::max(reference, scaled(body.inertia, body.mass, body.warm - body.target));
        }
        for (int i = 0; i < m_zone.node_count(); ++i) {
            const ZoneNode& node = m_zone.nodes[i];
            if (node.pinned) continue;
            const double root_mass = std::sqrt(node.mass);
            residual = std::max(residual, m_w.derivatives.gradient.nodes[i].norm() / root_mass);
            reference = std::max(reference, (node.warm - node.target).norm() * root_mass);
        }
        // Nothing pushes here and nothing did before: only the exact answer will do, or a step lost in rounding.
        if (!(reference > 0.0)) return {residual > 0.0 ? 1.0 : 0.0, 0.0};
        return {residual / reference, kEpsilon * m_position * m_w.derivatives.largest_stiffness / reference};
    }

    static double scaled(const Mat3& turn_metric, double shift_metric, const Vec6& v) {
        const Vec3 turn = v.head<3>();
        return std::sqrt(turn.dot(turn_metric * turn) + shift_metric * v.tail<3>().squaredNorm());
    }

    /// The Newton step, from the exact Hessian where that is positive definite. False if rounding spoils even what is taken
    /// otherwise.
    bool newton_step() {
        if (m_zone.nodes.empty()) return factorize_bodies() && solve_for_step(m_factor_is_exact ? 0.0 : kUnsettling);
        return factorize_with_cloth() && solve_for_step();
    }

    /// Without the contacts' curvature where the exact Hessian is not positive definite. Next to their stiffness and to the
    /// bodies' inertia the positive part of that curvature is nothing, and costs eigenvalues of every contact.
    bool factorize_bodies() {
        for (const Curvature curvature : {Curvature::full, Curvature::dropped}) {
            differentiate(m_zone, m_w.point, curvature, m_w.derivatives, &m_w.system);
            m_factor_is_exact = curvature == Curvature::full;
            m_has_factor = m_w.system.factorize();
            if (m_has_factor) return true;
        }
        return false;
    }

    /// Cut off no more negative curvature than needed, since it is what a sheet follows when it buckles: the share that it
    /// takes is searched from one iteration to the next.
    bool factorize_with_cloth() {
        bool failed = false;
        for (;;) {
            differentiate(m_zone, m_w.point, Curvature::full, m_w.derivatives, &m_w.system, m_cut);
            m_factor_is_exact = m_cut == kNothingCut;
            m_has_factor = m_w.system.factorize();
            if (m_has_factor) break;
            if (m_cut == kAllCut) return false;
            failed = true;
            m_cut = m_cut == kNothingCut ? kFirstCut : std::min(kCutFactor * m_cut, kAllCut);
        }
        if (!failed) {
            m_cut /= kCutFactor;
            if (m_cut < kSmallestCut) m_cut = kNothingCut;
        }
        return true;
    }

    /// `unsettling`: share of the largest force that pushes bodies about.
    bool solve_for_step(double unsettling = 0.0) {
        m_w.step.resize(static_cast<std::size_t>(m_zone.dynamic_count), m_zone.nodes.size());
        for (int i = 0; i < m_zone.dynamic_count; ++i) m_w.step.bodies[i] = -m_w.derivatives.gradient.bodies[i];
        if (unsettling > 0.0) unsettle(unsettling * m_w.derivatives.largest_force);
        for (int i = 0; i < m_zone.node_count(); ++i) m_w.step.nodes[i] = -m_w.derivatives.gradient.nodes[i];
        m_w.system.solve_in_place(m_w.step);
        for (const Vec6& s : m_w.step.bodies)
            if (!s.allFinite()) return false;
        for (const Vec3& s : m_w.step.nodes)
            if (!s.allFinite()) return false;
        return true;
    }

    /// Push every body in a direction of its own, that nothing but its index decides. Where the Hessian is indefinite the
    /// zone may be on a saddle of its energy. Rounding leads away from it, but where bodies stand in a regular pattern it
    /// does so at the pattern's ends only, and the others follow one by one.
    void unsettle(double force) {
        for (int i = 0; i < m_zone.dynamic_count; ++i) {
            const ZoneBody& body = m_zone.bodies[i];
            std::minstd_rand random(static_cast<std::uint32_t>(body.id) + 1);
            random.discard(1);
            const double scale = force * std::sqrt(body.mass);
            for (int k = 3; k < 6; ++k)
                m_w.step.bodies[i][k] += scale * (2.0 * static_cast<double>(random()) / std::minstd_rand::max() - 1.0);
        }
    }

    double slope(const Coordinates& gradient) const {
        double sum = 0.0;
        for (int i = 0; i < m_zone.dynamic_count; ++i)
            sum += gradient.bodies[i].dot(m_w.y_end.bodies[i] - m_w.point.y.bodies[i]);
        for (int i = 0; i < m_zone.node_count(); ++i)
            sum += gradient.nodes[i].dot(m_w.y_end.nodes[i] - m_w.point.y.nodes[i]);
        return sum;
    }

    double largest_move() const {
        double largest = 0.0;
        for (int i = 0; i < m_zone.dynamic_count; ++i) {
            const Vec6 move = m_w.y_end.bodies[i] - m_w.point.y.bodies[i];
            largest = std::max({largest, move.tail<3>().norm(), move.head<3>().norm() * m_zone.mesh(i).radius});
        }
        for (int i = 0; i < m_zone.node_count(); ++i)
            largest = std::max(largest, (m_w.y_end.nodes[i] - m_w.point.y.nodes[i]).norm());
        return largest;
    }

    /// What rounding can do to the energy. The errors of one body's contacts may all add up. Those of different bodies are
    /// independent: their sum grows with the root of their number.
    double energy_noise() {
        double force_sum = 0.0;
        m_w.pushed.assign(static_cast<std::size_t>(m_zone.dynamic_count), 0.0);
        for (const ActiveContact& active : m_w.point.active) {
            const ZoneContact& contact = m_zone.contacts[active.index];
            const double pole = contact.range.rest - contact.range.pole;
            const double force =
                contact_potential(contact.range.rest - active.geometry.distance, pole, contact.stiffness.value).force;
            const bool yields_a = m_zone.yields(contact.a), yields_b = m_zone.yields(contact.b);
            if (yields_a) m_w.pushed[contact.a] += force;
            if (yields_b) m_w.pushed[contact.b] += force;
            if (!yields_a && !yields_b) force_sum += force;
        }
        double square_sum = 0.0;
        for (double force : m_w.pushed) square_sum += force * force;
        force_sum += std::sqrt(square_sum);
        // The elements' forces |f| = sqrt(2 k E), by Cauchy-Schwarz Σ |f| <= sqrt(2 Σk ΣE).
        double stiffness_sum = 0.0;
        for (int i = 0; i < m_zone.node_count(); ++i)
            if (!m_zone.nodes[i].pinned) stiffness_sum += m_w.system.node_diagonal(i).trace();
        force_sum += std::sqrt(2.0 * stiffness_sum * m_w.point.elastic_energy);
        return 1e-15 * std::abs(m_w.point.energy) + 8.0 * kEpsilon * m_position * force_sum;
    }

    /// Backtrack along the way to y_end until the energy falls. At rest its fall drowns in rounding: there the slope
    /// tells. False if no step does.
    bool line_search(double first_step) {
        m_trial_is_differentiated = false;
        const double slope0 = slope(m_w.derivatives.gradient);
        const double noise = energy_noise();
        double step = first_step;
        for (int k = 0; k < kMaxHalvings && step > 0.0; ++k, step *= 0.5) {
            if (step == 1.0)
                m_w.trial.y = m_w.y_end;
            else
                set_trial(m_w.y_end, step);
            if (step < 1.0 && k > 0 && allowed_step(m_zone, m_w.point, m_w.trial.y, nullptr) < 1.0) continue;
            evaluate(m_zone, m_w.trial);
            const double change = m_w.trial.energy - m_w.point.energy;
            if (change <= kArmijo * step * slope0) return true;
            if (change <= noise) {
                differentiate(m_zone, m_w.trial, Curvature::none, m_w.trial_derivatives, nullptr);
                const double slope1 = std::abs(slope(m_w.trial_derivatives.gradient));
                if (slope1 <= std::max(0.9 * std::abs(slope0), noise)) {
                    m_trial_is_differentiated = true;
                    return true;
                }
            }
        }
        return false;
    }

    /// Whether the gradient alone says that a Newton step reached the minimum, or came so near that further steps with
    /// the factor at hand reach it. If so, takes the last of them past the tolerance: another factor would only show the
    /// same. The gradient is worth its price where factors are dear, with cloth, and where the line search has it anyway.
    bool finish_with_this_factor() {
        const bool with_cloth = !m_zone.nodes.empty() && m_zone.elastic;
        if (!m_has_factor || !(with_cloth || (m_factor_is_exact && m_trial_is_differentiated))) return false;
        const double stiffness = m_w.derivatives.largest_stiffness;  // known only with a Hessian
        for (double before = m_result.residual;;) {
            if (m_trial_is_differentiated)
                std::swap(m_w.derivatives, m_w.trial_derivatives);
            else
                differentiate(m_zone, m_w.point, Curvature::none, m_w.derivatives, nullptr);
            m_trial_is_differentiated = false;
            m_w.derivatives.largest_stiffness = stiffness;
            const Accuracy now = accuracy();
            const bool done = now.residual < std::max(m_options.tolerance, now.floor);
            if (!done && !(with_cloth && now.residual < kContraction * before)) return false;
            if (!solve_for_step()) return false;
            set_step_end();
            m_result.residual = before = now.residual;
            const bool moved = polish();
            if (done) return true;
            if (!moved) return false;
        }
    }

    /// Where the Newton step ends.
    void set_step_end() {
        m_w.y_end = y();
        for (int i = 0; i < m_zone.dynamic_count; ++i) m_w.y_end.bodies[i] += m_w.step.bodies[i];
        for (int i = 0; i < m_zone.node_count(); ++i)
            if (!m_zone.nodes[i].pinned) m_w.y_end.nodes[i] += m_w.step.nodes[i];
    }

    void iterate() {
        int stalls = 0;
        int relaxations = 0;  // Newton steps to be taken before driven bodies go on
        double best_residual = kInfinity;
        int stagnant = 0;  // steps since the residual last halved
        int steps_without_qp = 0;
        double lowest_energy = kInfinity;
        int futile = 0;  // steps since it fell by more than rounding may do
        for (;; ++m_result.iterations) {
            const bool driven = drives_done();
            if (!newton_step()) return fail(ZoneStatus::no_descent);
            const Accuracy now = accuracy();
            m_result.residual = now.residual;
            set_step_end();
            const double rounding_step = 16.0 * kEpsilon * m_position;
            if (driven && (now.residual < std::max(m_options.tolerance, now.floor) || largest_move() < rounding_step)) {
                polish();
                return;
            }
            const double good = kGoodEnough * std::max(m_options.tolerance, now.floor);
            stagnant = now.residual < 0.5 * best_residual ? 0 : stagnant + 1;
            best_residual = std::min(best_residual, now.residual);
            if (driven && stagnant >= kStagnantSteps && now.residual < good) return;
            const bool lower = m_w.point.energy < lowest_energy - energy_noise();
            futile = driven && !lower ? futile + 1 : 0;
            if (lower || !driven) lowest_energy = m_w.point.energy;
            if (futile >= kFutileSteps) return fail(ZoneStatus::no_descent);
            const bool without_qp = !m_zone.nodes.empty() && m_qp_steps >= kMaxQpSteps;
            steps_without_qp += without_qp ? 1 : 0;
            if (m_result.iterations >= m_options.max_iterations || steps_without_qp > kStepsWithoutQp)
                return fail(ZoneStatus::too_many_iterations);

            if (!driven && relaxations == 0) {
                const double step = past_impacts(0.0, false);
                const DriveProgress progress = advance_drives(step, stalls);
                if (progress == DriveProgress::blocked) return fail(ZoneStatus::blocked);
                if (step < 1.0) relaxations = kRelaxations;
                if (progress == DriveProgress::moved) accept_trial();
                continue;
            }
            relaxations = now.residual < kRelaxed ? 0 : std::max(relaxations - 1, 0);
            // The step's end may lie where contacts have not been listed yet. New ones are beyond their rest distance
            // here, so energy and derivatives stand.
            ensure_covered(m_w.y_end);
            double step = allowed_step(m_zone, m_w.point, m_w.y_end, nullptr);
            if (driven && step < kClampedStep && !without_qp)
                step = past_impacts(step, true);
            else if (step < 1.0 || !gates_hold(m_gates, m_zone, m_w.y_end))
                step = arc_step(step);
            if (line_search(step)) {
                accept_trial();
                const bool is_last = m_result.iterations + 1 >= m_options.max_iterations;
                if (driven && !is_last && finish_with_this_factor()) {
                    ++m_result.iterations;
                    return;
                }
            } else if (!driven) {
                relaxations = 0;
            } else {
                if (now.residual >= good) fail(ZoneStatus::no_descent);
                return;
            }
        }
    }

    /// (M + dt² K) Δy = -dE/dy, so often. From y = 0 that is  (M + dt² K) v1 = M v0 + dt f  [Qiao et al. 2020, Eq. 3].
    void take_full_steps(int count) {
        for (int i = 0; i < m_zone.node_count(); ++i)
            if (m_zone.nodes[i].pinned) y().nodes[i] = m_zone.nodes[i].target;
        evaluate(m_zone, m_w.point);
        for (m_result.iterations = 0; m_result.iterations < count; ++m_result.iterations) {
            if (!newton_step()) return fail(ZoneStatus::no_descent);
            m_w.trial.y = y();
            for (int i = 0; i < m_zone.node_count(); ++i) m_w.trial.y.nodes[i] += m_w.step.nodes[i];
            evaluate(m_zone, m_w.trial);
            if (!std::isfinite(m_w.trial.energy)) return fail(ZoneStatus::no_descent);
            std::swap(m_w.point, m_w.trial);
        }
        differentiate(m_zone, m_w.point, Curvature::none, m_w.derivatives, nullptr);
        m_result.residual = accuracy().residual;
    }

    /// CCD stopped the Newton step: look for a way past the impacts. Returns the allowed step to m_w.y_end.
    double past_impacts(double newton_limit, bool driven) {
        m_has_factor = false;  // the QP factorizes its own matrix
        Coordinates target = y();
        set_to_targets(target);
        ensure_covered(target);
        ImpactDirection direction = impact_direction(m_zone, m_w.point, m_w.system);
        m_qp_steps += direction.newton_steps;
        for (int k = 0; k < 8 && !is_covered(m_zone, m_coverage, direction.y_end); ++k) {
            list_contacts(direction.y_end);
            evaluate(m_zone, m_w.point);
            direction = impact_direction(m_zone, m_w.point, m_w.system, &direction);
            m_qp_steps += direction.newton_steps;
        }
        const Coordinates newton_end = m_w.y_end;
        m_w.y_end = direction.y_end;
        m_w.y_end.bodies.resize(m_zone.bodies.size());
        const bool good = !driven || (slope(m_w.derivatives.gradient) < 0.0 && direction.step >= newton_limit);
        if (good) return covered_step();
        m_w.y_end = newton_end;
        m_w.y_end.bodies.resize(m_zone.bodies.size());
        for (std::size_t i = newton_end.bodies.size(); i < m_w.y_end.bodies.size(); ++i)
            m_w.y_end.bodies[i] = m_zone.bodies[i].target;
        return covered_step();
    }

    /// The allowed step to m_w.y_end, with the list of contacts complete for it.
    double covered_step() {
        ensure_covered(m_w.y_end);
        return arc_step(1.0);
    }

    /// Shorten a step until the chords to its end are clear.
    double arc_step(double step) {
        for (int k = 0; k < kMaxHalvings && step > 0.0; ++k) {
            m_w.trial.y = m_w.y_end;
            if (step < 1.0) set_trial(m_w.y_end, step);
            const double allowed = allowed_step(m_zone, m_w.point, m_w.trial.y, nullptr);
            if (allowed == 1.0 && gates_hold(m_gates, m_zone, m_w.trial.y)) return step;
            step *= std::min(allowed, 0.9);
        }
        return 0.0;
    }

    /// Go along with driven bodies as far as allowed, whatever the energy: they must reach their targets.
    /// Where there is no room at all, what is in the way may make some in Newton steps of its own.
    enum class DriveProgress { moved, waits, blocked };
    DriveProgress advance_drives(double step, int& stalls) {
        stalls = step < kStall ? stalls + 1 : 0;
        if (stalls > kMaxStalls) return DriveProgress::blocked;
        return step > 0.0 && clear_step(m_w.y_end) > 0.0 ? DriveProgress::moved : DriveProgress::waits;
    }

    /// One more full step, also past the tolerance: it takes the solution to rounding, which gradients feel. False if there
    /// is nothing to gain.
    bool polish() {
        if (m_w.derivatives.largest_force == 0.0 && m_result.residual == 0.0) return false;
        if (!is_covered(m_zone, m_coverage, m_w.y_end)) return false;
        if (allowed_step(m_zone, m_w.point, m_w.y_end, nullptr) < 1.0) return false;
        m_w.trial.y = m_w.y_end;
        evaluate(m_zone, m_w.trial);
        if (!(m_w.trial.energy <= m_w.point.energy + energy_noise())) return false;
        accept_trial();
        return true;
    }

    // --- hard contacts -----------------------------------------------------------------------------------------

    /// Multiplier updates [the method of multipliers]: shift each contact's rest distance so that the same force acts with no
    /// compression, until there is none left. Every round leaves 1 / (1 + k s) of it, k the stiffness and s what a force
    /// moves the contact by: about the compliance where masses decide that. It is more under a heavy body that rests on
    /// several light ones, and where a force on curved contacts makes s negative a round may even overshoot. There contacts
    /// become stiffer.
    void harden() {
        double left = kInfinity;
        for (int round = 0; m_result.status == ZoneStatus::converged; ++round) {
            const double violation = hard_violation();
            if (violation <= kHardTolerance) return;
            if (round >= kMaxHardRounds) return fail(ZoneStatus::too_many_iterations);
            const bool slow = violation > kSlowRound * left && m_zone.compliance > kLeastCompliance;
            left = violation;
            shift_rest_distances(slow ? kStiffening : 1.0);
            evaluate(m_zone, m_w.point);
            iterate();
        }
    }

    /// How far contacts that push are from their rest distance, of their range. Rounding is not counted.
    double hard_violation() const {
        double violation = 0.0;
        for (std::size_t k = 0; k < m_zone.contacts.size(); ++k) {
            const ContactRange& range = m_zone.contacts[k].range;
            const double shift = m_zone.contacts[k].shift;
            const double compression = std::max(range.rest - m_w.point.distances[k], 0.0);
            const double distance = std::abs(compression - shift);
            if (distance > 16.0 * kEpsilon * m_position)
                violation = std::max(violation, distance / (range.rest - shift - range.floor));
        }
        return violation;
    }
    /// Let every contact's force act at its rest distance; from here on contacts are this much stiffer.
    void shift_rest_distances(double stiffening) {
        m_zone.compliance /= stiffening;
        m_shifted.clear();
        for (std::size_t k = 0; k < m_zone.contacts.size(); ++k) {
            ZoneContact& contact = m_zone.contacts[k];
            ContactRange& range = contact.range;
            const double force =
                contact_potential(range.rest - m_w.point.distances[k], range.rest - range.pole, contact.stiffness.value)
                    .force;
            contact.stiffness.value *= stiffening;
            range.rest -= contact.shift;
            contact.shift = hard_contact_shift(force, range.rest - range.pole, contact.stiffness.value);
            range.rest += contact.shift;
            if (contact.shift > 0.0) m_shifted.push_back({contact.contact, contact.shift});
        }
        std::sort(m_shifted.begin(), m_shifted.end());
    }

    /// Contacts that were listed anew push as before.
    void restore_shifts() {
        if (m_shifted.empty()) return;
        for (ZoneContact& contact : m_zone.contacts) {
            const ShiftedContact key{contact.contact, 0.0};
            const auto found = std::lower_bound(m_shifted.begin(), m_shifted.end(), key);
            if (found == m_shifted.end() || key < *found) continue;
            contact.shift = found->shift;
            contact.range.rest += found->shift;
        }
    }

    void fail(ZoneStatus status) { m_result.status = status; }

    Zone& m_zone;
    const PassiveBodies& m_passive;
    const ZoneOptions& m_options;
    ZoneWorkspace& m_w;
    std::vector<Box>& m_visited;
    ContactCoverage& m_coverage;
    std::vector<ImpactGate> m_gates;
    std::vector<ShiftedContact> m_shifted;   // hard contacts that push, sorted
    double m_position = 0.0;                 // size of the numbers that distances are differences of [m]
    int m_qp_steps = 0;                      // Newton steps of impact QPs so far
    CutShare m_cut = kNothingCut;            // of the next Newton step
    bool m_has_factor = false;               // the system, of the Hessian of the last Newton step
    bool m_factor_is_exact = false;          // without anything cut off
    bool m_trial_is_differentiated = false;  // the one that the line search accepted
    bool m_rescue = false;                   // some objects start the step below their floor
    ZoneResult m_result;
};

}  // namespace

ZoneResult solve_zone(
    Zone& zone, const PassiveBodies& passive, const ZoneOptions& options, ZoneWorkspace& workspace,
    std::vector<Box>& visited) {
    return ZoneSolver(zone, passive, options, workspace, visited).solve();
}

}  // namespace diffsim
