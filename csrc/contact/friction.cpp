#include "contact/friction.hpp"

#include <Eigen/Geometry>

namespace diffsim {

FrictionFrame friction_frame(const ContactGeometry& geometry, const ContactLaw& law) {
    const Vec3& n = geometry.normal;
    const Vec3 first = n.unitOrthogonal();
    return {geometry.closest.a.point - law.margin_share * geometry.distance * n, {first, n.cross(first)}};
}

}  // namespace diffsim
