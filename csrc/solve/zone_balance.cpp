#include "solve/zone_balance.hpp"

#include <algorithm>

#include "parallel/interrupt.hpp"

namespace diffsim {
namespace {

constexpr double kSettled = 1e-2;        // residual below which contacts mostly go on sticking or slipping
constexpr double kTurning = 0.1;         // the same below which models see how contacts turn
constexpr double kModelAccuracy = 1e-2;  // of the residual: to which models are solved
constexpr double kModelTolerance = 0.7;  // of the tolerance, at most
constexpr int kMaxDamped = 4;    // models in a row: what friction takes up is known of the last model's bounds alone
constexpr double kRest = 1e-12;  // of the forces: a model that moves nothing further has found the balance
constexpr double kNearlyRests = 1e-6;   // of the forces: slips up to which it may be held by forces found beforehand
constexpr int kMaxFactors = 10000;      // of all models of a step
constexpr int kMaxAtFirst = 300;        // of them before the balance is searched in rounds
constexpr int kMaxAtOnce = 2500;        // and where that does not find it either
constexpr int kMaxStops = 60;           // of bounds that stand still
constexpr double kRoundAccuracy = 0.1;  // of what is left of the balance at its begin: to which a round is followed
constexpr int kMaxDescent = 20;         // models of a round
constexpr double kNearer = 0.1;         // of what was left before: where the balance is searched at once again
constexpr int kMaxOfRound = 8, kMaxFactorsOfRound = 100;  // models and factorizations of that
constexpr double kFirstPart = 0.25, kLeastPart = 1e-3;
constexpr int kMaxOfPart = 8;     // models
constexpr double kEnough = 1e-3;  // residual from which the next part goes on
constexpr int kStandsStill = 3;   // models in balance without halving their motion

class BalanceSearch {
public:
    BalanceSearch(ZoneSearch& search, ModelDirection& model)
        : m_search(search), m_model(model), m_work(search.m_work) {}

    void run() {
        m_search.m_result.iterations = 0;
        if (m_search.drives_done() && rests()) return;
        const int most = m_search.m_options.max_iterations;
        StepStatus status = search(most, kMaxAtFirst);
        if (status == StepStatus::blocked) return m_search.fail(status);
        const Start there = {m_work.point.y, {}, m_model.memory()};
        const bool patient = !m_search.m_options.is_substep;
        if (patient && status != StepStatus::converged && m_least < kInfinity) status = search_in_rounds(status);
        if (patient && status != StepStatus::converged && m_least < kInfinity) {
            go_to(there.y);
            m_model.recall(there.contacts);
            status = search(most, kMaxAtOnce);
        }
        if (status != StepStatus::converged && m_least < kInfinity && !is_driven()) status = search_in_parts(status);
        if (status != StepStatus::converged) fail(status);
    }

private:
    const Zone& zone() const { return m_search.m_zone; }

    /// What a search begins with: where all is, what is left of the balance there, and the forces of contacts.
    struct Start {
        Coordinates y, balance;
        ModelDirection::Memory contacts;
    };

    bool is_held() const { return !m_held.bodies.empty() || !m_held.nodes.empty(); }

    /// From where the point is.
    StepStatus search(int max_iterations, int max_factors) {
        max_factors += m_factors;
        m_damped = m_still = 0;
        m_least_motion = kInfinity;
        for (int iterations = 0;; ++iterations, ++m_search.m_result.iterations) {
            if (m_search.m_options.interrupt != nullptr) m_search.m_options.interrupt->throw_if_asked();
            const bool driven = m_search.drives_done();
            const Accuracy now = look();
            if (driven && !is_held()) keep_best(now);
            if (m_is_rough && now.residual < kEnough) return StepStatus::converged;
            const bool ends = now.residual < kGoodEnough * m_wanted;  // only what sticks still slips
            if (iterations >= (ends ? m_search.m_options.max_iterations : max_iterations))
                return StepStatus::too_many_iterations;
            const ModelDirection::Way way = m_model.find(m_work.derivatives.gradient, driven, m_work.y_end);
            m_factors += way.newton_steps;
            if (m_factors > (driven ? std::min(max_factors, kMaxFactors) : kMaxFactors)) return StepStatus::crawls;
            if (!way.found) return StepStatus::no_descent;
            const double motion = motion_to_end();
            const double step = m_search.m_path.covered_step(m_work.y_end, way.free);
            if (!driven) {
                if (!follow_drives(way, step)) return StepStatus::blocked;
                continue;
            }
            m_search.m_path.set_trial(m_work.y_end, step);
            if (step == 1.0) m_work.trial.y = m_work.y_end;
            evaluate(zone(), m_work.trial, &m_work.point);
            if (step == 1.0 && now.residual < kGoodEnough * m_wanted &&
                (motion <= kRest * now.reference || stands_still(motion))) {
                m_search.accept_trial();
                return StepStatus::converged;
            }
            if (now.residual > kSettled && rises(step)) continue;
            m_damped = 0;
            m_search.accept_trial();
            m_model.relax();
        }
    }

