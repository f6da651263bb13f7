#include "solve/friction_model.hpp"

#include <algorithm>
#include <cmath>

#include "zone/gmres.hpp"
#include "zone/zone_accuracy.hpp"

namespace diffsim {
namespace {

constexpr int kCrawlAfter = 10;        // Newton steps before turns are left out, then before all goes in small steps
constexpr int kMaxBalanceSteps = 300;  // in rounds of bounds that stand still
constexpr int kMaxConvexSteps = 60;    // where bounds stay from model to model
constexpr double kBoundChange = 0.1;   // of the largest: bounds that change less may follow again
constexpr int kMaxFrozenRounds = 10;   // of bounds that stand still

constexpr int kMaxBisections = 30;    // bisections of a line search
constexpr double kFlat = 0.1;         // of the slope at the start: that at the end of a step taken in full
constexpr double kNegligible = 1e-6;  // of the forces: what bounds that follow would change
constexpr double kLinearTolerance = 1e-8;
constexpr int kMaxLinear = 30;          // iterations of GMRES
constexpr double kSettledReach = 0.01;  // of its slip
constexpr double kDirected = 1e-10;     // [m]: slips of less may turn

/// One model; the steps of balance() as members.
class Balance {
public:
    Balance(
        ContactModel& model, const Zone& zone, const BalanceGoal& goal, BlockSystem& system,
        BalanceWorkspace& workspace, Coordinates& p)
        : m_model(model),
          m_rows(model.rows),
          m_friction(model.friction),
          m_zone(zone),
          m_goal(goal),
          m_system(system),
          m_w(workspace),
          m_p(p) {}

    ModelSolution run() {
        if (m_goal.bounds_stay) return minimise();
        set_reach();
        const Coordinates start = m_p;
        const std::vector<FrictionRow> states = m_friction;
        if (!m_model.turns.empty()) {
            if (solve()) return m_result;
            m_model.turns.clear();
            m_p = start;
            m_friction = states;
        }
        solve();
        return m_result;
    }

private:
    /// With the bounds that rows have.
    ModelSolution minimise() {
        m_frozen = true;
        m_w.bound.resize(m_friction.size());
        for (std::size_t f = 0; f < m_friction.size(); ++f) m_w.bound[f] = m_friction[f].bound;
        ModelSolution::Status status = ModelSolution::Status::solved;
        while (status == ModelSolution::Status::solved && find_left() > m_goal.tolerance) {
            if (m_result.newton_steps == kMaxConvexSteps)
                status = ModelSolution::Status::crawling;
            else if (!newton_step())
                return m_result;
        }
        finish(status);
        return m_result;
    }

    /// From where p and the states are. False where it crawls with turns, and is given up.
    bool solve() {
        look();
        if (!keep_states()) return true;
        Pace pace = newton();
        if (pace == Pace::crawls && !m_model.turns.empty()) return false;
        if (pace == Pace::crawls) pace = follow_in_rounds();
        if (pace == Pace::crawls) pace = newton();
        if (pace == Pace::crawls) finish(ModelSolution::Status::crawling);
        return true;
    }

    enum class Pace { ended, crawls };

    /// Ends where the balance is found, or where the matrix is indefinite.
    Pace newton() {
        for (int steps = 0; find_left() > m_goal.tolerance; ++steps) {
            if (steps == kCrawlAfter) return Pace::crawls;
            if (!newton_step()) return Pace::ended;
        }
        finish(ModelSolution::Status::solved);
        return Pace::ended;
    }

    /// With bounds that stand still, which is a convex minimisation, then follow, and stand still again.
    Pace follow_in_rounds() {
        find_left();
        m_frozen = true;
        double change = 1.0;
        for (int rounds = 0; rounds < kMaxFrozenRounds && change > kBoundChange; ++rounds) {
            while (find_left() > m_goal.tolerance) {
                if (m_result.newton_steps >= kMaxBalanceSteps) break;
                if (!newton_step()) return Pace::ended;
            }
            change = let_bounds_follow();
        }
        m_frozen = false;
        return Pace::crawls;
    }

    /// Of bounds that stood still: how far they are from the forces now, of the largest.
    double let_bounds_follow() {
        double change = 0.0, largest = 0.0;
        for (std::size_t f = 0; f < m_friction.size(); ++f) {
            const double now = m_friction[f].coefficient * force(m_friction[f].normal);
            change = std::max(change, std::abs(now - m_w.bound[f]));
            largest = std::max(largest, now);
            m_w.bound[f] = now;
        }
        return largest > 0.0 ? change / largest : 0.0;
    }

