#pragma once

#include <algorithm>

#include "dynamics/cloth_elasticity.hpp"

/// How much negative curvature a matrix of a zone loses before it is factorized.
namespace diffsim {

/// How much of the negative curvature of cloth to cut off: no more than needed, since it is what a sheet follows when
/// it buckles. The share that it takes is searched from one matrix to the next.
class CutSearch {
public:
    CutShare share() const { return m_share; }
    /// The matrix was not positive definite. False if nothing is left to be cut.
    bool more() {
        if (m_share == kAllCut) return false;
        m_share = m_share == kNothingCut ? kFirst : std::min(kFactor * m_share, kAllCut);
        return true;
    }
    /// It was, at once.
    void less() { m_share = m_share > kSmallest ? m_share / kFactor : kNothingCut; }

private:
    static constexpr CutShare kSmallest = 1.0 / 256.0, kFirst = 1.0 / 16.0;
    static constexpr double kFactor = 4.0;
    CutShare m_share = kNothingCut;
};

}  // namespace diffsim