    /// With bounds of friction that stand still, then follow, and stand still again. In between the balance is where
    /// an energy is least, which models of bounds that do not feed themselves go down on, also across contacts that
    /// turn. Near the balance it is searched at once again.
    StepStatus search_in_rounds(StepStatus status) {
        go_to(m_best);
        double near = kSettled;
        for (int round = 0; round < kMaxStops; ++round) {
            const double left = look().residual;
            if (left < near) {
                near = kNearer * left;
                const Start here = {m_work.point.y, {}, m_model.memory()};
                status = search(kMaxOfRound, kMaxFactorsOfRound);
                if (status == StepStatus::converged) return status;
                go_to(here.y);
                m_model.recall(here.contacts);
            }
            if (m_factors > kMaxFactors) break;
            m_model.stop_bounds(left < m_wanted ? kHoldingShare : left < kSettled ? kSlipShare : kColdShare);
            m_model.forget_damping();
            descend();
            m_model.let_bounds_follow();
        }
        return status;
    }

    /// To where the energy with bounds that stand still is least, as nearly as the next bounds need.
    void descend() {
        double first = 1.0;
        for (int models = 0; models < kMaxDescent; ++models) {
            if (m_search.m_options.interrupt != nullptr) m_search.m_options.interrupt->throw_if_asked();
            const Accuracy now = look(true);
            if (models == 0) first = std::min(1.0, now.residual);
            if (models > 0 && now.residual < std::max(m_wanted, kRoundAccuracy * first)) return;
            const ModelDirection::Way way = m_model.find(m_work.derivatives.gradient, true, m_work.y_end);
            m_factors += way.newton_steps;
            if (!way.found) return;
            const double step = m_search.m_path.covered_step(m_work.y_end, way.free);
            m_search.m_path.set_trial(m_work.y_end, step);
            evaluate(zone(), m_work.trial, &m_work.point);
            const double change = m_work.trial.energy - m_work.point.energy + m_model.friction_work(step);
            if (change > m_search.current_noise()) {
                m_model.damp(m_work.trial, change);
                continue;
            }
            m_search.accept_trial();
            m_model.relax();
        }
    }

    /// Whether bodies that move as told are near: what these squeeze no part of the load frees.
    bool is_driven() const {
        const auto moves = [](const ZoneBody& body) { return !body.target.isZero(0.0); };
        return std::any_of(zone().bodies.begin() + zone().dynamic_count, zone().bodies.end(), moves);
    }

    /// From the first point where all that is driven is at its target, with what is left of the balance there held
    /// back: F(y) = (1 - t) F(first), t from 0 to 1 in parts that double and halve. Where contacts turn on the way, so
    /// that models of all of it lead past each other, each part is reached from the last.
    StepStatus search_in_parts(StepStatus status) {
        m_in_parts = true;
        Start begin = m_first;
        double carried = 0.0;
        for (double part = kFirstPart; part > kLeastPart && m_factors <= kMaxFactors;) {
            go_to(begin.y);
            m_model.recall(begin.contacts);
            const double next = std::min(1.0, carried + part);
            m_held = m_first.balance;
            scale(1.0 - next, m_held);
            if (search_part(next == 1.0) != StepStatus::converged) {
                part *= 0.5;
                continue;
            }
            if (next == 1.0) return StepStatus::converged;
            carried = next;
            part *= 2.0;
            begin = {m_work.point.y, {}, m_model.memory()};
        }
        m_held = {};
        return status;
    }

    /// Near enough to go on from; the last one to its end.
    StepStatus search_part(bool is_last) {
        const int most = m_search.m_options.max_iterations;
        m_is_rough = true;
        const StepStatus status = search(std::min(kMaxOfPart, most), kMaxFactors);
        m_is_rough = false;
        if (!is_last || status != StepStatus::converged) return status;
        m_held = {};
        return search(most, kMaxFactors);
    }

    void go_to(Coordinates y) {
        for (int i = static_cast<int>(y.bodies.size()); i < zone().body_count(); ++i)  // joined since
            y.bodies.push_back(zone().bodies[i].target);
        m_search.m_path.ensure_covered(y);
        m_work.trial.y = y;
        evaluate(zone(), m_work.trial, &m_work.point);
        m_search.accept_trial();
    }