    void finish(ModelSolution::Status status) {
        m_result.status = status;
        for (std::size_t r = 0; r < m_rows.size(); ++r) m_rows[r].force = force(r);
    }

    /// What is left of the balance at p, in units of |L⁻¹ g|.
    double find_left() {
        look();
        follow();
        add_all(nullptr);
        return largest_scaled(m_zone, m_w.gradient);
    }

    double force(std::size_t r) const { return m_rows[r].stiffness * std::max(0.0, m_w.violation[r]); }

    /// Proportional to the load: then all contacts of a face come to their bounds together.
    void set_reach() {
        const double share = m_goal.is_balanced ? kHoldingShare : m_goal.is_settled ? kSlipShare : kColdShare;
        std::size_t f = 0;
        visit_runs(m_rows, [&](std::size_t first, std::size_t last) {
            double sum = 0.0;
            int count = 0;
            for (std::size_t r = first; r < last; ++r) {
                if (!(m_rows[r].force > 0.0)) continue;
                sum += m_rows[r].force;
                ++count;
            }
            for (; f < m_friction.size() && m_friction[f].normal < last; ++f) {
                FrictionRow& slip = m_friction[f];
                const ContactRow& row = m_rows[slip.normal];
                const double pressed = count > 0 ? sum / count / row.stiffness : row.range;
                slip.reach = share * slip.coefficient * pressed;
                const double size = slip.slip.norm();
                if (m_goal.is_settled && slip.slips && size > kDirected)
                    slip.reach = std::min(slip.reach, kSettledReach * size);
                if (slip.is_known) continue;
                slip.slips = size > slip.reach;
                slip.share = slip.slip / std::max(size, slip.reach);
            }
        });
    }

    /// What the rows ask for at p.
    void look() {
        m_model.smooth.multiply(m_p, m_w.smooth_p);
        rows_times(m_rows, m_p, m_w.violation);
        for (std::size_t r = 0; r < m_rows.size(); ++r) m_w.violation[r] = m_rows[r].missing - m_w.violation[r];
        slips_times(m_friction, m_rows, m_p, m_w.slip);
        for (std::size_t f = 0; f < m_friction.size(); ++f)
            m_w.slip[f] += m_friction[f].slip + m_friction[f].reach * m_friction[f].multiplier;
        add_turns(m_p, m_w.slip, m_w.smooth_p);
    }

    /// Who pushes and who slips at p, and the balance there.
    void follow() {
        m_w.pushes.resize(m_rows.size());
        for (std::size_t r = 0; r < m_rows.size(); ++r) m_w.pushes[r] = m_w.violation[r] > 0.0;
        m_w.bound.resize(m_friction.size());
        m_w.pull.resize(m_friction.size());
        for (std::size_t f = 0; f < m_friction.size(); ++f) {
            FrictionRow& slip = m_friction[f];
            const Vec2& w = m_w.slip[f];
            const double size = w.norm();
            slip.slips = size > slip.reach;
            slip.share = w / std::max(size, slip.reach);
            if (!m_frozen) m_w.bound[f] = slip.coefficient * force(slip.normal);
            m_w.pull[f] = m_w.bound[f] * slip.share;
        }
    }

    /// The balance with these forces, and the symmetric matrix for bounds that stay.
    bool factorize() {
        m_system.copy_values(m_model.smooth);
        add_all(&m_system);
        return m_system.factorize();
    }

    /// `system`: null for the balance alone.
    void add_all(BlockSystem* system) {
        m_w.gradient = m_w.smooth_p;
        add(1.0, m_model.gradient, m_w.gradient);
        add_rows(m_rows, 1.0, m_w.violation, m_w.pushes, m_w.gradient, system);
        std::size_t f = 0;
        visit_runs(m_rows, [&](std::size_t, std::size_t last) {
            if (f == m_friction.size() || m_friction[f].normal >= last) return;
            const ContactRow& row = m_rows[m_friction[f].normal];
            Vector<9> force = Vector<9>::Zero();  // that rows push with: friction holds back
            HalfSymmetric<9> stiffness;
            for (; f < m_friction.size() && m_friction[f].normal < last; ++f)
                if (m_w.bound[f] > 0.0) add_friction(f, force, stiffness, system);
            add_run(row, force, stiffness, m_w.gradient, system);
        });
    }

