#pragma once

#include "zone/friction_row.hpp"
#include "zone/friction_term.hpp"
#include "zone/side_matrices.hpp"

/// The convex model of a zone around its current point, all near contacts in it:
///     m(p) = ½ pᵀ H p + gᵀ p + Σ stiffness/2 max(0, missing - rowᵀ p)².
namespace diffsim {

/// What rows do not see of contacts with friction: as they turn, their forces and their slips turn with them.
struct FrictionTurns {
    struct Slip {
        std::array<ContactTerm::Side, 2> sides;
        int side_count;
        std::size_t friction;  ///< index into ContactModel::friction
        std::size_t force;     ///< index into forces
        TangentRows rows;
        SlipChanges beyond;  ///< what its slip changes by, without the rows

        template <class BodyPart, class NodePart>
        void for_each(const BodyPart& body_part, const NodePart& node_part) const {
            visit_sides(sides, side_count, body_part, node_part);
        }
    };
    std::vector<Slip> slips;
    SideMatrices forces;  ///< what the forces on the coordinates change by

    bool empty() const { return slips.empty(); }
    void clear() {
        slips.clear();
        forces.clear();
    }
};

struct ContactModel {
    BlockSystem smooth;                 ///< H; its pattern has the rows' pairs
    Coordinates gradient;               ///< g; zero at pinned nodes
    std::vector<ContactRow> rows;       ///< one-sided; those of the same bodies follow each other
    std::vector<FrictionRow> friction;  ///< of rows whose contacts have some, in their order; see friction_model
    FrictionTurns turns;                ///< of some of them
};

/// Memory of minimise(), kept from model to model.
struct ModelWorkspace {
    Coordinates smooth_p, gradient, step, smooth_step;
    std::vector<double> violation, slope;
    std::vector<char> pushes;
};

struct ModelSolution {
    enum class Status { solved, indefinite, crawling } status = Status::indefinite;
    int newton_steps = 0;  ///< factorizations
};

/// Minimise the model with its rows at this share of their stiffness, by Newton's method on the piecewise quadratic
/// with exact line search: it ends with the first full step after which no row has changed sides. `p` holds the
/// start, which pinned nodes keep, and receives the minimiser; the rows receive their forces. Where a step comes
/// out shorter than `least_step` it is given up: too many rows change sides at once. Scratch: `system`, whose
/// pattern is that of model.smooth.
ModelSolution minimise(
    ContactModel& model, double share, double least_step, BlockSystem& system, ModelWorkspace& workspace,
    Coordinates& p);

/// Add what the rows of two bodies do to them together, `row` one of these, to the gradient and,
/// unless it is null, the matrix.
void add_run(
    const ContactRow& row, const Vector<9>& force, const HalfSymmetric<9>& stiffness, Coordinates& gradient,
    BlockSystem* system);

/// Add the rows that push, with this share of their stiffness, to the gradient and, unless it is null, the matrix.
void add_rows(
    const std::vector<ContactRow>& rows, double share, const std::vector<double>& violation,
    const std::vector<char>& pushes, Coordinates& gradient, BlockSystem* system);

}  // namespace diffsim
