#include "solve/contact_model.hpp"

#include <algorithm>
#include <cmath>

namespace diffsim {
namespace {

constexpr int kMaxNewtonSteps = 100;  // a guard against rounding's whims: none has been seen to need half of them
constexpr int kFullSteps = 8;
constexpr double kLineTolerance = 1e-4;  // of the step: Newton corrects the rest
constexpr double kSideTolerance = 1e-9;  // of the contact's range: nearer than this a row is on neither side

/// Minimise the convex piecewise quadratic t -> m(p + t s) for t > 0: Newton with bisection as its guard.
double exact_line_search(
    const std::vector<double>& violation, const std::vector<double>& slope, const std::vector<ContactRow>& rows,
    double share, double first, double second) {
    double lower = 0.0, upper = kInfinity, t = 1.0;
    for (int k = 0; k < 60; ++k) {
        double derivative = first + t * second, curvature = second;
        for (std::size_t r = 0; r < rows.size(); ++r) {
            const double v = violation[r] - t * slope[r];
            if (v <= 0.0) continue;
            const double push = share * rows[r].stiffness * slope[r];
            derivative -= push * v;
            curvature += push * slope[r];
        }
        (derivative > 0.0 ? upper : lower) = t;
        double next = t - derivative / curvature;
        if (!(next > lower && next < upper)) next = upper < kInfinity ? 0.5 * (lower + upper) : 2.0 * t;
        if (std::abs(next - t) <= kLineTolerance * t) break;
        t = next;
    }
    return t;
}

/// The part of a row's stiffness that nodes take part in.
void add_node_stiffness(const ContactRow& row, double stiffness, BlockSystem& system) {
    for (std::size_t k = 0; k < row.nodes.size(); ++k) {
        const int node = row.nodes[k];
        for (std::size_t l = k; l < row.nodes.size(); ++l) {
            const int other = row.nodes[l];
            const Mat3 block = stiffness * row.node_rows[k] * row.node_rows[l].transpose();
            if (node == other)
                system.node_diagonal(node) += block;
            else if (node < other)
                system.node_pair(system.find_node_pair(node, other)) += block;
            else
                system.node_pair(system.find_node_pair(other, node)) += block.transpose();
        }
        if (row.a >= 0)
            system.mixed_pair(system.find_mixed_pair(row.a, node)) +=
                stiffness * row.row_a() * row.node_rows[k].transpose();
    }
}

void set_pushes(ModelWorkspace& w) {
    w.pushes.resize(w.violation.size());
    for (std::size_t r = 0; r < w.pushes.size(); ++r) w.pushes[r] = w.violation[r] > 0.0;
}

/// Those that pushed in the model before, where any did.
void guess_pushes(const std::vector<ContactRow>& rows, ModelWorkspace& w) {
    set_pushes(w);
    if (std::none_of(rows.begin(), rows.end(), [](const ContactRow& row) { return row.force > 0.0; })) return;
    for (std::size_t r = 0; r < rows.size(); ++r) w.pushes[r] = rows[r].force > 0.0;
}

}  // namespace

void add_run(
    const ContactRow& row, const Vector<9>& force, const HalfSymmetric<9>& stiffness, Coordinates& gradient,
    BlockSystem* system) {
    const Vector<12> forces = both_twists(force);
    if (row.a >= 0) gradient.bodies[row.a] -= forces.head<6>();
    if (row.b >= 0) gradient.bodies[row.b] -= forces.tail<6>();
    if (system == nullptr) return;
    const Square<12> blocks = both_twists(stiffness.whole());
    if (row.a >= 0) system->diagonal(row.a) += blocks.topLeftCorner<6, 6>();
    if (row.b >= 0) system->diagonal(row.b) += blocks.bottomRightCorner<6, 6>();
    if (row.a >= 0 && row.b >= 0) system->off_diagonal(row.pair) += blocks.topRightCorner<6, 6>();
}

void add_rows(
    const std::vector<ContactRow>& rows, double share, const std::vector<double>& violation,
    const std::vector<char>& pushes, Coordinates& gradient, BlockSystem* system) {
    visit_runs(rows, [&](std::size_t first, std::size_t last) {
        bool any = false;
        Vector<9> force = Vector<9>::Zero();
        HalfSymmetric<9> stiffness;
        for (std::size_t r = first; r < last; ++r) {
            if (!pushes[r]) continue;
            const ContactRow& row = rows[r];
            const double k = share * row.stiffness, push = k * violation[r];
            any = true;
            force += push * row.relative;
            if (system != nullptr) stiffness.add_square(k, row.relative);
            if (row.nodes.empty()) continue;
            for (std::size_t n = 0; n < row.nodes.size(); ++n) gradient.nodes[row.nodes[n]] -= push * row.node_rows[n];
            if (system != nullptr) add_node_stiffness(row, k, *system);
        }
        if (any) add_run(rows[first], force, stiffness, gradient, system);
    });
}

ModelSolution minimise(
    ContactModel& model, double share, double least_step, BlockSystem& system, ModelWorkspace& w, Coordinates& p) {
    ModelSolution result;
    std::vector<ContactRow>& rows = model.rows;
    const std::size_t count = rows.size();
    w.slope.resize(count);
    model.smooth.multiply(p, w.smooth_p);
    rows_times(rows, p, w.violation);
    for (std::size_t r = 0; r < count; ++r) w.violation[r] = rows[r].missing - w.violation[r];
    guess_pushes(rows, w);
    int full_steps = 0;
    while (result.newton_steps < kMaxNewtonSteps) {
        system.copy_values(model.smooth);
        w.gradient = w.smooth_p;
        add(1.0, model.gradient, w.gradient);
        add_rows(rows, share, w.violation, w.pushes, w.gradient, &system);
        if (!system.factorize()) return result;
        ++result.newton_steps;
        w.step = w.gradient;
        for (Vec6& s : w.step.bodies) s = -s;
        for (Vec3& s : w.step.nodes) s = -s;
        system.solve_in_place(w.step);
        rows_times(rows, w.step, w.slope);
        model.smooth.multiply(w.step, w.smooth_step);
        bool same = true;
        for (std::size_t r = 0; r < count && same; ++r) {
            const double end = w.violation[r] - w.slope[r];
            same = (end > 0.0) == (w.pushes[r] != 0) || std::abs(end) <= kSideTolerance * rows[r].range;
        }
        double t = 1.0;
        if (!same && full_steps < kFullSteps) {
            ++full_steps;
        } else if (!same) {
            const double first = dot(w.step, model.gradient) + dot(w.step, w.smooth_p);
            const double second = dot(w.step, w.smooth_step);
            if (!(second > 0.0)) return result;
            t = exact_line_search(w.violation, w.slope, rows, share, first, second);
            if (t < least_step) {
                result.status = ModelSolution::Status::crawling;
                return result;
            }
        }
        add(t, w.step, p);
        add(t, w.smooth_step, w.smooth_p);
        for (std::size_t r = 0; r < count; ++r) w.violation[r] -= t * w.slope[r];
        if (same) {
            result.status = ModelSolution::Status::solved;
            break;
        }
        set_pushes(w);
    }
    if (result.status != ModelSolution::Status::solved) result.status = ModelSolution::Status::crawling;
    for (std::size_t r = 0; r < count; ++r) rows[r].force = share * rows[r].stiffness * std::max(0.0, w.violation[r]);
    return result;
}

}  // namespace diffsim
