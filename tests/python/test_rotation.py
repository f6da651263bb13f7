"""Rotations, and Appendix A to C of Qiao et al. 2020 with their errata."""

import sys

import numpy as np
import pytest
import torch
from torch import Tensor

from diffsim import rotation

ROUNDING = 1e-13


def random_quaternions(count: int) -> Tensor:
    q = torch.randn(count, 4, dtype=torch.float64)
    return q / q.norm(dim=-1, keepdim=True)


def random_rpy(count: int) -> Tensor:
    """Roll, pitch, yaw away from the poles."""
    return (torch.rand(count, 3, dtype=torch.float64) - 0.5) * torch.tensor([6.2, 2.8, 6.2], dtype=torch.float64)


def matrix_from_rpy(rpy: Tensor) -> Tensor:
    """R = Rz(ψ) Ry(θ) Rx(φ), written as the product of three matrices: independent of quaternions."""
    (cr, cp, cy), (sr, sp, sy) = rpy.cos(), rpy.sin()
    one, zero = torch.ones_like(cr), torch.zeros_like(cr)

    def matrix(*rows: list[Tensor]) -> Tensor:
        return torch.stack([torch.stack(row) for row in rows])

    rx = matrix([one, zero, zero], [zero, cr, -sr], [zero, sr, cr])
    ry = matrix([cp, zero, sp], [zero, one, zero], [-sp, zero, cp])
    rz = matrix([cy, -sy, zero], [sy, cy, zero], [zero, zero, one])
    return rz @ ry @ rx


def vee(skew: Tensor) -> Tensor:
    return torch.stack([skew[2, 1], skew[0, 2], skew[1, 0]])


# ---- Quaternions ------------------------------------------------------------------------------------------------


def test_matrix_is_a_rotation_whatever_the_length_of_q() -> None:
    q = random_quaternions(50)
    matrix = rotation.to_matrix(3.0 * q)
    np.testing.assert_allclose(matrix, rotation.to_matrix(q), atol=ROUNDING)
    np.testing.assert_allclose(matrix @ matrix.mT, torch.eye(3).expand(50, 3, 3), atol=ROUNDING)
    np.testing.assert_allclose(torch.linalg.det(matrix), 1.0, atol=ROUNDING)


def test_quarter_turn_about_z() -> None:
    q = rotation.exp(np.array([0.0, 0.0, np.pi / 2]))
    np.testing.assert_allclose(rotation.rotate(q, np.array([1.0, 0.0, 0.0])), [0.0, 1.0, 0.0], atol=ROUNDING)


def test_from_matrix_inverts_to_matrix() -> None:
    half_turns = torch.eye(4, dtype=torch.float64)  # w = 0 three times: where the sign and the branch are delicate
    q = torch.cat([random_quaternions(200), half_turns])
    found = rotation.from_matrix(rotation.to_matrix(q))
    np.testing.assert_allclose((found * q).sum(-1).abs(), 1.0, atol=ROUNDING)
    assert (found[:, 0] >= 0.0).all()


def test_multiply_composes_and_conjugate_inverts() -> None:
    a, b, p = random_quaternions(20), random_quaternions(20), torch.randn(20, 3, dtype=torch.float64)
    twice = rotation.rotate(a, rotation.rotate(b, p))
    np.testing.assert_allclose(rotation.rotate(rotation.multiply(a, b), p), twice, atol=ROUNDING)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64).expand(20, 4)
    np.testing.assert_allclose(rotation.multiply(a, rotation.conjugate(a)), identity, atol=ROUNDING)


def test_exp_is_the_exponential_of_the_cross_product() -> None:
    for length in (1e-9, 1e-3, 0.00999, 0.01001, 0.5, 3.0, 7.0):
        v = torch.randn(3, dtype=torch.float64)
        v = v / v.norm() * length
        zero = torch.zeros((), dtype=torch.float64)
        rows = [[zero, -v[2], v[1]], [v[2], zero, -v[0]], [-v[1], v[0], zero]]
        skew = torch.stack([torch.stack(row) for row in rows])
        np.testing.assert_allclose(rotation.to_matrix(rotation.exp(v)), torch.linalg.matrix_exp(skew), atol=1e-13)