    /// One contact's, to the sums of its bodies and to its nodes. Sticking it is as stiff along both tangents, slipping
    /// only across its slip.
    void add_friction(std::size_t f, Vector<9>& force, HalfSymmetric<9>& stiffness, BlockSystem* system) {
        const FrictionRow& slip = m_friction[f];
        const ContactRow& row = m_rows[slip.normal];
        const bool has_nodes = !row.nodes.empty();
        force -= relative_along(slip, m_w.pull[f]);
        for (std::size_t n = 0; n < row.nodes.size(); ++n)
            m_w.gradient.nodes[row.nodes[n]] +=
                slip.node_weights[n] * (m_w.pull[f][0] * slip.tangents[0] + m_w.pull[f][1] * slip.tangents[1]);
        if (system == nullptr) return;
        const auto add_along = [&](const Vec2& direction, double k) {
            stiffness.add_square(k, relative_along(slip, direction));
            if (has_nodes) add_friction_node_stiffness(slip, row, direction, k, *system);
        };
        const double size = m_w.slip[f].norm();
        if (slip.slips) {
            add_along({-slip.share[1], slip.share[0]}, m_w.bound[f] / std::max(size, slip.reach));
        } else {
            add_along(Vec2::UnitX(), m_w.bound[f] / slip.reach);
            add_along(Vec2::UnitY(), m_w.bound[f] / slip.reach);
        }
    }

    /// N x: what a motion changes by forces besides what S says of it. Bounds follow, and contacts turn.
    Coordinates left_out(const Coordinates& x) {
        Coordinates result;
        result.assign_zero(x.bodies.size(), x.nodes.size());
        rows_times(m_rows, x, m_w.slope);
        for (std::size_t f = 0; f < m_friction.size(); ++f) {
            const FrictionRow& slip = m_friction[f];
            if (m_frozen || !(m_w.bound[f] > 0.0)) continue;
            const double change = slip.coefficient * m_rows[slip.normal].stiffness * m_w.slope[slip.normal];
            diffsim::add_friction(slip, m_rows[slip.normal], change * slip.share, result);
        }
        m_w.turned.add_product(m_zone, -1.0, x, result);
        return result;
    }

    /// What contacts that turn do along a motion: to their slips, and to the forces.
    void add_turns(const Coordinates& motion, std::vector<Vec2>& slips, Coordinates& forces) const {
        for (const FrictionTurns::Slip& turn : m_model.turns.slips)
            slips[turn.friction] += turn.beyond * gather(m_zone, turn, motion);
        m_model.turns.forces.add_product(m_zone, 1.0, motion, forces);
    }

    /// The forces of contacts that turn, with those that their slips bring about.
    void make_turned() {
        m_w.turned = m_model.turns.forces;
        for (const FrictionTurns::Slip& turn : m_model.turns.slips) {
            const FrictionRow& slip = m_friction[turn.friction];
            SlipChanges w = turn.beyond;
            if (slip.slips) w -= slip.share * (slip.share.transpose() * turn.beyond);
            const double k = m_w.bound[turn.friction] / std::max(m_w.slip[turn.friction].norm(), slip.reach);
            m_w.turned[turn.force] += turn.rows.lazyProduct(k * w);
        }
    }

    /// The Newton step, by S alone or with bounds that follow.
    void solve_step(bool with_bounds) {
        m_w.step = m_w.gradient;
        scale(-1.0, m_w.step);
        m_system.solve_in_place(m_w.step);
        if (!with_bounds && m_model.turns.empty()) return;
        make_turned();
        const auto apply = [&](const Coordinates& x) {
            Coordinates result = left_out(x);
            m_system.solve_in_place(result);
            scale(-1.0, result);
            add(1.0, x, result);
            return result;
        };
        const auto product = [&](const Coordinates& a, const Coordinates& b) { return mass_dot(m_zone, a, b); };
        gmres(apply, product, kLinearTolerance, kMaxLinear, m_w.step);
    }

    bool bounds_matter() const {
        if (m_frozen) return false;
        for (std::size_t f = 0; f < m_friction.size(); ++f)
            if (m_w.bound[f] > 0.0 && m_friction[f].coefficient * m_friction[f].share.norm() > kNegligible) return true;
        return false;
    }