    /// What is left of the balance at the point, and what that asks of the next model.
    Accuracy look(bool bounds_stay = false) {
        differentiate(zone(), m_work.point, Curvature::none, m_work.derivatives, nullptr);
        add(-1.0, m_held, m_work.derivatives.gradient);
        m_balance = m_work.derivatives.gradient;
        m_model.add_friction_forces(m_balance);
        Accuracy now = m_search.current_accuracy();
        now.residual = now.reference > 0.0 ? largest_scaled(zone(), m_balance) / now.reference : 0.0;
        m_search.m_result.residual = now.residual;
        m_wanted = std::max(m_search.m_options.tolerance, now.floor);
        const double tolerance = std::max(kModelTolerance * m_wanted, kModelAccuracy * std::min(1.0, now.residual));
        m_model.aim_for(
            {tolerance * now.reference, now.residual < kSettled, now.residual < kTurning && !bounds_stay,
             now.residual < kGoodEnough * m_wanted, !m_in_parts, bounds_stay});
        return now;
    }

    void keep_best(const Accuracy& now) {
        const double left = now.residual * now.reference;
        if (m_least == kInfinity) m_first = {m_work.point.y, m_balance, m_model.memory()};
        if (left >= m_least) return;
        m_least = left;
        m_least_residual = now.residual;
        m_best = m_work.point.y;
    }

    /// Where least was left of the balance: models that find none may have squeezed things from
    /// which no later step recovers.
    void fail(StepStatus status) {
        m_search.fail(status);
        if (m_least == kInfinity) return;
        m_search.m_result.residual = m_least_residual;
        go_to(m_best);
    }

    /// Whether the point is the solution, with contacts that do not slip.
    bool rests() {
        Accuracy now = look();
        const double slip = m_model.largest_slip();
        if (slip > kNearlyRests * now.reference) return false;
        if (now.residual > m_wanted) {
            m_model.hold(m_work.derivatives.gradient, kGoodEnough * m_wanted * now.reference);
            now = look();
        }
        return now.residual < m_wanted && slip <= kRest * now.reference;
    }

    /// Of the way to y_end.
    double motion_to_end() {
        Coordinates& way = m_work.step;
        way.resize(static_cast<std::size_t>(zone().dynamic_count), zone().nodes.size());
        const Coordinates& y = m_work.point.y;
        for (std::size_t i = 0; i < way.bodies.size(); ++i) way.bodies[i] = m_work.y_end.bodies[i] - y.bodies[i];
        for (std::size_t i = 0; i < way.nodes.size(); ++i) way.nodes[i] = m_work.y_end.nodes[i] - y.nodes[i];
        return largest_motion(zone(), way);
    }

    /// False if something is squeezed.
    bool follow_drives(const ModelDirection::Way& way, double step) {
        const ZoneSearch::DriveProgress progress = m_search.advance_drives(step, m_stalls);
        if (progress == ZoneSearch::DriveProgress::moved) m_search.accept_trial();
        return progress != ZoneSearch::DriveProgress::blocked && !(way.squeezes && step < kSqueeze);
    }

    /// Rows that nearly depend on each other slip against each other by rounding, which no multiplier ends.
    bool stands_still(double motion) {
        m_still = motion > 0.5 * m_least_motion ? m_still + 1 : 0;
        m_least_motion = std::min(m_least_motion, motion);
        return m_still >= kStandsStill;
    }

    /// Whether energy and what friction takes up rise; then the model is damped.
    bool rises(double step) {
        const double work = dot(m_held, m_work.trial.y) - dot(m_held, m_work.point.y);  // of what is held back
        const double change = m_work.trial.energy - m_work.point.energy - work + m_model.friction_work(step);
        if (change <= m_search.current_noise()) return false;
        if (++m_damped > kMaxDamped) {
            m_model.forget_damping();
            return false;
        }
        m_model.damp(m_work.trial, change);
        return true;
    }

    ZoneSearch& m_search;
    ModelDirection& m_model;
    ZoneWorkspace& m_work;
    Coordinates m_balance;  // what is left of it
    Coordinates m_best;     // where least was left of it
    Start m_first;          // where drives were done first
    Coordinates m_held;     // of the balance: not to be brought about yet
    bool m_in_parts = false, m_is_rough = false;
    double m_least = kInfinity, m_least_residual = 0.0;
    double m_wanted = 0.0;  // the residual asked for
    double m_least_motion = kInfinity;
    int m_factors = 0, m_stalls = 0, m_damped = 0, m_still = 0;
};

}  // namespace

void find_balance(ZoneSearch& search, ModelDirection& model) {
    BalanceSearch(search, model).run();
    search.m_work.friction.clear();
    for (const ActiveContact& active : search.m_work.point.active)
        search.m_work.friction.push_back(model.friction_of(active));
}

}  // namespace diffsim
