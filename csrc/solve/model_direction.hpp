#pragma once

#include "solve/cut_search.hpp"
#include "solve/friction_model.hpp"
#include "solve/zone_path.hpp"

/// The direction of a zone far from its solution.
namespace diffsim {

/// The direction of a zone far from its solution: the minimiser of one convex model of all near contacts, linearised
/// again where it ends for as long as CCD does not let it go all the way. See docs/solver.md.
///
/// What it learns from model to model within a step: the contacts' forces, which give the next model its curvature and
/// its first guess of who pushes, and which bodies need damping.
class ModelDirection {
public:
    /// All of them are used for as long as this lives.
    ModelDirection(const Zone& zone, ZonePath& path, ZonePoint& point, BlockSystem& system);

    /// Begin with the forces at a point: those of the last step, where that is the start of this one.
    void start_from(const ZonePoint& point);

    /// What the last model found of a contact.
    struct Kept {
        Contact contact;
        double force;
        FrictionState friction;
    };
    using Memory = std::vector<Kept>;
    /// The contacts' forces and states, and a return to them without damping.
    const Memory& memory() const { return m_kept; }
    void recall(Memory memory);

    struct Way {
        bool found = false;    ///< false where rounding spoils the model's matrix
        double free = 0.0;     ///< how much of the way to y_end is free for all that is listed
        int newton_steps = 0;  ///< factorizations
        /// Driven bodies leave no room even where the rows are those of where the way
        /// ends: something is squeezed there.
        bool squeezes = false;
    };
    /// Of models with friction.
    void aim_for(const BalanceGoal& goal) { m_goal = goal; }

    /// Add what friction does at the point, its contacts' shares of their bounds being those of the last model, or
    /// those that its slips have where bounds stand still.
    void add_friction_forces(Coordinates& gradient);
    /// Of contacts that push at the point, as a motion; see largest_motion().
    double largest_slip() const;
    /// Where all is nearly at rest: find what friction holds it by, as the next model's start, or change nothing where
    /// more than the tolerance is left of the balance, in units of |L⁻¹ g|. `gradient`: the energy's.
    void hold(const Coordinates& gradient, double tolerance);
    /// What friction takes up on this part of the last way, its bounds those of the last model.
    double friction_work(double step) const;
    /// Let the bounds of friction stay what forces make them at the point, from model to model, so that the models are
    /// those of an energy. What sticks is held from where it is on. `share`: see FrictionRow::reach.
    void stop_bounds(double share);
    void let_bounds_follow() { m_stopped.clear(); }
    /// What a contact of the point does by the last model.
    ContactFriction friction_of(const ActiveContact& active);

    /// Find where the model leads from the current point: y_end. `gradient`: the energy's there. The list of contacts
    /// is made complete for the way. `driven`: all that is driven has reached its target. Where nothing is near then,
    /// none is found: a Newton step does as well.
    Way find(const Coordinates& gradient, bool driven, Coordinates& y_end);

    /// The energy at the trial is higher, by so much: damp the bodies whose contacts ask for it in the next model.
    void damp(const ZonePoint& trial, double rise);
    /// The way was good: less damping in the next model.
    void relax();
    /// Damping was of no use.
    void forget_damping();

    /// Whether who pushes at the end of the way was known before the model was solved.
    bool knew_who_pushes() const { return m_right_guess; }

private:
    /// A contact that has a row.
    struct NearContact {
        int contact;
        ContactGeometry geometry;
        double stiffness;  ///< of the row
        double wanted;     ///< from which distance on it pushes [m]
    };

    /// Friction of a contact whose bound stands still.
    struct Stopped {
        Contact contact;
        double bound, reach;
        Vec3 multiplier;

        Vec2 stretch(const FrictionRow& slip) const;
        Vec2 pull(const FrictionRow& slip) const;
    };

    void recall_forces();
    void keep_forces();
    const Stopped* find_stopped(const Contact& contact) const;
    void add_stopped_forces(Coordinates& gradient) const;
    void sort_kept();
    void list_near();
    void add_near(int index);
    void add_near(int index, const ContactGeometry& geometry);
    void sort_near();
    void make_model();
    void make_resting_model(const Coordinates& gradient);
    void make_start_row(const NearContact& near);
    void add_friction_row(const NearContact& near, const ContactGeometry& geometry);
    void add_turns();
    void advance_multipliers();
    bool solve(Coordinates& p, int& newton_steps);
    bool find_minimiser(Coordinates& p, int& newton_steps, Coordinates& y_end);
    void follow(Coordinates& p, bool driven, Way& way, Coordinates& y_end);
    bool solve_where_it_ends(
        const Coordinates& y_end, const std::vector<Impact>& impacts, Coordinates& p, int& newton_steps);
    bool turns_too_far(const Coordinates& p);
    bool add_missed(const Coordinates& y_end);
    void set_end(const Coordinates& p, Coordinates& y_end) const;
    void set_aim(const Coordinates& aim);
    void list_anew(Coordinates& y_end);
    void add_row(const NearContact& near, const ContactGeometry& geometry);
    void add_row_at_impact(const NearContact& near, double toi, const Coordinates& y_end);
    void linearise_at(const Coordinates& y_end, const std::vector<Impact>& impacts);
    bool asks_for_too_much() const;
    void shorten_blocked(const std::vector<Impact>& impacts, Coordinates& p) const;

    const Zone& m_zone;
    ZonePath& m_path;
    ZonePoint& m_point;
    BlockSystem& m_system;
    ContactModel m_model;
    ModelWorkspace m_work;
    ZoneDerivatives m_smooth;
    Placement m_at;                           // where the rows are linearised
    const Coordinates* m_gradient = nullptr;  // the energy's
    const Coordinates* m_aim = nullptr;       // of a shortened way
    std::vector<double> m_row_force;          // of the last rows, per contact of the zone
    bool m_with_curvature = true;             // in the model at hand
    bool m_right_guess = false;               // the last model was solved by one factor
    std::vector<NearContact> m_near;          // those with a row, in the order of the rows
    std::vector<ContactRow> m_first_touches;  // rows of fast bodies at their times of impact
    std::vector<PushingContact> m_pushing;
    std::vector<double> m_forces;           // of the last model, per contact of the zone
    std::vector<FrictionState> m_friction;  // the same; empty where there is none
    Memory m_kept;                          // the same, by contact, across lists
    std::vector<Stopped> m_stopped;         // by contact
    BalanceGoal m_goal;
    BalanceWorkspace m_balance;
    Coordinates m_way;             // the last way, from the point
    int m_list = -1;               // the list that m_forces is of
    std::vector<double> m_weight;  // proximal, per body and node
    CutSearch m_cut;               // of the elastic curvature
};

}  // namespace diffsim