def test_log_inverts_exp() -> None:
    for length in (0.0, 1e-12, 1e-5, 0.0199, 0.0201, 1.0, 3.1):
        v = torch.randn(10, 3, dtype=torch.float64)
        v = v / v.norm(dim=-1, keepdim=True) * length
        for sign in (1.0, -2.0):  # q, -q and any multiple are the same rotation
            found = rotation.log(sign * rotation.exp(v))
            np.testing.assert_allclose(found, v, rtol=1e-12, atol=1e-13 * length)


def test_log_of_a_half_turn() -> None:
    found = rotation.log(np.array([0.0, 0.6, 0.0, 0.8]))
    np.testing.assert_allclose(found, np.pi * np.array([0.6, 0.0, 0.8]), atol=ROUNDING)


@pytest.mark.parametrize("length", [0.0, 1e-8, 0.0099, 0.0101, 1.0])
def test_exp_and_log_have_right_gradients_also_at_zero(length: float) -> None:
    v = (torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64) * length).requires_grad_()
    jacobian = torch.autograd.functional.jacobian(rotation.exp, v)
    assert jacobian.abs().max() > 0.4
    assert torch.autograd.gradcheck(rotation.exp, v)
    assert torch.autograd.gradcheck(rotation.log, rotation.exp(v.detach()).requires_grad_())
    if length == 0.0:
        expected = torch.cat([torch.zeros(1, 3), 0.5 * torch.eye(3)])
        np.testing.assert_allclose(jacobian, expected, atol=0.0)


def test_gradient_of_a_quaternion_is_orthogonal_to_it_and_a_central_difference() -> None:
    q, p = 1.3 * random_quaternions(1)[0], torch.randn(3, dtype=torch.float64)
    for function in (rotation.to_matrix, rotation.log, rotation.to_rpy, lambda q: rotation.rotate(q, p)):
        leaf = q.clone().requires_grad_()
        assert torch.autograd.gradcheck(function, leaf)
        value = function(leaf)
        (gradient,) = torch.autograd.grad(value, leaf, torch.randn_like(value))
        assert gradient.norm() > 1e-3
        assert abs(float(gradient @ q)) < 1e-13 * float(gradient.norm())


def test_remaining_gradients() -> None:
    a, b = (q.requires_grad_() for q in random_quaternions(2))
    assert torch.autograd.gradcheck(rotation.multiply, (a, b))
    assert torch.autograd.gradcheck(rotation.conjugate, a)
    rpy, p = random_rpy(1)[0].requires_grad_(), torch.randn(3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(rotation.from_rpy, rpy)
    assert torch.autograd.gradcheck(rotation.rpy_jacobian, (rpy, p))
    # Any matrix near a rotation: the formula extends smoothly.
    assert torch.autograd.gradcheck(rotation.from_matrix, rotation.to_matrix(a.detach()).requires_grad_())


def test_arrays_answer_arrays_and_tensors_tensors() -> None:
    q = rotation.from_rpy(np.array([0.1, 0.2, 0.3]))
    assert isinstance(q, np.ndarray)
    assert q.dtype == np.float64
    single = rotation.from_rpy(torch.tensor([0.1, 0.2, 0.3]))
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single, q, rtol=1e-6)
    mixed = rotation.rotate(torch.from_numpy(q), np.array([1.0, 0.0, 0.0]))
    assert isinstance(mixed, Tensor)
    batch = rotation.rotate(q, np.ones((5, 2, 3)))
    assert batch.shape == (5, 2, 3)


def test_functions_can_be_mapped() -> None:
    q, p = random_quaternions(6), torch.randn(6, 3, dtype=torch.float64)
    np.testing.assert_allclose(torch.func.vmap(rotation.rotate)(q, p), rotation.rotate(q, p), atol=ROUNDING)
    np.testing.assert_allclose(torch.func.vmap(rotation.log)(q), rotation.log(q), atol=ROUNDING)


