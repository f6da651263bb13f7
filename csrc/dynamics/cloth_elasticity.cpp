#include "dynamics/cloth_elasticity.hpp"

#include <algorithm>
#include <cmath>

namespace diffsim {
namespace {

// --- membrane --------------------------------------------------------------------------------------------------------

/// Columns of a deformation gradient, or of a change of it.
struct Deformation {
    Vec3 warp, weft;
};

Deformation deformation(const ClothTriangle& triangle, const Vec3* x) {
    const Eigen::Matrix2d& B = triangle.rest_inverse;
    const Vec3 edge1 = x[triangle.nodes[1]] - x[triangle.nodes[0]];
    const Vec3 edge2 = x[triangle.nodes[2]] - x[triangle.nodes[0]];
    return {B(0, 0) * edge1 + B(1, 0) * edge2, B(0, 1) * edge1 + B(1, 1) * edge2};
}

Vec3 green_strain(const Deformation& F) {
    return {0.5 * (F.warp.squaredNorm() - 1.0), 0.5 * (F.weft.squaredNorm() - 1.0), 0.5 * F.warp.dot(F.weft)};
}

/// Change of the strain with a change dF.
Vec3 strain_change(const Deformation& F, const Deformation& dF) {
    return {F.warp.dot(dF.warp), F.weft.dot(dF.weft), 0.5 * (F.warp.dot(dF.weft) + F.weft.dot(dF.warp))};
}

/// S11, S22, S12 of the tensor S = dW/dε.
Vec3 stress(const ElasticLaw& law, const Vec3& strain) {
    return {
        law.c11 * strain[0] + law.c12 * strain[1], law.c12 * strain[0] + law.c11 * strain[1],
        2.0 * law.shear * strain[2]};
}

/// S : ε
double contract(const Vec3& tensor_a, const Vec3& tensor_b) {
    return tensor_a[0] * tensor_b[0] + tensor_a[1] * tensor_b[1] + 2.0 * tensor_a[2] * tensor_b[2];
}

/// Elastic plus damping stress; linear in the strains, hence that of one of them.
Vec3 step_stress(const ElasticLaw& law, const Vec3& strain, const Vec3& strain_start) {
    return stress(law, strain + law.damping_over_dt * (strain - strain_start));
}

/// F S
Deformation times_tensor(const Deformation& F, const Vec3& S) {
    return {S[0] * F.warp + S[2] * F.weft, S[2] * F.warp + S[1] * F.weft};
}

/// result_i += scale P g_i with g_i the gradients of the triangle's shape functions.
void add_nodal(const ClothTriangle& triangle, const Deformation& P, double scale, Vec3* result) {
    const Eigen::Matrix2d& B = triangle.rest_inverse;
    const Vec3 on1 = scale * (B(0, 0) * P.warp + B(0, 1) * P.weft);
    const Vec3 on2 = scale * (B(1, 0) * P.warp + B(1, 1) * P.weft);
    result[triangle.nodes[0]] -= on1 + on2;
    result[triangle.nodes[1]] += on1;
    result[triangle.nodes[2]] += on2;
}

/// The nearest positive semidefinite tensor: negative principal values cut to zero.
Vec3 positive_part(const Vec3& S) {
    const double mean = 0.5 * (S[0] + S[1]);
    const double determinant = S[0] * S[1] - S[2] * S[2];
    if (mean >= 0.0 && determinant >= 0.0) return S;
    if (mean <= 0.0 && determinant >= 0.0) return Vec3::Zero();
    // Of both signs, low < 0 < high:  S⁺ = high (S - low 1) / (high - low).
    const double half_difference = 0.5 * (S[0] - S[1]);
    const double radius = std::sqrt(half_difference * half_difference + S[2] * S[2]);
    const double low = mean - radius, share = (mean + radius) / (2.0 * radius);
    return share * (S - Vec3(low, low, 0.0));
}

// --- bending ---------------------------------------------------------------------------------------------------------

Mat34 gather(const ClothHinge& hinge, const Vec3* x) {
    Mat34 points;
    for (int k = 0; k < 4; ++k) points.col(k) = x[hinge.nodes[k]];
    return points;
}

void scatter(const ClothHinge& hinge, const Mat34& values, Vec3* result) {
    for (int k = 0; k < 4; ++k) result[hinge.nodes[k]] += values.col(k);
}

/// Elastic plus damping angle, at a hinge that is not degenerate [rad].
double step_angle(const ElasticLaw& law, const ClothHinge& hinge, double angle, double angle_start) {
    return wrap_angle(angle - hinge.rest_angle) + law.damping_over_dt * wrap_angle(angle - angle_start);
}

/// W angles
std::vector<double> times_weights(const Cloth& cloth, const std::vector<double>& angles) {
    std::vector<double> result(angles.size());
    for (std::size_t h = 0; h < angles.size(); ++h) result[h] = cloth.hinges[h].weight * angles[h];
    for (const HingeCoupling& coupling : cloth.couplings) {
        result[coupling.a] += coupling.weight * angles[coupling.b];
        result[coupling.b] += coupling.weight * angles[coupling.a];
    }
    return result;
}

double dot(const std::vector<double>& a, const std::vector<double>& b) {
    double sum = 0.0;
    for (std::size_t i = 0; i < a.size(); ++i) sum += a[i] * b[i];
    return sum;
}

/// How far each hinge is bent and was bent in the step; nothing where it is degenerate.
struct HingeAngles {
    std::vector<double> bent, change;  ///< from rest, from the start [rad]
};

/// How fast each angle changes along a direction of the nodes.
std::vector<double> angle_changes(const Cloth& cloth, const std::vector<Mat34>& gradients, const Vec3* direction) {
    std::vector<double> changes;
    for (std::size_t h = 0; h < gradients.size(); ++h)
        changes.push_back(gradients[h].cwiseProduct(gather(cloth.hinges[h], direction)).sum());
    return changes;
}

HingeAngles hinge_angles(const Cloth& cloth, const ElasticStart& start, const Vec3* x) {
    HingeAngles angles;
    angles.bent.assign(cloth.hinges.size(), 0.0);
    angles.change.assign(cloth.hinges.size(), 0.0);
    for (std::size_t h = 0; h < cloth.hinges.size(); ++h) {
        const DihedralFrame frame = dihedral_frame(gather(cloth.hinges[h], x));
        if (frame.degenerate) continue;
        angles.bent[h] = wrap_angle(frame.angle - cloth.hinges[h].rest_angle);
        angles.change[h] = wrap_angle(frame.angle - start.angle[h]);
    }
    return angles;
}

}  // namespace

ElasticLaw elastic_law(const Cloth& cloth, const ClothParameters& parameters, double dt) {
    const double c11 = parameters.stretch / (1.0 - cloth.poisson * cloth.poisson);
    return {c11, cloth.poisson * c11, parameters.shear, parameters.bend, parameters.damping / dt};
}

ElasticStart elastic_start(const Cloth& cloth, const Vec3* x_start) {
    ElasticStart start;
    start.strain.reserve(cloth.triangles.size());
    start.angle.reserve(cloth.hinges.size());
    for (const ClothTriangle& triangle : cloth.triangles)
        start.strain.push_back(green_strain(deformation(triangle, x_start)));
    for (const ClothHinge& hinge : cloth.hinges) start.angle.push_back(dihedral_frame(gather(hinge, x_start)).angle);
    return start;
}

ElasticStart extrapolated(const ElasticStart& from, const ElasticStart& to, double share) {
    ElasticStart result = from;
    for (std::size_t t = 0; t < from.strain.size(); ++t) result.strain[t] += share * (to.strain[t] - from.strain[t]);
    for (std::size_t h = 0; h < from.angle.size(); ++h)
        result.angle[h] += share * wrap_angle(to.angle[h] - from.angle[h]);
    return result;
}

double elastic_energy(
    const Cloth& cloth, const ClothParameters& parameters, double dt, const ElasticStart& start, const Vec3* x) {
    const ElasticLaw law = elastic_law(cloth, parameters, dt);
    double membrane = 0.0;
    for (std::size_t t = 0; t < cloth.triangles.size(); ++t) {
        const ClothTriangle& triangle = cloth.triangles[t];
        const Vec3 strain = green_strain(deformation(triangle, x)), change = strain - start.strain[t];
        membrane += triangle.area * (contract(stress(law, strain), strain) +
                                     law.damping_over_dt * contract(stress(law, change), change));
    }
    const HingeAngles angles = hinge_angles(cloth, start, x);
    double bending = dot(angles.bent, times_weights(cloth, angles.bent));
    if (law.damping_over_dt > 0.0)
        bending += law.damping_over_dt * dot(angles.change, times_weights(cloth, angles.change));
    return 0.5 * (membrane + law.bend * bending);
}

void add_elastic_gradient(
    const Cloth& cloth, const ClothParameters& parameters, double dt, const ElasticStart& start, const Vec3* x,
    double scale, Vec3* gradient) {
    const ElasticLaw law = elastic_law(cloth, parameters, dt);
    for (std::size_t t = 0; t < cloth.triangles.size(); ++t) {
        const ClothTriangle& triangle = cloth.triangles[t];
        const Deformation F = deformation(triangle, x);
        const Vec3 S = step_stress(law, green_strain(F), start.strain[t]);
        add_nodal(triangle, times_tensor(F, S), scale * triangle.area, gradient);
    }
    const BentHinges bent = bent_hinges(cloth, law, start, x);
    for (std::size_t h = 0; h < cloth.hinges.size(); ++h)
        scatter(cloth.hinges[h], scale * bent.moments[h] * bent.gradients[h], gradient);
}

void add_elastic_hessian_product(
    const Cloth& cloth, const ClothParameters& parameters, double dt, const ElasticStart& start, const Vec3* x,
    const Vec3* direction, double scale, Vec3* product) {
    const ElasticLaw law = elastic_law(cloth, parameters, dt);
    const double gain = 1.0 + law.damping_over_dt;
    for (std::size_t t = 0; t < cloth.triangles.size(); ++t) {
        const ClothTriangle& triangle = cloth.triangles[t];
        const Deformation F = deformation(triangle, x), dF = deformation(triangle, direction);
        const Vec3 S = step_stress(law, green_strain(F), start.strain[t]);
        const Vec3 dS = gain * stress(law, strain_change(F, dF));
        // dP = dF S + F dS
        const Deformation by_geometry = times_tensor(dF, S), by_stress = times_tensor(F, dS);
        const Deformation dP{by_geometry.warp + by_stress.warp, by_geometry.weft + by_stress.weft};
        add_nodal(triangle, dP, scale * triangle.area, product);
    }
    const BentHinges bent = bent_hinges(cloth, law, start, x);
    const std::vector<double> weighed = times_weights(cloth, angle_changes(cloth, bent.gradients, direction));
    for (std::size_t h = 0; h < cloth.hinges.size(); ++h) {
        const ClothHinge& hinge = cloth.hinges[h];
        const double moment_change = gain * law.bend * weighed[h];
        const Mat34 bending = dihedral_hessian_product(bent.frames[h], gather(hinge, direction));
        scatter(hinge, scale * (moment_change * bent.gradients[h] + bent.moments[h] * bending), product);
    }
}

ClothParameters add_elastic_backward(
    const Cloth& cloth, const ClothParameters& parameters, double dt, const ElasticStart& start, const Vec3* x,
    const Vec3* x_start, const Vec3* direction, double scale, Vec3* grad_x_start) {
    const ElasticLaw law = elastic_law(cloth, parameters, dt);
    const ElasticLaw by_stretch = elastic_law(cloth, {0.0, 1.0, 0.0, 0.0, 0.0}, dt);
    const ElasticLaw by_shear = elastic_law(cloth, {0.0, 0.0, 1.0, 0.0, 0.0}, dt);
    ClothParameters grad;
    for (std::size_t t = 0; t < cloth.triangles.size(); ++t) {
        const ClothTriangle& triangle = cloth.triangles[t];
        const Deformation F = deformation(triangle, x);
        const Vec3 strain = green_strain(F), change = strain - start.strain[t];
        const Vec3 felt = strain + law.damping_over_dt * change;
        // s = A dε : C (ε + damping / dt (ε - ε_start)), with dε along the direction.
        const Vec3 along = scale * triangle.area * strain_change(F, deformation(triangle, direction));
        const Vec3 stress_along = stress(law, along);
        grad.stretch += contract(along, stress(by_stretch, felt));
        grad.shear += contract(along, stress(by_shear, felt));
        grad.damping += contract(stress_along, change) / dt;
        if (law.damping_over_dt == 0.0) continue;
        add_nodal(
            triangle, times_tensor(deformation(triangle, x_start), stress_along), -law.damping_over_dt, grad_x_start);
    }
    // s = bend dθ · W (θ - θ0 + damping / dt (θ - θ_start)), with dθ along the direction.
    const BentHinges bent = bent_hinges(cloth, law, start, x);
    const HingeAngles angles = hinge_angles(cloth, start, x);
    std::vector<double> along = times_weights(cloth, angle_changes(cloth, bent.gradients, direction));
    for (double& value : along) value *= scale;
    grad.bend += dot(along, angles.bent) + law.damping_over_dt * dot(along, angles.change);
    grad.damping += law.bend * dot(along, angles.change) / dt;
    if (law.damping_over_dt == 0.0) return grad;
    for (std::size_t h = 0; h < cloth.hinges.size(); ++h) {
        const ClothHinge& hinge = cloth.hinges[h];
        if (bent.frames[h].degenerate) continue;
        const DihedralFrame frame_start = dihedral_frame(gather(hinge, x_start));
        scatter(hinge, -law.damping_over_dt * law.bend * along[h] * dihedral_gradient(frame_start), grad_x_start);
    }
    return grad;
}

TriangleHessian triangle_hessian(
    const Cloth& cloth, const ElasticLaw& law, const ElasticStart& start, const Vec3* x, int id, CutShare cut) {
    const ClothTriangle& triangle = cloth.triangles[id];
    const Deformation F = deformation(triangle, x);
    Vec3 S = triangle.area * step_stress(law, green_strain(F), start.strain[id]);
    if (cut > 0.0) S += cut * (positive_part(S) - S);
    const double gain = triangle.area * (1.0 + law.damping_over_dt);
    const double c11 = gain * law.c11, c12 = gain * law.c12, shear = gain * law.shear;

    // Blocks of nodes 1 and 2, whose shape functions have the rows g of rest_inverse as gradients:
    //   Σ (∂ε/∂xi)ᵀ C (∂ε/∂xj) + (giᵀ S gj) 1,  its first part gathered by products of the columns of F.
    const Mat3 warp_warp = F.warp * F.warp.transpose(), weft_weft = F.weft * F.weft.transpose();
    const Mat3 warp_weft = F.warp * F.weft.transpose(), weft_warp = warp_weft.transpose();
    const auto block = [&](int i, int j) -> Mat3 {
        const double u_i = triangle.rest_inverse(i, 0), v_i = triangle.rest_inverse(i, 1);
        const double u_j = triangle.rest_inverse(j, 0), v_j = triangle.rest_inverse(j, 1);
        Mat3 result = (c11 * u_i * u_j + shear * v_i * v_j) * warp_warp;
        result += (c11 * v_i * v_j + shear * u_i * u_j) * weft_weft;
        result += (c12 * u_i * v_j + shear * v_i * u_j) * warp_weft;
        result += (c12 * v_i * u_j + shear * u_i * v_j) * weft_warp;
        result.diagonal().array() += S[0] * u_i * u_j + S[1] * v_i * v_j + S[2] * (u_i * v_j + v_i * u_j);
        return result;
    };
    const Mat3 h11 = block(0, 0), h12 = block(0, 1), h22 = block(1, 1);
    const Mat3 h10 = -(h11 + h12), h20 = -(h12.transpose() + h22);  // a shift of all three changes nothing

    TriangleHessian element;
    element.id = id;
    element.nodes = triangle.nodes;
    element.matrix.block<3, 3>(0, 0) = -(h10 + h20);
    element.matrix.block<3, 3>(0, 3) = h10.transpose();
    element.matrix.block<3, 3>(0, 6) = h20.transpose();
    element.matrix.block<3, 3>(3, 0) = h10;
    element.matrix.block<3, 3>(3, 3) = h11;
    element.matrix.block<3, 3>(3, 6) = h12;
    element.matrix.block<3, 3>(6, 0) = h20;
    element.matrix.block<3, 3>(6, 3) = h12.transpose();
    element.matrix.block<3, 3>(6, 6) = h22;
    return element;
}

BentHinges bent_hinges(const Cloth& cloth, const ElasticLaw& law, const ElasticStart& start, const Vec3* x) {
    BentHinges bent;
    bent.frames.reserve(cloth.hinges.size());
    bent.gradients.reserve(cloth.hinges.size());
    std::vector<double> angles(cloth.hinges.size(), 0.0);
    for (std::size_t h = 0; h < cloth.hinges.size(); ++h) {
        const DihedralFrame& frame = bent.frames.emplace_back(dihedral_frame(gather(cloth.hinges[h], x)));
        bent.gradients.push_back(dihedral_gradient(frame));
        if (!frame.degenerate) angles[h] = law.bend * step_angle(law, cloth.hinges[h], frame.angle, start.angle[h]);
    }
    bent.moments = times_weights(cloth, angles);
    return bent;
}

void set_hinge_hessian(
    const Cloth& cloth, const ElasticLaw& law, const BentHinges& bent, int id, CutShare cut, std::size_t& coupling,
    HingeHessian& result) {
    const ClothHinge& hinge = cloth.hinges[id];
    const double stiffness = law.bend * (1.0 + law.damping_over_dt);
    result.nodes.assign(hinge.nodes.begin(), hinge.nodes.end());
    result.gradient = bent.gradients[id];
    result.coupled.clear();
    for (int k = 0; k < 4; ++k) result.coupled.push_back(0.5 * stiffness * hinge.weight * result.gradient.col(k));
    for (; coupling < cloth.couplings.size() && cloth.couplings[coupling].a == id; ++coupling) {
        const HingeCoupling& entry = cloth.couplings[coupling];
        for (int k = 0; k < 4; ++k) {
            const int node = cloth.hinges[entry.b].nodes[k];
            const auto found = std::find(result.nodes.begin(), result.nodes.end(), node);
            const std::size_t slot = static_cast<std::size_t>(found - result.nodes.begin());
            if (found == result.nodes.end()) {
                result.nodes.push_back(node);
                result.coupled.push_back(Vec3::Zero());
            }
            result.coupled[slot] += stiffness * entry.weight * bent.gradients[entry.b].col(k);
        }
    }
    if (cut < 1.0)
        result.curvature = 0.5 * (1.0 - cut) * bent.moments[id] * dihedral_hessian(bent.frames[id]);
    else
        result.curvature.setZero();
}

}  // namespace diffsim
