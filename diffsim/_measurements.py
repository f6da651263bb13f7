"""What can be measured in a state: the methods of `Simulator` that do not advance it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, SupportsIndex

import numpy as np
import torch
from torch import Tensor, nn

from . import _core, _energies
from ._check import check_instance, check_state
from .scene import PackedScene
from .state import State

if TYPE_CHECKING:
    import trimesh


class Measurements(nn.Module):
    """Mixed into `Simulator`. All methods take states with any leading axes (batch, time), return those axes, and keep
    the dtype of the state; they are float64 inside.
    """

    mass: nn.Parameter
    inertia: nn.Parameter
    gravity: nn.Parameter
    _packed: PackedScene
    _model: _core.Model
    _options: _core.Options
    _body_count: int
    _node_count: int

    def kinetic_energy(self, state: State) -> Tensor:
        """½ m v² + ½ ω·I ω over the dynamic bodies [J], shape (...); differentiable (state, `mass`, `inertia`)."""
        self._check_state("kinetic_energy", state)
        return _energies.kinetic_energy(state, self.mass, self.inertia)

    def potential_energy(self, state: State) -> Tensor:
        """Σ -m g·x over the dynamic bodies [J], shape (...), without what contacts store by their compliance;
        differentiable (state, `mass`, `gravity`).
        """
        self._check_state("potential_energy", state)
        return _energies.potential_energy(state, self.mass, self.gravity)

    def momentum(self, state: State) -> Tensor:
        """Σ m v over the dynamic bodies, world frame [kg·m/s], shape (..., 3); differentiable (state, `mass`)."""
        self._check_state("momentum", state)
        return _energies.momentum(state, self.mass)

    def angular_momentum(self, state: State) -> Tensor:
        """Σ x × m v + I ω over the dynamic bodies, about the world's origin [kg·m²/s], shape (..., 3);
        differentiable (state, `mass`, `inertia`).
        """
        self._check_state("angular_momentum", state)
        return _energies.angular_momentum(state, self.mass, self.inertia)

    def min_distance(self, state: State) -> float | Tensor:
        """Smallest distance between two collision surfaces (meshes offset by their margins) that can meet [m].

        Returns: A float; for a state with leading axes a tensor of their shape. Infinite if nothing can meet. Not
            differentiable.
        """
        self._check_state("min_distance", state)
        found = self._for_each_scene(lambda p, q: (_core.min_distance(self._model, p, q)[0],), state)[0]
        return torch.from_numpy(found).to(state.dtype) if found.ndim else float(found)

    def mesh_transform(self, state: State) -> Tensor:
        """Where the frames of the meshes are, as they were given to `add_body`: homogeneous matrices, mesh to world,
        shape (..., n_bodies, 4, 4); differentiable (state).
        """
        self._check_state("mesh_transform", state)
        return _energies.mesh_transform(state, torch.from_numpy(self._packed.mesh_offset))

    def vertices(self, state: State) -> Tensor:
        """World positions of all vertices, body after body [m], shape (..., n_vertices, 3); differentiable (state).

        A sphere is one vertex, its centre; a capsule two, the ends of its axis.
        """
        self._check_state("vertices", state)
        body_of_vertex = torch.from_numpy(np.repeat(np.arange(self._body_count), self._packed.vertex_count))
        return _energies.world_vertices(state, torch.from_numpy(self._packed.vertices), body_of_vertex)

    def mesh(self, state: State, handle: SupportsIndex) -> trimesh.Trimesh:
        """The surface of one body in the world, without its margin; spheres and capsules with facets.

        Args:
            state: Without leading axes.
            handle: As returned by `add_body`, or the index of a body.
        """
        import trimesh

        self._check_state("mesh", state)
        body = range(self._body_count)[handle]
        if state.leading_shape:
            raise ValueError(f"mesh: state must be one state, got leading axes {tuple(state.leading_shape)}; index it")
        p = self._packed
        first_vertex, first_face = int(p.vertex_count[:body].sum()), int(p.face_count[:body].sum())
        vertices = p.vertices[first_vertex : first_vertex + int(p.vertex_count[body])]
        faces = p.faces[first_face : first_face + int(p.face_count[body])]
        if len(faces):
            mesh = trimesh.Trimesh(vertices, faces, process=False)
        elif len(vertices) == 1:
            mesh = trimesh.creation.icosphere(subdivisions=3, radius=float(p.margin[body]))
            mesh.apply_translation(vertices[0])
        else:
            mesh = trimesh.creation.capsule(height=float(np.ptp(vertices[:, 2])), radius=float(p.margin[body]))
            mesh.apply_translation(vertices.mean(axis=0) - mesh.bounds.mean(axis=0))
        transform = _energies.pose_matrix(state.detach())[body]
        mesh.apply_transform(transform.numpy(force=True))
        return mesh

    def separate(self, state: State) -> State:
        """The state with dynamic bodies moved apart that are nearer to something than they may come to rest.

        For states made by hand. Velocities stay. To autograd the shift is a constant, as if nothing moved.

        Raises: ValueError for a state of the wrong shape, or one whose bodies are too deep in each other.
        """
        self._check_state("separate", state)
        p = self._packed

        def separated(position: np.ndarray, orientation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            moved = _core.separate(self._model, self._options, position, orientation, p.mass, p.inertia)
            return moved[0] - position, moved[1] - orientation

        shift, turn = self._for_each_scene(separated, state)
        return state.replace(
            position=state.position + torch.from_numpy(shift).to(state.dtype),
            orientation=state.orientation + torch.from_numpy(turn).to(state.dtype),
        )

    def _check_state(self, where: str, state: Any) -> None:
        """As `check_state`, with any number of leading axes."""
        check_instance(where, "state", state, State, "be a diffsim.State")
        if isinstance(state.position, Tensor) and state.position.ndim > 3:
            flat = {
                k: v.flatten(0, v.ndim - 3) for k, v in state.__dict__.items() if isinstance(v, Tensor) and v.ndim > 3
            }
            state = state.replace(**flat)
        check_state(where, state, self._body_count, self._node_count)

    def _for_each_scene(self, function: Callable[..., Any], state: State) -> tuple[np.ndarray, ...]:
        """Stacks the results of function(position, orientation), run for every entry of the leading axes."""
        pose = [t.numpy(force=True).astype(np.float64) for t in (state.position, state.orientation)]
        leading = np.broadcast_shapes(*(a.shape[:-2] for a in pose))
        position, orientation = (np.broadcast_to(a, leading + a.shape[-2:]).reshape(-1, *a.shape[-2:]) for a in pose)
        results = [function(np.ascontiguousarray(p), np.ascontiguousarray(q)) for p, q in zip(position, orientation)]
        return tuple(np.stack(column).reshape(leading + np.shape(column[0])) for column in zip(*results))
