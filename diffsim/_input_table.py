"""The operator's inputs, in its order: state, controls, parameters, as `csrc/rollout/input_table.hpp` lists them.

All that hands them on loops over what is here; none of it knows a parameter by name.
"""

from __future__ import annotations

from . import _core

INPUTS = tuple(_core.inputs())
INPUT_COUNT = len(INPUTS)
LABELS = tuple(i.label for i in INPUTS)  #: as users know them: "state.position", "mass"
BASE_NDIM = tuple(bool(i.axis) + len(i.row_shape) for i in INPUTS)  #: of each, without time and batch


def _names(kind: str) -> tuple[str, ...]:
    return tuple(i.name for i in INPUTS if i.kind == kind)


STATE_FIELDS, CONTROL_FIELDS, PARAMETERS = _names("state"), _names("control"), _names("parameter")
STATE_COUNT = len(STATE_FIELDS)  #: of the outputs, too
CONTROLS = range(STATE_COUNT, STATE_COUNT + len(CONTROL_FIELDS))  #: which of the inputs may have a time axis

#: Those that a scene without cloth has nothing of.
OF_CLOTH = frozenset(i.name for i in INPUTS if i.axis in ("nodes", "cloths"))
#: Parameters that are scales: a change is measured in proportion to them.
SCALES = frozenset(i.name for i in INPUTS if i.allowed != "any")

#: Parameters of the module, those of objects before those of cloth: restitution is checked, but the core has none yet.
MODULE_PARAMETERS = (
    *(name for name in PARAMETERS if name not in OF_CLOTH),
    "restitution",
    *(name for name in PARAMETERS if name in OF_CLOTH),
)
