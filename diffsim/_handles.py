"""What a scene returns for an object added to it: its index, with a name."""

from __future__ import annotations


class BodyHandle(int):
    """The index of a body in the body axis of states, controls and parameters: `state.position[..., cube, :]`."""

    name: str  #: as given to, or made up by, the scene

    def __new__(cls, index: int, name: str) -> BodyHandle:
        handle = super().__new__(cls, index)
        handle.name = name
        return handle

    def __getnewargs__(self) -> tuple[int, str]:  # type: ignore[override]  # what pickle and deepcopy call __new__ with
        return int(self), self.name

    def __repr__(self) -> str:
        return f"BodyHandle({int(self)}, {self.name!r})"


class BodyCount:
    """How many bodies a scene has by now. Cloths come behind them, so that cloth handles have to look here."""

    __slots__ = ("value",)

    def __init__(self) -> None:
        self.value = 0


class ClothHandle:
    """A cloth of a scene: `state.node_position[..., sheet.nodes, :]`, `sim.cloth_bend[sheet.cloth]`.

    It is no index by itself: a cloth has a place in three axes, and a tensor cannot tell which one is meant.
    """

    __slots__ = ("_body_count", "cloth", "name", "nodes")

    name: str  #: as given to, or made up by, the scene
    cloth: int  #: index in the axis of cloths
    nodes: slice  #: in the axis of nodes

    def __init__(self, cloth: int, nodes: slice, name: str, body_count: BodyCount) -> None:
        self.cloth = cloth
        self.nodes = nodes
        self.name = name
        self._body_count = body_count

    def __int__(self) -> int:
        """Index in the axis of objects, bodies first: `sim.friction[int(sheet)]`. Adding more bodies moves it."""
        return self._body_count.value + self.cloth

    def __index__(self) -> int:  # torch and numpy drop the message, but refuse the index
        raise TypeError(
            f"{self!r} is no index: use its .cloth in the axis of cloths (sim.cloth_bend[sheet.cloth]), its .nodes in "
            "that of nodes, its int() in that of objects (sim.friction[int(sheet)])"
        )

    def __repr__(self) -> str:
        return f"ClothHandle({int(self)}, {self.name!r}, nodes {self.nodes.start}:{self.nodes.stop})"