    /// From the forces of the model before, linearly and every contact as it was: forces are carried from model to
    /// model, not places, at which other springs have other forces and everything that sticks seems to slip.
    bool keep_states() {
        m_w.pushes.resize(m_rows.size());
        bool any = false;
        for (std::size_t r = 0; r < m_rows.size(); ++r) any = (m_w.pushes[r] = m_rows[r].force > 0.0) || any;
        if (!any) return true;
        m_w.bound.resize(m_friction.size());
        m_w.pull.resize(m_friction.size());
        for (std::size_t f = 0; f < m_friction.size(); ++f) {
            const FrictionRow& slip = m_friction[f];
            const ContactRow& row = m_rows[slip.normal];
            m_w.bound[f] = slip.coefficient * row.force;
            const double now = row.force > 0.0 ? slip.coefficient * row.stiffness * m_w.violation[slip.normal] : 0.0;
            m_w.pull[f] = now * slip.share;
            if (!slip.slips) m_w.pull[f] += m_w.bound[f] * (m_w.slip[f] / slip.reach - slip.share);
        }
        if (!factorize()) return false;
        ++m_result.newton_steps;
        solve_step(bounds_matter());
        add(1.0, m_w.step, m_p);
        return true;
    }

    bool newton_step() {
        if (!factorize()) return false;
        ++m_result.newton_steps;
        const bool with_bounds = bounds_matter();
        solve_step(with_bounds);
        measure_step();
        std::vector<double> bound = m_w.bound;
        if (with_bounds) {
            for (std::size_t f = 0; f < m_friction.size(); ++f) {
                const FrictionRow& slip = m_friction[f];
                const std::size_t r = slip.normal;
                if (bound[f] > 0.0)
                    bound[f] = slip.coefficient * m_rows[r].stiffness * std::max(0.0, m_w.violation[r] - m_w.slope[r]);
            }
            if (m_model.turns.empty() && slope(0.0, bound) > 0.0) {  // with these bounds it leads up
                bound = m_w.bound;
                solve_step(false);
                measure_step();
            }
        }
        add(line_search(bound), m_w.step, m_p);
        return true;
    }

    void measure_step() {
        rows_times(m_rows, m_w.step, m_w.slope);
        slips_times(m_friction, m_rows, m_w.step, m_w.along_step);
        m_w.slip_step = m_w.along_step;
        m_model.smooth.multiply(m_w.step, m_w.smooth_step);
        add_turns(m_w.step, m_w.slip_step, m_w.smooth_step);
        m_first = dot(m_w.step, m_model.gradient) + dot(m_w.step, m_w.smooth_p);
        m_second = dot(m_w.step, m_w.smooth_step);
    }

    /// What is left of the balance along the step, with bounds that stay as they are: without turns
    /// the slope of a convex energy.
    double slope(double t, const std::vector<double>& bound) const {
        double sum = m_first + t * m_second;
        for (std::size_t r = 0; r < m_rows.size(); ++r) {
            const double v = m_w.violation[r] - t * m_w.slope[r];
            if (v > 0.0) sum -= m_rows[r].stiffness * v * m_w.slope[r];
        }
        for (std::size_t f = 0; f < m_friction.size(); ++f) {
            if (!(bound[f] > 0.0)) continue;
            const Vec2 w = m_w.slip[f] + t * m_w.slip_step[f];
            sum += bound[f] * w.dot(m_w.along_step[f]) / std::max(w.norm(), m_friction[f].reach);
        }
        return sum;
    }

    double line_search(const std::vector<double>& bound) const {
        const double begin = slope(0.0, bound);
        if (slope(1.0, bound) <= kFlat * std::abs(begin)) return 1.0;
        double lower = 0.0, upper = 1.0;
        for (int k = 0; k < kMaxBisections; ++k) {
            const double t = 0.5 * (lower + upper), now = slope(t, bound);
            if (std::abs(now) <= kFlat * std::abs(begin)) return t;
            (now > 0.0 ? upper : lower) = t;
        }
        return 0.5 * (lower + upper);
    }

    ContactModel& m_model;
    std::vector<ContactRow>& m_rows;
    std::vector<FrictionRow>& m_friction;
    const Zone& m_zone;
    const BalanceGoal& m_goal;
    BlockSystem& m_system;
    BalanceWorkspace& m_w;
    Coordinates& m_p;
    double m_first = 0.0, m_second = 0.0;  // slope of the smooth part along the step, and its rate
    bool m_frozen = false;                 // bounds stay as they are
    ModelSolution m_result;
};

}  // namespace

ModelSolution balance(
    ContactModel& model, const Zone& zone, const BalanceGoal& goal, BlockSystem& system, BalanceWorkspace& workspace,
    Coordinates& p) {
    return Balance(model, zone, goal, system, workspace, p).run();
}

}  // namespace diffsim
