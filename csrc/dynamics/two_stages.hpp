#pragma once

#include <cmath>

/// The two-stage scheme of cloth: the singly diagonally implicit Runge–Kutta method of second order that is L-stable
/// [alexander1977diagonally], for x' = v, v' = a(x, v). Its first stage is a step of implicit Euler over γ dt, to x1;
/// the second, which is also the step's end, has
///     v2 = v0 + dt ((1 - γ) a(x1) + γ a(x2)),   x2 = x0 + dt ((1 - γ) v1 + γ v2),   v1 = (x1 - x0) / (γ dt).
/// So x2 = x0 + r (x1 - x0) + γ dt v2 with r = (1 - γ) / γ. The same rule for strains, whose rates damping acts
/// on, has the rate (ε2 - ε0 - r (ε1 - ε0)) / (γ dt) at the end.
namespace diffsim {

inline const double kStage = 1.0 - std::sqrt(0.5);               ///< γ
inline const double kFirstStageShare = (1.0 - kStage) / kStage;  ///< r

}  // namespace diffsim
