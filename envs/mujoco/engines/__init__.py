"""Physics engines. They are imported where one is made: MJX alone takes two seconds."""

from collections.abc import Callable
from typing import NamedTuple

from envs.types import Array, PyTree


class Engine(NamedTuple):
    """What steps a scene, for one world; vmap over worlds.

    fields: of the model that differ between worlds, by name. state: a `PhysicsState`.
    advance(fields, state, controls [substeps, nu]) -> the state after these steps.
    sense(fields, state) -> the same state with what its sensors read.
    """

    advance: Callable[[dict[str, Array], PyTree, Array], PyTree]
    sense: Callable[[dict[str, Array], PyTree], PyTree] = lambda fields, state: state
