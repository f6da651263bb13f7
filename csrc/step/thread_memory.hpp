#pragma once

#include <vector>

#include "adjoint/adjoint.hpp"
#include "step/step.hpp"

/// What each thread of a step keeps to itself, and when there is work for more than one.
namespace diffsim {

inline constexpr int kWorthSharing = 64;  ///< bodies and nodes of zones: fewer are done before a thread has woken up
inline constexpr int kPortionsPerThread = 32;  ///< of the zones: they take differently long

/// A kinematic body that did not reach its target.
struct BlockedDrive {
    int group;  ///< that was in its way
    int body;
    Vec6 reached;
};

/// Who a group that was not solved is about; see step/failed_objects.hpp.
struct FailedGroup {
    int group;
    std::vector<int> objects;
};

/// What one thread collects of the groups it solves.
struct GroupResults {
    std::vector<Contact> contacts;          ///< active, group after group
    std::vector<ExactContact> exact;        ///< of theirs, if they are
    std::vector<ContactFriction> friction;  ///< of theirs, if the scene has some
    std::vector<BlockedDrive> blocked;
    std::vector<FailedGroup> failed;  ///< also of groups that were joined by others and solved again

    void clear() {
        contacts.clear();
        exact.clear();
        friction.clear();
        blocked.clear();
        failed.clear();
    }
};

/// What a zone gives a body that it shares with others.
struct SharedGradient {
    int zone, body;
    Vec6 pose, drive;
};

/// What a zone gives a coefficient of friction.
struct FrictionGradient {
    int zone, object;
    double value;
};

/// What one thread needs for the backward of zones, beside the zone.
struct ZoneBackwardScratch {
    std::vector<int> local;  ///< see RecordedZones::rebuild
    Coordinates upstream;
    AdjointWorkspace adjoint, elastic;  ///< of the zone; of split coupling's elastic pass
    std::vector<SharedGradient> shared;
    std::vector<FrictionGradient> friction;
};

/// What one thread of a step keeps to itself; see StepWorkspace::memory.
struct ThreadMemory {
    ZoneMemory zone;
    GroupResults results;
    std::vector<int> near;  ///< scratch
    ZoneBackwardScratch backward;
};

}  // namespace diffsim
