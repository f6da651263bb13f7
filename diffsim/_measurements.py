"""What can be measured in a state: the methods of `Simulator` that do not advance it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, SupportsIndex

import numpy as np
import torch
from torch import Tensor, nn

from . import _core, _energies
from ._check import check_instance, check_placing, check_state, message
from ._cloth_energy import ClothElements, elastic_energy, node_mass
from ._handles import BodyHandle, ClothHandle
from ._input_table import PARAMETERS
from ._packed import PackedScene
from .state import State

if TYPE_CHECKING:
    import trimesh


class Measurements(nn.Module):
    """Mixed into `Simulator`. All methods take states with any leading axes (batch, time), return those axes, and keep
    the dtype of the state; they are float64 inside. They raise TypeError or ValueError, as a step does, for a state
    that is not one of this scene.
    """

    # The parameters of the module, `_input_table.MODULE_PARAMETERS`, for whoever checks types.
    mass: nn.Parameter
    inertia: nn.Parameter
    gravity: nn.Parameter
    friction: nn.Parameter
    restitution: nn.Parameter
    cloth_density: nn.Parameter
    cloth_stretch: nn.Parameter
    cloth_shear: nn.Parameter
    cloth_bend: nn.Parameter
    cloth_damping: nn.Parameter
    _packed: PackedScene
    _model: _core.Model
    _options: _core.Options
    _body_count: int
    _node_count: int
    _elements: ClothElements | None  #: None without cloth

    def kinetic_energy(self, state: State) -> Tensor:
        """½ m v² + ½ ω·I ω over the dynamic bodies and the cloth nodes that are not pinned [J], shape (...).

        Args:
            state: With any leading axes (...).
        Raises: TypeError, ValueError for a state that is not one of this scene.
        Gradients: with respect to the state, `mass`, `inertia` and `cloth_density`.
        """
        self._check_state("kinetic_energy", state)
        return _energies.kinetic_energy(state, self.mass, self.inertia, self._node_mass())

    def potential_energy(self, state: State) -> Tensor:
        """Σ -m g·x over the dynamic bodies and the cloth nodes that are not pinned, and what stretching, shearing and
        bending cloth stored [J], shape (...); without what contacts store by their compliance.

        Args:
            state: With any leading axes (...).
        Raises: TypeError, ValueError for a state that is not one of this scene.
        Gradients: with respect to the state, `mass`, `gravity`, `cloth_density`, `cloth_stretch`, `cloth_shear` and
            `cloth_bend`.
        """
        self._check_state("potential_energy", state)
        energy = _energies.gravitational_energy(state, self.mass, self.gravity, self._node_mass())
        if self._elements is not None:
            stiffness = (t.to(torch.float64) for t in (self.cloth_stretch, self.cloth_shear, self.cloth_bend))
            energy = energy + elastic_energy(state.node_position.to(torch.float64), self._elements, *stiffness)
        return energy.to(state.dtype)

    def momentum(self, state: State) -> Tensor:
        """Σ m v over the dynamic bodies and the cloth nodes that are not pinned, world frame [kg·m/s], shape (..., 3).

        Args:
            state: With any leading axes (...).
        Raises: TypeError, ValueError for a state that is not one of this scene.
        Gradients: with respect to the state, `mass` and `cloth_density`.
        """
        self._check_state("momentum", state)
        return _energies.momentum(state, self.mass, self._node_mass())

    def angular_momentum(self, state: State) -> Tensor:
        """Σ x × m v + I ω over the dynamic bodies and the cloth nodes that are not pinned, about the world's origin,
        world frame [kg·m²/s], shape (..., 3).

        Args:
            state: With any leading axes (...).
        Raises: TypeError, ValueError for a state that is not one of this scene.
        Gradients: with respect to the state, `mass`, `inertia` and `cloth_density`.
        """
        self._check_state("angular_momentum", state)
        return _energies.angular_momentum(state, self.mass, self.inertia, self._node_mass())

    def min_distance(self, state: State) -> float | Tensor:
        """Smallest distance between two collision surfaces (meshes offset by their margins) that can meet [m]: of two
        bodies, of a body or a cloth and the ground, of a cloth and another object or itself.

        Of two objects at least one is a dynamic body or a cloth. Within a cloth, features that share a node do not
        count, and of two that are nearer at rest than the cloth is thick, half their distance at rest takes the place
        of the margins, as in contact: a sheet that lies flat reports about the size of its triangles.

        Args:
            state: With any leading axes (...).
        Returns: A float; for a state with leading axes a tensor of their shape. Infinite if nothing can meet.
        Raises: TypeError, ValueError for a state that is not one of this scene; NotImplementedError inside a transform
            of torch.func.
        Gradients: none.
        """
        self._check_state("min_distance", state)
        self._refuse_transforms("min_distance")
        if not state.position.numel() and not state.node_position.numel():  # nothing there, or no scene
            nothing = torch.full(state.leading_shape, torch.inf, dtype=state.dtype, device="cpu")
            return nothing if nothing.ndim else torch.inf
        found = self._for_each_scene(lambda *x: (_core.min_distance(self._model, *x)[0],), state)[0]
        return torch.from_numpy(found).to(state.dtype) if found.ndim else float(found)

    def mesh_transform(self, state: State) -> Tensor:
        """Where the frames of the meshes are, as they were given to `add_body`: homogeneous matrices, mesh to world,
        shape (..., n_bodies, 4, 4), their last columns in m.

        Args:
            state: With any leading axes (...).
        Raises: TypeError, ValueError for a state that is not one of this scene.
        Gradients: with respect to the state.
        """
        self._check_state("mesh_transform", state)
        return _energies.mesh_transform(state, torch.from_numpy(self._packed.mesh_offset))

    def vertices(self, state: State) -> Tensor:
        """World positions of all vertices, body after body, then cloth after cloth [m], shape (..., n_vertices, 3).

        A sphere is one vertex, its centre; a capsule two, the ends of its axis. Those of cloths are their nodes.

        Args:
            state: With any leading axes (...).
        Raises: TypeError, ValueError for a state that is not one of this scene.
        Gradients: with respect to the state.
        """
        self._check_state("vertices", state)
        body_of_vertex = torch.from_numpy(np.repeat(np.arange(self._body_count), self._packed.vertex_count))
        of_bodies = _energies.world_vertices(state, torch.from_numpy(self._packed.vertices), body_of_vertex)
        if self._node_count == 0:
            return of_bodies
        nodes = state.node_position
        leading = torch.broadcast_shapes(of_bodies.shape[:-2], nodes.shape[:-2])
        return torch.cat([t.expand(*leading, *t.shape[-2:]) for t in (of_bodies, nodes)], dim=-2)

    def mesh(self, state: State, handle: SupportsIndex | ClothHandle) -> trimesh.Trimesh:
        """The surface of one object in the world, without its margin; spheres and capsules with facets.

        Args:
            state: Without leading axes.
            handle: As returned by `add_body` or `add_cloth`, or the index of an object, bodies first.
        Returns: Vertices in world axes [m], faces as they were given to the scene.
        Raises: ValueError for a state with leading axes or a handle of another scene, IndexError for an object there is
            not.
        Gradients: none.
        """
        import trimesh

        self._check_state("mesh", state)
        p = self._packed
        body = self._object("mesh", handle)
        if state.leading_shape:
            raise ValueError(f"mesh: state must be one state, got leading axes {tuple(state.leading_shape)}; index it")
        if body >= self._body_count:
            cloth = body - self._body_count
            node, triangle = int(p.node_count[:cloth].sum()), int(p.triangle_count[:cloth].sum())
            nodes = state.node_position[node : node + int(p.node_count[cloth])].numpy(force=True)
            triangles = p.triangles[triangle : triangle + int(p.triangle_count[cloth])]
            return trimesh.Trimesh(nodes, triangles, process=False)
        first_vertex, first_face = int(p.vertex_count[:body].sum()), int(p.face_count[:body].sum())
        vertices = p.vertices[first_vertex : first_vertex + int(p.vertex_count[body])]
        faces = p.faces[first_face : first_face + int(p.face_count[body])]
        if len(faces):
            mesh = trimesh.Trimesh(vertices, faces, process=False)
        elif len(vertices) == 1:
            mesh = trimesh.creation.icosphere(subdivisions=3, radius=float(p.margin[body]))
            mesh.apply_translation(vertices[0])
        else:
            axis = vertices[1] - vertices[0]
            align: Any = trimesh.geometry.align_vectors
            mesh = trimesh.creation.capsule(height=float(np.linalg.norm(axis)), radius=float(p.margin[body]))
            mesh.apply_translation(-mesh.bounds.mean(axis=0))
            mesh.apply_transform(align([0.0, 0.0, 1.0], axis))
            mesh.apply_translation(vertices.mean(axis=0))
        transform = _energies.pose_matrix(state.detach())[body]
        mesh.apply_transform(transform.numpy(force=True))
        return mesh

    def separate(self, state: State) -> State:
        """The state with dynamic bodies and cloth moved apart that are nearer to something than they may come to rest.

        For states made by hand. Velocities stay.

        Args:
            state: With any leading axes.
        Returns: The same state, position, orientation and node_position changed where something was too near.
        Raises: TypeError, ValueError for a state that is not one of this scene; ValueError for one whose meshes cross,
            or in which there is no room for the thickness, naming the pair; NotImplementedError inside a transform of
            torch.func.
        Gradients: of the state itself: the shift is a constant, as if nothing moved.
        """
        self._check_state("separate", state)
        self._refuse_transforms("separate")
        if not state.position.numel() and not state.node_position.numel():  # nothing there, or no scene
            return state

        def changes(*placed: np.ndarray) -> tuple[np.ndarray, ...]:
            return tuple(after - before for after, before in zip(self._separated_from(*placed), placed, strict=True))

        shift, turn, node_shift = (torch.from_numpy(t).to(state.dtype) for t in self._for_each_scene(changes, state))
        moved = state.replace(position=state.position + shift, orientation=state.orientation + turn)
        return moved.replace(node_position=state.node_position + node_shift) if self._node_count else moved

    def place(
        self,
        state: State,
        handle: SupportsIndex,
        *,
        position: Tensor | Sequence[float] | None = None,
        orientation: Tensor | Sequence[float] | None = None,
    ) -> State:
        """The state with one body at another place, told as `Scene.add_body` is: by the frame of its mesh.

        The inverse of `mesh_transform`: `state.position` is the centre of mass, which turns about the mesh's origin.
        Velocities stay, and so do all other objects; `separate` moves what comes too near.

        Args:
            state: With any leading axes (...).
            handle: As returned by `add_body`, or the index of a body.
            position: Of the origin of the mesh, world [m], shape (..., 3). Default: where it is.
            orientation: Quaternion w, x, y, z, mesh to world, shape (..., 4), of any length but zero; it is normalised.
                Default: as it is.
        Returns: The state in its dtype, with the leading axes of state, position and orientation, broadcast.
        Raises: TypeError, ValueError for a state that is not one of this scene, a handle of another scene or of a
            cloth, shapes that do not fit, a quaternion that is zero or not finite (inside torch.func's transforms and
            torch.compile the next step finds it); IndexError for a body there is not.
        Gradients: with respect to the state, the position and the orientation.
        """
        where = "place"
        self._check_state(where, state)
        body = self._object(where, handle)
        if body >= self._body_count:
            nodes = "state.replace(node_position=...)"
            raise ValueError(f"{where}: handle must be of a body, got {handle!r}; move the nodes of a cloth by {nodes}")
        new = {"position": position, "orientation": orientation}
        given = {k: check_placing(where, k, v, 4 if k == "orientation" else 3, state) for k, v in new.items()}
        leading = [t.shape[:-1] for t in given.values() if t is not None]
        try:
            axes = torch.broadcast_shapes(*leading, *(t.shape[:-2] for t in state.__dict__.values()))
        except RuntimeError:
            shapes = ", ".join(f"{k} {tuple(t.shape)}" for k, t in given.items() if t is not None)
            got = f"{shapes} and a state of leading axes {tuple(state.leading_shape)}"
            raise ValueError(message(where, "leading axes", "broadcast with those of the state", got)) from None
        center = torch.from_numpy(self._packed.mesh_offset[body])
        return _energies.placed(state, body, center, axes, given["position"], given["orientation"])

    def _separated_from(
        self, position: np.ndarray, orientation: np.ndarray, node_position: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        p = self._packed
        return _core.separate(
            self._model,
            self._options,
            position,
            orientation,
            node_position,
            [getattr(p, name) for name in PARAMETERS],
        )[:3]

    def _node_mass(self) -> Tensor | None:
        return None if self._elements is None else node_mass(self._elements, self.cloth_density.to(torch.float64))

    def _object(self, where: str, handle: SupportsIndex | ClothHandle) -> int:
        """The index of an object, bodies first; a handle must be of an object of that name here."""
        names = [*self._packed.names, *self._packed.cloth_names]
        if not isinstance(handle, (BodyHandle, ClothHandle)):
            return range(len(names))[handle]
        index = int(handle) if isinstance(handle, BodyHandle) else self._body_count + handle.cloth
        if names[index : index + 1] != [handle.name]:
            here = f"object {index} is {names[index]!r}" if index < len(names) else f"there are {len(names)} objects"
            raise ValueError(f"{where}: {handle!r} is of another scene, or was added later: {here} here")
        return index

    def _check_state(self, where: str, state: Any) -> None:
        """As `check_state`, with any number of leading axes."""
        check_instance(where, "state", state, State, "be a diffsim.State")
        if isinstance(state.position, Tensor) and state.position.ndim > 3:
            flat = {
                k: v.flatten(0, v.ndim - 3) for k, v in state.__dict__.items() if isinstance(v, Tensor) and v.ndim > 3
            }
            state = state.replace(**flat)
        check_state(where, state, self._body_count, self._node_count)

    @staticmethod
    def _refuse_transforms(where: str) -> None:
        if torch._C._are_functorch_transforms_active():
            raise NotImplementedError(
                f"{where}: cannot run inside a transform of torch.func (vmap, grad, ...); call it outside, where states"
                " may have any leading axes"
            )

    def _for_each_scene(self, function: Callable[..., Any], state: State) -> tuple[np.ndarray, ...]:
        """Stacks the results of function(position, orientation, node_position), run for every entry of the leading
        axes.
        """
        placed = (state.position, state.orientation, state.node_position)
        arrays = [t.numpy(force=True).astype(np.float64) for t in placed]
        leading = np.broadcast_shapes(*(a.shape[:-2] for a in arrays))
        scenes = int(np.prod(leading))
        columns = [np.broadcast_to(a, leading + a.shape[-2:]).reshape(scenes, *a.shape[-2:]) for a in arrays]
        results = [function(*(np.ascontiguousarray(a) for a in scene)) for scene in zip(*columns)]
        return tuple(np.stack(column).reshape(leading + np.shape(column[0])) for column in zip(*results))
