"""Rotations as unit quaternions `w, x, y, z`, and the roll-pitch-yaw convention of Qiao et al. 2020, Appendix A to C.

All functions take leading batch axes, broadcast, and are differentiable in all their arguments. Torch tensors give
tensors; numpy arrays (and lists) give float64 arrays. Only shapes that do not fit raise (torch's RuntimeError or
ValueError); values are not checked.

What the gradient with respect to a quaternion means. A rotation has three degrees of freedom, its quaternion q four
numbers. `to_matrix`, `rotate`, `log` and `to_rpy`, like the simulator, are functions of q / |q|: defined for every q
other than zero and constant along q. Their gradient in R⁴ is therefore orthogonal to q, equal to plain central
differences in the four components, and holds the derivative along the unit sphere and nothing else. A step along it
leaves the sphere by second order only; normalise after each. `multiply` is the plain bilinear product and `from_…` give
unit quaternions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Array = TypeVar("Array", Tensor, NDArray[np.float64])

# Below this squared angle sin and cos are taken from their series, cut at θ⁶: the term left out is below 1e-21.
_SERIES_ANGLE_SQ = 1e-4
# Below this cos θ roll and yaw turn about axes closer than rounding can tell: only their sum is defined.
_POLE = 1e-12


def multiply(a: Array, b: Array) -> Array:
    """The Hamilton product a b, shape (..., 4): the rotation by b, then by a."""
    return _apply(_multiply, a, b)


def conjugate(q: Array) -> Array:
    """The opposite rotation of a unit quaternion, shape (..., 4)."""
    return _apply(lambda q: q * q.new_tensor([1.0, -1.0, -1.0, -1.0]), q)


def rotate(q: Array, p: Array) -> Array:
    """Rotate vectors p, shape (..., 3), by q / |q|, shape (..., 4): from the body's axes to the world's."""
    return _apply(lambda q, p: _times(_to_matrix(q), p), q, p)


def to_matrix(q: Array) -> Array:
    """The rotation matrix of q / |q|, shape (..., 3, 3); its columns are the body's axes in the world."""
    return _apply(_to_matrix, q)


def from_matrix(matrix: Array) -> Array:
    """The quaternion, w >= 0, of a rotation matrix of shape (..., 3, 3)."""
    return _apply(_from_matrix, matrix)


def exp(rotation_vector: Array) -> Array:
    """The quaternion of a rotation vector, axis times angle [rad], shape (..., 3). Smooth everywhere, also at zero."""
    return _apply(_exp, rotation_vector)


def log(q: Array) -> Array:
    """The shortest rotation vector [rad], shape (..., 3), of q / |q|. Smooth but for rotations by π."""
    return _apply(_log, q)


def from_xyzw(q: Array) -> Array:
    """The same quaternion, shape (..., 4), given in the order x, y, z, w: that of Warp, Newton, scipy and ROS."""
    return _apply(lambda q: q.roll(1, -1), q)


def to_xyzw(q: Array) -> Array:
    """The same quaternion, shape (..., 4), in the order x, y, z, w: that of Warp, Newton, scipy and ROS."""
    return _apply(lambda q: q.roll(-1, -1), q)


def from_scipy(rotation: Rotation) -> NDArray[np.float64]:
    """The quaternions w, x, y, z, w >= 0, of scipy's rotations; shape (4,) or (k, 4), as they are one or many."""
    return np.asarray(from_xyzw(np.asarray(rotation.as_quat(canonical=True))))


def to_scipy(q: Tensor | NDArray[np.float64]) -> Rotation:
    """Scipy's rotation, or rotations, of q / |q|, shape (4,) or (k, 4); newer versions of scipy take more axes.

    Raises: ImportError where scipy is not installed; what scipy raises for quaternions of length zero.
    Gradients: none.
    """
    try:
        from scipy.spatial.transform import Rotation
    except ImportError as error:
        raise ImportError("rotation.to_scipy needs scipy: pip install 'mesh-diffsim[scipy]'", name="scipy") from error
    values = q.numpy(force=True) if isinstance(q, Tensor) else q
    return Rotation.from_quat(to_xyzw(np.asarray(values)))