# ---- Roll, pitch, yaw -------------------------------------------------------------------------------------------


def test_from_rpy_is_the_papers_product_of_matrices() -> None:
    for rpy in random_rpy(20):
        np.testing.assert_allclose(rotation.to_matrix(rotation.from_rpy(rpy)), matrix_from_rpy(rpy), atol=ROUNDING)


def test_to_rpy_inverts_from_rpy() -> None:
    rpy = random_rpy(200)
    np.testing.assert_allclose(rotation.to_rpy(rotation.from_rpy(rpy)), rpy, atol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_to_rpy_at_the_pole_gives_the_same_rotation(sign: float) -> None:
    q = rotation.from_rpy(torch.tensor([0.3, sign * np.pi / 2, 0.8], dtype=torch.float64)).requires_grad_()
    rpy = rotation.to_rpy(q)
    assert float(rpy[1].detach()) == pytest.approx(sign * np.pi / 2, abs=1e-7)
    np.testing.assert_allclose(
        rotation.to_matrix(rotation.from_rpy(rpy)).detach(), rotation.to_matrix(q).detach(), atol=1e-7
    )
    (gradient,) = torch.autograd.grad(rpy.sum(), q)
    assert gradient.isfinite().all()


def test_rates_matrix_is_the_angular_velocity() -> None:
    """Appendix A: the columns of T are the ω in [ω]× = Ṙ Rᵀ of each angle."""
    for rpy in random_rpy(10):
        derivative = torch.autograd.functional.jacobian(matrix_from_rpy, rpy)
        expected = torch.stack([vee(derivative[..., k] @ matrix_from_rpy(rpy).T) for k in range(3)], -1)
        found = rotation.rpy_rates_to_angular_velocity(rpy)
        np.testing.assert_allclose(found, expected, atol=ROUNDING)


def test_eq_19_as_printed_is_wrong() -> None:
    """The y component of ω needs cosθ sinψ φ' + cosψ θ'; printed is sinψ φ' + cosψ θ'."""
    rpy, rates = random_rpy(1)[0], torch.tensor([0.7, -0.4, 0.2], dtype=torch.float64)
    _, cos_pitch, cos_yaw = rpy.cos()
    sin_yaw = rpy[2].sin()
    y = (rotation.rpy_rates_to_angular_velocity(rpy) @ rates)[1]
    assert float(y) == pytest.approx(float(cos_pitch * sin_yaw * rates[0] + cos_yaw * rates[1]), abs=ROUNDING)
    assert abs(float(y - (sin_yaw * rates[0] + cos_yaw * rates[1]))) > 1e-3


def test_jacobian_is_the_derivative_of_the_rotated_point() -> None:
    """Appendix C, against autograd of the product of matrices and against central differences."""
    step = 1e-5
    for rpy, p in zip(random_rpy(10), torch.randn(10, 3, dtype=torch.float64)):
        found = rotation.rpy_jacobian(rpy, p)
        expected = torch.autograd.functional.jacobian(lambda angles, p=p: matrix_from_rpy(angles) @ p, rpy)
        np.testing.assert_allclose(found, expected, atol=ROUNDING)
        shift = step * torch.eye(3, dtype=torch.float64)
        sides = [torch.stack([matrix_from_rpy(rpy + s * d) @ p for d in shift], -1) for s in (1.0, -1.0)]
        np.testing.assert_allclose(found, (sides[0] - sides[1]) / (2.0 * step), atol=1e-9)


def test_appendix_c_as_printed_is_wrong_and_right_with_its_brackets() -> None:
    rpy, p = torch.tensor([0.4, 0.5, 0.6], dtype=torch.float64), torch.tensor([0.3, -0.8, 1.1], dtype=torch.float64)
    (cr, cp, cy), (sr, sp, sy) = rpy.cos(), rpy.sin()
    _, y, z = p
    by_roll = rotation.rpy_jacobian(rpy, p)[:, 0]
    mended = torch.stack(
        [
            y * (sr * sy + cr * sp * cy) + z * (cr * sy - sr * sp * cy),
            y * (cr * sp * sy - sr * cy) - z * (sr * sp * sy + cr * cy),
            y * cr * cp - z * sr * cp,
        ]
    )
    np.testing.assert_allclose(by_roll, mended, atol=ROUNDING)
    printed = y * sr * sy + cr * sp * cy + z * cr * sy - sr * sp * cy
    assert abs(float(by_roll[0] - printed)) > 1e-2


def test_mass_matrix_is_the_kinetic_energy() -> None:
    """Eq. 22 with its lower block m·1: ½ q'ᵀ M q' = ½ m v² + ½ ωᵀ I ω, and not with the 1 that is printed."""
    root = torch.randn(3, 3, dtype=torch.float64)
    inertia, mass = root @ root.T + torch.eye(3), torch.tensor(2.5, dtype=torch.float64)
    for rpy, rates in zip(random_rpy(5), torch.randn(5, 6, dtype=torch.float64)):
        matrix = matrix_from_rpy(rpy)
        slope = torch.autograd.functional.jacobian(matrix_from_rpy, rpy) @ rates[:3]
        omega_body = vee(matrix.T @ slope)
        energy = 0.5 * mass * rates[3:] @ rates[3:] + 0.5 * omega_body @ inertia @ omega_body
        found = rotation.rpy_mass_matrix(rpy, mass, inertia)
        assert float(0.5 * rates @ found @ rates) == pytest.approx(float(energy), rel=1e-12)
        np.testing.assert_allclose(found, found.T, atol=ROUNDING)
        printed = found.clone()
        printed[3:, 3:] = torch.eye(3)
        assert abs(float(0.5 * rates @ printed @ rates - energy)) > 1e-3 * float(energy)


def test_mass_matrix_takes_batches() -> None:
    rpy, mass = random_rpy(4), torch.rand(4, dtype=torch.float64) + 1.0
    inertia = torch.diag(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    found = rotation.rpy_mass_matrix(rpy, mass, inertia)
    assert found.shape == (4, 6, 6)
    np.testing.assert_allclose(found[2], rotation.rpy_mass_matrix(rpy[2], mass[2], inertia), atol=ROUNDING)


# ---- other orders ----------------------------------------------------------------------------------------------------


def test_orders_of_components_are_exchanged() -> None:
    q = np.array([[0.1, 0.2, 0.3, 0.4], [1.0, 2.0, 3.0, 4.0]])
    assert np.array_equal(rotation.to_xyzw(q)[1], [2.0, 3.0, 4.0, 1.0])
    assert np.array_equal(rotation.from_xyzw(rotation.to_xyzw(q)), q)
    assert torch.equal(torch.func.vmap(rotation.from_xyzw)(torch.from_numpy(q))[0], torch.tensor(q[0]).roll(1))
    assert torch.autograd.gradcheck(rotation.from_xyzw, torch.from_numpy(q).requires_grad_())


def test_scipys_rotations_turn_vectors_as_ours_do() -> None:
    q = torch.randn(5, 4, dtype=torch.float64, requires_grad=True)
    p = np.array([0.3, -0.2, 0.9])
    for value in (q, q.detach().numpy()):
        turned = rotation.to_scipy(value)
        np.testing.assert_allclose(turned.apply(p), rotation.rotate(q.detach().numpy(), p), atol=1e-14)
    back = rotation.from_scipy(turned)
    assert (back[:, 0] >= 0.0).all()
    np.testing.assert_allclose(rotation.to_matrix(back), rotation.to_matrix(q.detach().numpy()), atol=1e-14)
    assert rotation.from_scipy(turned[0]).shape == (4,)


def test_without_scipy_the_mend_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scipy.spatial.transform", None)
    with pytest.raises(ImportError, match=r"pip install 'mesh-diffsim\[scipy\]'"):
        rotation.to_scipy(np.array([1.0, 0.0, 0.0, 0.0]))
