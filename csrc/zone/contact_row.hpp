#pragma once

#include "contact/contact_derivatives.hpp"
#include "zone/zone_derivatives.hpp"

/// Contacts as linear rows over the coordinates of a zone: J x and Jᵀ f.
namespace diffsim {

/// A linearised contact: gap + rowᵀ p should reach a distance. Half-spaces with a penalty, see ContactModel.
struct ContactRow {
    int contact = -1;    ///< index into Zone::contacts
    int a = -1, b = -1;  ///< bodies of the zone; -1 where one does not yield or is none
    int pair = -1;       ///< block of the Hessian, or -1
    /// Along the coordinates of both bodies' turns, and the shift of b against a: see both_twists.
    Vector<9> relative = Vector<9>::Zero();
    std::vector<int> nodes;  ///< free nodes that take part
    std::vector<Vec3> node_rows;
    double missing = 0.0;    ///< what p has to make up for: violated by max(0, missing - rowᵀ p) [m]
    double stiffness = 0.0;  ///< [kg]
    double range = 0.0;      ///< of the contact, from rest to floor [m]
    double force = 0.0;      ///< at the model's solution: stiffness * violation [kg·m]

    Vec6 row_a() const { return both_twists(relative).head<6>(); }
    Vec6 row_b() const { return both_twists(relative).tail<6>(); }
};

/// Everything at some coordinates.
struct Placement {
    Coordinates y;
    std::vector<Pose> poses;
    std::vector<Vec3> nodes;
};

/// The row that asks for a distance, linearised where the objects are placed, for p counted from y_now. What moves as
/// told does its part.
ContactRow make_row(
    const Zone& zone, const ZoneContact& contact, const ContactGeometry& geometry, const Placement& at,
    const Coordinates& y_now, double wanted);

/// What the bodies of a row move by, along what its `relative` is taken.
Vector<9> relative_motion(const ContactRow& row, const Coordinates& p);

/// rowᵀ p
double row_times(const ContactRow& row, const Coordinates& p);

/// The same of all rows. Those of the same bodies should follow each other.
void rows_times(const std::vector<ContactRow>& rows, const Coordinates& p, std::vector<double>& products);

/// sum += force * row
void add_row(const ContactRow& row, double force, Coordinates& sum);

/// Call visit(first, last) with each run of rows, last one past its end, that are of the same bodies.
template <class Visit>
void visit_runs(const std::vector<ContactRow>& rows, Visit&& visit) {
    for (std::size_t first = 0; first < rows.size();) {
        std::size_t last = first + 1;
        while (last < rows.size() && rows[last].a == rows[first].a && rows[last].b == rows[first].b) ++last;
        visit(first, last);
        first = last;
    }
}

}  // namespace diffsim