def from_rpy(rpy: Array) -> Array:
    """The quaternion of roll φ about x, then pitch θ about y, then yaw ψ about z, world axes: R = Rz(ψ) Ry(θ) Rx(φ).

    Args:
        rpy: (φ, θ, ψ), shape (..., 3) [rad].
    """
    return _apply(_from_rpy, rpy)


def to_rpy(q: Array) -> Array:
    """Roll, pitch and yaw, shape (..., 3) [rad], of q / |q|; pitch in [-π/2, π/2].

    At pitch ±π/2 only one combination of roll and yaw is defined: roll is set to 0, and the gradient of roll and yaw
    means nothing.
    """
    return _apply(_to_rpy, q)


def rpy_rates_to_angular_velocity(rpy: Array) -> Array:
    """The matrix T with ω = T (φ', θ', ψ')ᵀ, ω in the world frame, shape (..., 3, 3)  [Appendix A, Eq. 20].

    Eq. 19 as printed lacks a factor: the y component of ω is cosθ sinψ φ' + cosψ θ'.
    """
    return _apply(_rpy_rates_matrix, rpy)


def rpy_jacobian(rpy: Array, p: Array) -> Array:
    """∂x/∂(φ, θ, ψ) of the point x = R(φ, θ, ψ) p, shape (..., 3, 3), one column per angle [m]  [Appendix C].

    The ∂x/∂φ printed there lacks brackets: its first row is p_y (sinφ sinψ + cosφ sinθ cosψ) +
    p_z (cosφ sinψ - sinφ sinθ cosψ).

    Args:
        rpy: shape (..., 3) [rad].
        p: body frame, shape (..., 3) [m].
    """
    return _apply(_rpy_jacobian, rpy, p)


def rpy_mass_matrix(rpy: Array, mass: Array, inertia: Array) -> Array:
    """The mass matrix of a body in the coordinates (φ, θ, ψ, x, y, z), shape (..., 6, 6)  [Appendix A, Eq. 22].

    diag(Tᵀ R I_b Rᵀ T, m 1): its kinetic energy is ½ q'ᵀ M q'. The lower block is printed as 1, without the mass.

    Args:
        rpy: shape (..., 3) [rad].
        mass: shape (...) [kg].
        inertia: I_b, body frame, about the centre of mass, shape (..., 3, 3) [kg·m²].
    """
    return _apply(_rpy_mass_matrix, rpy, mass, inertia)


def _apply(function: Callable[..., Tensor], first: Array, *others: Any) -> Array:
    """Call a function of tensors with whatever arrays are given, and answer in kind."""
    arrays = (first, *others)
    like = next((a for a in arrays if isinstance(a, Tensor)), None)
    if like is None:
        result: Any = function(*(torch.from_numpy(np.array(a, dtype=np.float64)) for a in arrays)).numpy()
        return cast("Array", result)
    result = function(
        *(a if isinstance(a, Tensor) else torch.as_tensor(a, dtype=like.dtype, device=like.device) for a in arrays)
    )
    return cast("Array", result)


def _multiply(a: Tensor, b: Tensor) -> Tensor:
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def _matrix(*rows: list[Tensor]) -> Tensor:
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def _to_matrix(q: Tensor) -> Tensor:
    w, x, y, z = q.unbind(-1)
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return _matrix(
        [1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)],
    )


def _from_matrix(matrix: Tensor) -> Tensor:
    # R determines 4 q qᵀ. Row i of that is 4 q_i q; take the row with the largest q_i, at least 1/2, and normalise it.
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrix.unbind(-2))
    outer = _matrix(
        [1.0 + a + e + i, h - f, c - g, d - b],
        [h - f, 1.0 + a - e - i, b + d, c + g],
        [c - g, b + d, 1.0 - a + e - i, f + h],
        [d - b, c + g, f + h, 1.0 - a - e + i],
    )
    largest = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    index = largest[..., None, None].expand(*largest.shape, 1, 4)
    q = outer.gather(-2, index).squeeze(-2)
    q = q / torch.linalg.vector_norm(q, dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0.0, -q, q)


