"""The simulator: a scene as a torch.nn.Module that advances its state by time steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from . import _core
from ._check import check_choice, check_count, check_instance, check_number
from ._cloth_energy import cloth_elements
from ._description import description
from ._identity import SceneIdentity
from ._input_table import CONTROLS, MODULE_PARAMETERS, PARAMETERS, STATE_COUNT, STATE_FIELDS
from ._inputs import (
    CheckedInputs,
    Controls,
    PlainInputs,
    check_unused,
    checked_inputs,
    checked_parameters,
    checked_steps,
    state_from,
)
from ._measurements import Measurements
from ._outcome import Info, SolverError, combined, failure_text, warn_of_failure, warn_of_fast_impacts
from ._owners import enlist
from ._packed import PackedScene, core_model
from ._progress import progress_bar
from .contacts import Contacts, contacts_from
from .ops import RolloutCall, rollout
from .scene import Scene
from .state import Control, State

__all__ = ["Simulator"]

_ITERATIONS = 200  # a step of bodies that takes more will not converge
_CLOTH_ITERATIONS = 2000  # stiff cloth at large time steps crumples slowly

_PROGRESS_UPDATES = 100  # of a rollout that is not cut into segments for checkpointing


class Simulator(SceneIdentity, Measurements):
    """Advances a scene by time steps of `dt`; differentiable, deterministic, without memory from one call to the next.

    Each step minimizes the distance to the free motion, in the metric of the masses, subject to surfaces keeping their
    distance (Eqs. 2 and 6 of Qiao et al., ICML 2020, as one problem).

    Physical parameters are parameters of the module, float64, with ``requires_grad=False`` until asked for, and can be
    exchanged for a call by its ``parameters=`` or by `torch.func.functional_call`: `mass` (n_bodies,) [kg], `inertia`
    (n_bodies, 3, 3) in body axes [kg·m²], `gravity` (3,) [m/s²], `friction` and `restitution` (n_objects,), and per
    cloth `cloth_density`, `cloth_stretch`, `cloth_shear`, `cloth_bend`, `cloth_damping` (n_cloths,), in the units of
    `ClothMaterial`. Mass and inertia of static and kinematic bodies are zero and are not read.

    Args:
        scene: Read now; later changes to it have no effect.
        dt: Time step [s].
        thickness: Distance kept between surfaces of default margin [m]. Default: 1e-3 of the smallest extent of each
            object, and the mean of both between two (`Scene.pack` tells the rest).
        compliance: How far contacts give way: about this part of what gravity moves a body in one step. 0: not at all,
            at the price of a few more Newton steps (the quadratic program of Eq. 6 as written).
        adjoint: How gradients are computed: "exact" (with the contacts' curvature), "qr" or "dense" (the paper's).
        integrator: "implicit_euler", of first order, or "second_order", of second order between impacts: a projectile
            is exact, free spin keeps its energy, and cloth moves by an L-stable scheme of two stages. What is in
            contact, and cloth, have more solves a step (docs/conventions.md). Not with ``coupling="split"``.
        coupling: "monolithic" or "split": whether cloth and what touches it are solved at once, or the cloth's elastic
            step first and its contacts after it, as the paper does. Without cloth the two are the same.
        zones: "local": bodies and cloths are solved together only if they may meet, the default. "global": all at once,
            the same result for more work; there to measure what locality saves.
        newton_iterations: Newton iterates that make up the elastic step of ``coupling="split"``, full steps from no
            motion, with the exact Hessian, or its projection where that is not positive definite. 1 is the paper's
            Eq. 3. Meant to show what that leaves out: there are no gradients, and `info.converged` does not speak of
            these iterates. Default: as many as it takes to converge.
        tolerance: Relative KKT residual at which a step has converged.
        max_iterations: Newton iterations a step may take; with friction those of the first search, after which
            others begin (docs/friction.md). Default: 200, in scenes with cloth 2000.
        num_threads: How many threads a call may use; no result depends on it. They divide the scenes of a batch, or,
            where there are fewer scenes than threads, the bodies and zones of one big scene: up to some 60 bodies in
            contact one thread is faster alone. Default: `torch.get_num_threads()`.
        on_failure: What follows a step that did not converge: "warn" (once, `ConvergenceWarning`) or "raise"
            (`SolverError`).
        check: Whether to look for overlaps in the scene, and for parameter values this version does not know. Types and
            shapes are always checked.
    Raises: TypeError, ValueError for what the message names: overlapping objects, or objects that have no room to keep
        `thickness` apart, among it.
    """

    def __init__(
        self,
        scene: Scene,
        dt: float,
        *,
        thickness: float | None = None,
        compliance: float = 1e-4,
        adjoint: str = "exact",
        integrator: str = "implicit_euler",
        coupling: str = "monolithic",
        zones: str = "local",
        newton_iterations: int | None = None,
        tolerance: float = 1e-10,
        max_iterations: int | None = None,
        num_threads: int | None = None,
        on_failure: str = "warn",
        check: bool = True,
    ) -> None:
        super().__init__()
        where = "Simulator"
        check_instance(where, "scene", scene, Scene, "be a diffsim.Scene")
        check_choice(where, "adjoint", adjoint, ("exact", "qr", "dense"))
        check_choice(where, "integrator", integrator, ("implicit_euler", "second_order"))
        check_choice(where, "coupling", coupling, ("monolithic", "split"))
        if integrator == "second_order" and coupling == "split":
            raise ValueError(f"{where}: integrator='second_order' must be used with coupling='monolithic', got 'split'")
        check_choice(where, "zones", zones, ("local", "global"))
        check_choice(where, "on_failure", on_failure, ("warn", "raise"))
        compliance = check_number(where, "compliance", compliance, least=0.0)
        settings: dict[str, Any] = {
            "dt": check_number(where, "dt", dt, above=0.0),
            "compliance": compliance,
            "adjoint": adjoint,
            "tolerance": check_number(where, "tolerance", tolerance, above=0.0),
            "integrator": integrator,
            "coupling": coupling,
            "zones": zones,
            "newton_iterations": _checked_iterations(newton_iterations, coupling),
        }
        threads = None if num_threads is None else check_count(where, "num_threads", num_threads)
        packed = scene.pack(None if thickness is None else check_number(where, "thickness", thickness, above=0.0))
        if check:
            scene.validate(packed)
        if max_iterations is None:
            max_iterations = _CLOTH_ITERATIONS if packed.cloth_names else _ITERATIONS
        settings["max_iterations"] = check_count(where, "max_iterations", max_iterations)
        self._begin(packed, settings, threads, on_failure, bool(check))
        if self._check:
            self._separate_scene()

    @classmethod
    def _of_packed(
        cls, packed: PackedScene, settings: dict[str, Any], num_threads: int | None, on_failure: str, check: bool
    ) -> Simulator:
        """One whose scene and settings have been checked before."""
        sim = cls.__new__(cls)
        nn.Module.__init__(sim)
        sim._begin(packed, settings, num_threads, on_failure, check)
        return sim

    def _begin(
        self, packed: PackedScene, settings: dict[str, Any], num_threads: int | None, on_failure: str, check: bool
    ) -> None:
        self._packed = packed
        self._settings = settings
        self._dt: float = settings["dt"]
        self._num_threads = num_threads
        self._on_failure = on_failure
        self._check = check
        for name in MODULE_PARAMETERS:
            value = torch.from_numpy(np.array(getattr(self._packed, name), dtype=np.float64))
            self.register_parameter(name, nn.Parameter(value, requires_grad=False))
        self._info: Info | list[Any] | None = None  # a list of the core's, one per segment, until someone asks
        self._warned = False
        self._warned_fast = False
        self._build()

    def _build(self) -> None:
        """What is made from the packed scene and cannot be pickled."""
        p = self._packed
        self._model = core_model(p)
        self._options = _core.Options(**self._settings)
        self._elements = cloth_elements(p, self._model) if p.cloth_names else None
        n = self._body_count = len(p.names)
        self._node_count = len(p.node_rest)
        self._parameter_shapes = {name: torch.Size(getattr(p, name).shape) for name in MODULE_PARAMETERS}
        counts = {"bodies": n, "nodes": self._node_count, "objects": len(p.friction), "cloths": len(p.cloth_names)}
        self._plain_inputs = PlainInputs(counts)
        self._object_names = (*p.names, *p.cloth_names)
        self._cloth_of_node = torch.from_numpy(np.repeat(np.arange(len(p.node_count)), p.node_count))
        self._separated: tuple[np.ndarray, ...] | None = None
        self._number = enlist(self)

    def __getstate__(self) -> dict[str, Any]:
        state = {**self.__dict__, "_info": self.info}
        for name in ("_model", "_options", "_elements"):
            del state[name]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self._build()

    @property
    def dt(self) -> float:
        """Time step [s]."""
        return self._dt

    @property
    def thickness(self) -> float:
        """Distance kept between surfaces of default margin [m]; of the thickest object, if each has its own."""
        return float(self._packed.thickness)

    @property
    def body_names(self) -> tuple[str, ...]:
        """Names of the bodies, in the order of the body axis."""
        return tuple(self._packed.names)

    @property
    def cloth_names(self) -> tuple[str, ...]:
        """Names of the cloths, in the order of the cloth axis."""
        return tuple(self._packed.cloth_names)

    @property
    def info(self) -> Info | None:
        """Statistics of the last step; None before the first."""
        if isinstance(self._info, list):
            self._info = combined(self._info, self._object_names)
        return self._info

    def __repr__(self) -> str:
        return description(type(self).__name__, self._packed, self._settings)

    # ---- states ------------------------------------------------------------------------------------------------------

    def initial_state(self, batch: int | None = None) -> State:
        """The state the scene describes, with objects nearer than `thickness` moved apart by at most that.

        Args:
            batch: Number of copies, along a new leading axis. Default: one state without it.
        Returns: New tensors of the parameters' dtype (float64, or float32 after ``sim.float()``).
        Raises: ValueError where there is no room for the thickness.
        """
        p = self._packed
        position, orientation, node_position = self._separate_scene()
        arrays = position, orientation, p.velocity, p.angular_velocity, node_position, p.node_velocity
        tensors = [torch.from_numpy(a).to(self.mass.dtype) for a in arrays]
        if batch is not None:
            count = check_count("initial_state", "batch", batch)
            tensors = [t.expand(count, *t.shape) for t in tensors]
        return State(*(t.clone(memory_format=torch.contiguous_format) for t in tensors))

    def _separate_scene(self) -> tuple[np.ndarray, ...]:
        """Places of bodies and nodes of the scene, moved apart. Made once."""
        if self._separated is None:
            p = self._packed
            self._separated = self._separated_from(p.position, p.orientation, p.node_position)
        return self._separated

    # ---- stepping ----------------------------------------------------------------------------------------------------

    def forward(
        self, state: State, control: Control | None = None, *, parameters: Mapping[str, Tensor] | None = None
    ) -> State:
        """One time step; differentiable with respect to the state, the control, `mass`, `inertia`, `gravity` and the
        parameters of cloth.

        Args:
            state: Of one dtype, float32 or float64, with or without a batch axis (of size B) in front of any tensor.
            control: Each tensor float32 or float64, whatever the state is, with or without a batch axis. Default: no
                forces, kinematic bodies go on as they move, and pinned nodes stand still.
            parameters: Takes the place of parameters of the module in this call, by their names: ``{"mass": m}``, each
                float32 or float64, with or without a batch axis in front of its shape: one value per scene.
        Returns: The state one `dt` later, in the state's dtype; with a batch axis if any input has one.
        Raises:
            TypeError, ValueError: Wrong type, dtype, device or shape; values that are not finite; quaternions further
                than 1e-3 from length 1; objects that touch, cross or are in the ground; a parameter there is not. The
                message names object, field and value.
            SolverError: A step did not converge, if ``on_failure="raise"``.
        Gradients: of the step that was run, first order only. A quaternion's gradient is tangent to the unit sphere.
        """
        values = self._values("Simulator", parameters)
        single = False
        traced = torch.compiler.is_compiling()
        inputs = None if traced else self._plain_inputs.find(state, control, values)
        if inputs is None:
            inputs, _, single = self._checked_inputs("Simulator", state, control, None, values)
        if traced:
            from . import _compiled

            return state_from(_compiled.rollout(self._number, inputs, values, 1, single=single), state)
        if self._check:
            self._check_unread(values["restitution"])
        call = self._make_call(1, single=single)
        outputs = rollout(call, *inputs)
        result = state_from(outputs, state)
        self._finish([call.info], result)
        return result

    def rollout(
        self,
        state: State,
        controls: Controls = None,
        steps: int | None = None,
        checkpoint_every: int | None = None,
        progress: bool = False,
        *,
        parameters: Mapping[str, Tensor] | None = None,
    ) -> State:
        """Many time steps: the loop over them, forward and backward, runs in C++.

        Args:
            state: As for one step.
            controls: None; one Control, held constant; a sequence with one Control per step; or a Control with a
                leading time axis. A tensor of shape (n, 3) is constant; one of shape (steps, B, n, 3) has a time axis,
                and either of its leading axes may have size 1. With an unbatched state, (steps, n, 3) has a time axis.
                With a state of batch size B, (B, n, 3) is constant and (steps, n, 3) the same for all scenes. If B
                equals steps, axes of that size cannot be told apart, and the error says how to write what is meant; a
                sequence always works: ``list(controls)``, where the first axis is time.
            steps: Number of steps: ``sim.rollout(state, steps=100)``. Default: the length of a sequence of controls.
            checkpoint_every: Keep the record gradients need only for this many steps at a time, k, and compute it again
                in the backward: memory O(steps / k + k), about one more forward in time, the same values bit by bit.
            progress: Show a progress bar on stderr.
            parameters: As for one step, the same in all of them.
        Returns: State with a leading time axis: after the first step, ..., after the last. Its tensors have shapes
            (steps[, B], n, 3), with a batch axis if any input has one.
        Raises: As for one step.
        Gradients: As for one step. A float32 rollout is float64 throughout and rounded once, at the end.
        """
        return self._rollout(state, controls, steps, checkpoint_every, progress, parameters)[0]

    def _rollout(
        self,
        state: State,
        controls: Controls,
        steps: int | None,
        checkpoint_every: int | None = None,
        progress: bool = False,
        parameters: Mapping[str, Tensor] | None = None,
        want_signature: bool = False,
    ) -> tuple[State, np.ndarray | None]:
        where = "rollout"
        steps = checked_steps(where, steps, controls)
        every = steps if checkpoint_every is None else check_count(where, "checkpoint_every", checkpoint_every)
        length = every
        if progress and checkpoint_every is None:
            length = max(1, steps // _PROGRESS_UPDATES)
        values = self._values(where, parameters)
        inputs, has_time, single = self._checked_inputs(where, state, controls, steps, values)
        traced = torch.compiler.is_compiling()
        if self._check and not traced:
            self._check_unread(values["restitution"])
        now, driven, constant = inputs[:STATE_COUNT], inputs[CONTROLS.start : CONTROLS.stop], inputs[CONTROLS.stop :]
        segments, infos, signatures = [], [], []
        with progress_bar(steps, progress and not traced) as advance:
            for start in range(0, steps, length):
                count = min(length, steps - start)
                settings: dict[str, Any] = {
                    "controls_have_time": has_time,
                    "keep_time": True,
                    "keep_tape": checkpoint_every is None or steps <= every,
                    "first_step": start,
                    "single": single,
                }
                part = driven
                if has_time and count < steps:
                    part = tuple(None if t is None else t[start : start + count] for t in driven)
                given = (*now, *part, *constant)
                if traced:
                    from . import _compiled

                    segment = _compiled.rollout(self._number, given, values, count, **settings)
                else:
                    call = self._make_call(count, want_signature=want_signature, **settings)
                    segment = rollout(call, *given)
                    infos.append(call.info)
                    signatures.append(call.signature)
                if start + count < steps:
                    # A view would keep the segment alive to the backward.
                    now = tuple(None if t is None else t[-1].clone() for t in segment)
                segments.append(segment)
                advance(count)
        outputs = segments[0]
        if len(segments) > 1:
            outputs = tuple(None if column[0] is None else torch.cat(column) for column in zip(*segments))
        result = state_from(outputs, state)
        if not traced:
            self._finish(infos, result)
        return result, np.concatenate(signatures) if want_signature else None  # type: ignore[arg-type]

    def contacts(
        self, state: State, control: Control | None = None, *, parameters: Mapping[str, Tensor] | None = None
    ) -> Contacts:
        """The contacts of the step taken from a state, and their forces: differentiable, for losses on what is felt.

        Args: As for one step.
        Returns: What pushes at the end of the step, and with it, as `Contacts.end`, the state there. Over a batch the
            contacts of all scenes, scene by scene. An impact's force is large: its impulse divided by `dt`.
        Raises: As for one step; NotImplementedError inside a transform of torch.func.
        Gradients: As for one step, to forces, positions, normals and distances; none to forces with ``compliance=0``,
            whose backward raises NotImplementedError.
        """
        self._refuse_transforms("contacts")
        values = self._values("contacts", parameters)
        inputs, _, single = self._checked_inputs("contacts", state, control, None, values)
        if self._check:
            self._check_unread(values["restitution"])
        call = self._make_call(1, single=single, want_contacts=True)
        end = state_from(rollout(call, *inputs), state)
        self._finish([call.info], end)
        assert call.contacts is not None  # they were asked for
        hard = self._settings["compliance"] == 0.0
        names = (*self._object_names, "ground")
        return contacts_from(
            call.contacts, end, values["mass"], values["cloth_density"], self._cloth_of_node, names, hard
        )

    def _values(self, where: str, parameters: Mapping[str, Tensor] | None) -> Mapping[str, Any]:
        """The parameters of the module, and what takes their place in this call."""
        own: Mapping[str, Any] = self._parameters
        if len(own) < len(self._parameter_shapes):  # torch.nn.utils.parametrize has taken some out
            own = {name: getattr(self, name) for name in self._parameter_shapes}
        if parameters is None:
            return own
        return {**own, **checked_parameters(where, parameters, self._parameter_shapes)}

    def _checked_inputs(
        self, where: str, state: Any, controls: Any, steps: int | None, values: Mapping[str, Any] | None = None
    ) -> CheckedInputs:
        values = self._values(where, None) if values is None else values
        parameters = {name: (values[name], self._parameter_shapes[name]) for name in PARAMETERS}
        return checked_inputs(where, state, controls, parameters, steps, self._body_count, self._node_count)

    def _make_call(self, steps: int, **settings: Any) -> RolloutCall:
        threads = self._num_threads or torch.get_num_threads()
        return RolloutCall(self._model, self._options, steps, threads, **settings)

    def _check_unread(self, restitution: Tensor) -> None:
        check_unused("restitution", restitution, self._parameter_shapes["restitution"], self._object_names)

    def _finish(self, segments: list[Any], result: State) -> None:
        """Keeps the statistics of the call, and warns or raises if a step did not converge."""
        self.__dict__["_info"] = segments  # nn.Module's __setattr__ and Info itself take too long
        if not self._warned_fast and any(segment.fast_impacts for segment in segments):
            self._warned_fast = True
            warn_of_fast_impacts()
        if all(segment.converged for segment in segments):
            return
        info = self.info
        assert info is not None  # a call was made
        text = failure_text(info, self._settings["tolerance"])
        if self._on_failure == "raise":
            raise SolverError(text, info, result)
        if not self._warned:
            self._warned = True
            warn_of_failure(text)

    def _finish_traced(self, info: Any, first_step: int, outputs: tuple[Tensor | None, ...]) -> None:
        """The same where compiled code runs, which does so after each segment."""
        before = self._info if first_step and isinstance(self._info, list) else []
        self._finish([*before, info], State(**dict(zip(STATE_FIELDS, outputs))))  # type: ignore[arg-type]


def _checked_iterations(count: int | None, coupling: str) -> int | None:
    if count is None:
        return None
    count = check_count("Simulator", "newton_iterations", count)
    if coupling != "split":
        raise ValueError(
            f"Simulator: newton_iterations must be None with coupling={coupling!r}, got {count}: only the elastic step"
            ' of coupling="split" can be cut short, contact needs a converged one'
        )
    return count