def _exp(rotation_vector: Tensor) -> Tensor:
    # (cos θ/2, sin(θ/2)/θ v). Both are smooth in θ², so the root is taken only where it is differentiable.
    angle_sq = (rotation_vector * rotation_vector).sum(-1, keepdim=True)
    small = angle_sq < _SERIES_ANGLE_SQ
    angle = torch.where(small, torch.ones_like(angle_sq), angle_sq).sqrt()
    s = angle_sq
    cos_half = torch.where(small, 1 - s / 8 * (1 - s / 48 * (1 - s / 120)), (0.5 * angle).cos())
    scale = torch.where(small, 0.5 - s / 48 * (1 - s / 80 * (1 - s / 168)), (0.5 * angle).sin() / angle)
    return torch.cat([cos_half, scale * rotation_vector], -1)


def _log(q: Tensor) -> Tensor:
    q = torch.where(q[..., :1] < 0.0, -q, q)
    w, v = q[..., :1], q[..., 1:]
    length_sq = (v * v).sum(-1, keepdim=True)
    ratio_sq = length_sq / torch.where(w > 0.0, w * w, torch.ones_like(w))
    small = (ratio_sq < _SERIES_ANGLE_SQ) & (w > 0.0)
    length = torch.where(small, torch.ones_like(w), length_sq).sqrt()
    safe_w = torch.where(small, w, torch.ones_like(w))
    r = torch.where(small, ratio_sq, torch.zeros_like(w))
    # 2 atan(u)/u = 2 (1 - u²/3 + u⁴/5 - u⁶/7), u = |v|/w
    series = 2.0 / safe_w * (1 - r * (1 / 3 - r * (1 / 5 - r / 7)))
    return torch.where(small, series, 2.0 * torch.atan2(length, w) / length) * v


def _from_rpy(rpy: Tensor) -> Tensor:
    (cr, cp, cy), (sr, sp, sy) = (0.5 * rpy).cos().unbind(-1), (0.5 * rpy).sin().unbind(-1)
    return torch.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        -1,
    )


def _to_rpy(q: Tensor) -> Tensor:
    (a, b, _), (d, e, _), (g, h, i) = (row.unbind(-1) for row in _to_matrix(q).unbind(-2))
    cos_pitch_sq = a * a + d * d
    pole = cos_pitch_sq < _POLE**2
    one, zero = torch.ones_like(a), torch.zeros_like(a)

    def atan2(y: Tensor, x: Tensor) -> Tensor:  # away from the pole; there, a harmless angle without gradient
        return torch.atan2(torch.where(pole, zero, y), torch.where(pole, one, x))

    roll = atan2(h, i)
    pitch = torch.atan2(-g, torch.where(pole, one, cos_pitch_sq).sqrt() * torch.where(pole, zero, one))
    yaw = torch.where(pole, torch.atan2(torch.where(pole, -b, zero), torch.where(pole, e, one)), atan2(d, a))
    return torch.stack([roll, pitch, yaw], -1)


def _rpy_rates_matrix(rpy: Tensor) -> Tensor:
    _, cos_pitch, cos_yaw = rpy.cos().unbind(-1)
    _, sin_pitch, sin_yaw = rpy.sin().unbind(-1)
    zero, one = torch.zeros_like(cos_yaw), torch.ones_like(cos_yaw)
    return _matrix(
        [cos_pitch * cos_yaw, -sin_yaw, zero],
        [cos_pitch * sin_yaw, cos_yaw, zero],
        [-sin_pitch, zero, one],
    )


def _rpy_jacobian(rpy: Tensor, p: Tensor) -> Tensor:
    # Turning at the rate ω moves x at ω × x; column k of T is the ω of the k-th angle.
    x = _times(_to_matrix(_from_rpy(rpy)), p)
    columns: Tensor = torch.linalg.cross(_rpy_rates_matrix(rpy), x.unsqueeze(-1), dim=-2)
    return columns


def _rpy_mass_matrix(rpy: Tensor, mass: Tensor, inertia: Tensor) -> Tensor:
    body_rates = _to_matrix(_from_rpy(rpy)).mT @ _rpy_rates_matrix(rpy)
    upper = body_rates.mT @ inertia @ body_rates
    lower = mass[..., None, None] * torch.eye(3, dtype=rpy.dtype, device=rpy.device)
    zero = torch.zeros_like(upper) * torch.zeros_like(lower)  # has the leading axes of both
    return torch.cat([torch.cat([upper + zero, zero], -1), torch.cat([zero, lower + zero], -1)], -2)
