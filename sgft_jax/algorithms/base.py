"""What an algorithm is that leaves priors, and what the files of this folder share. Imports no JAX."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, NotRequired, TypedDict

from msgspec import Meta, Struct

from envs.files import Count
from envs.types import Array, Policy, PyTree
from sgft_jax.types import Learner, Task

if TYPE_CHECKING:
    from sgft_jax.data.memory import Memory
    from sgft_jax.models.networks import Network
    from sgft_jax.presets import PretrainConfig

# Types of modules that import JAX or this folder, for files that may import neither
type Config = PretrainConfig
type Networks = Iterable[tuple[str, Network, PyTree]]
Width = Annotated[int, Meta(ge=1, le=2**20)]  # no number of units, samples or models comes near


# --- cards ------------------------------------------------------------------------------------------------------------


class NetworkEntry(Struct, forbid_unknown_fields=True):
    """What a card says of `models.config.NetworkConfig`."""

    hidden: Annotated[list[Width], Meta(min_length=1, max_length=100)]
    layer_norm: bool = False
    actor_layer_norm: bool = False
    activation: Literal["relu", "tanh", "silu", "elu"] = "relu"
    blind: Annotated[int, Meta(ge=0, le=2**20)] = 0


class VaryingEntry(Struct, forbid_unknown_fields=True):
    """What a card says of `envs.base.Varying`."""

    name: str
    index: Count
    low: float
    high: float


class _Gap(TypedDict):
    name: str
    params: dict[str, Any]
    effects: dict[str, Any]
    scene: str
    commands: NotRequired[dict[str, Any]]


class Card(TypedDict):
    """What every card says."""

    task: str
    obs_dim: Width
    act_dim: Width
    gamma: Annotated[float, Meta(ge=0, lt=1)]
    algorithm: NotRequired[str]
    previous_actions: NotRequired[Count]
    sparse: NotRequired[bool]
    system: NotRequired[list[VaryingEntry]]
    ensemble_size: NotRequired[Width]
    gap: NotRequired[_Gap | None]


# --- pretraining ------------------------------------------------------------------------------------------------------


class Recipe(NamedTuple):
    """How an algorithm is pretrained.

    learner: its `act` explores, cheap enough for a fleet.
    hyper(steps []) -> the learner's numbers after so many steps of all environments.
    extract(agents [M]) -> params [M].
    replaced(carry, action) -> the carry if another action was taken than `act` chose.
    valued: whether V_sim is fitted to the policy afterwards, see `train.value_fit`.
    """

    learner: Learner
    memory: Memory
    hyper: Callable[[Array], Any]
    extract: Callable[[Any], PyTree]
    replaced: Callable[[PyTree, Array], PyTree] = lambda carry, action: carry
    valued: bool = False


def scheduled(config: Config, numbers: Callable[[Array], Any]) -> Callable[[Array | int], Any]:
    """The learner's numbers after so many steps of all environments, float32. numbers: them for a learning rate []."""
    import jax
    import jax.numpy as jnp
    import optax

    rate = optax.linear_schedule(config.lr, config.lr * config.lr_end, max(1, config.env_steps // config.n_envs))
    return lambda steps: jax.tree.map(jnp.float32, numbers(jnp.asarray(rate(steps))))


# --- an algorithm -----------------------------------------------------------------------------------------------------


class Algorithm(NamedTuple):
    """How priors of one algorithm are made and used.

    name: what their cards say. card: a TypedDict, the schema of these.
    params() -> the NamedTuple that holds their parameters. Files have the names of its fields, not its own.
    policy(card, task) -> how they act. A policy that plans asks the task for rewards.
    networks(card, params) -> (name, network, what the prior has for it) of every network that a card describes.
    recipe(task, config) -> how they are pretrained; None where pretraining makes none. preset: of `presets.PRESETS`,
        which makes the priors that methods need.
    plans(card) -> whether they search for a plan at every step.
    remembers: whether they carry (state of the GRU, last action) from step to step, see `learners.recurrent`.
    program: the numbers of a card's `config` that priors share which act in one program.
    """

    name: str
    card: Any
    params: Callable[[], type[Any]]
    policy: Callable[[Mapping[str, Any], Task], Policy]
    networks: Callable[[Mapping[str, Any], Any], Networks]
    recipe: Callable[[Task, Config], Recipe] | None = None
    preset: str = ""
    plans: Callable[[Mapping[str, Any]], bool] = lambda card: bool(card.get("plan"))
    remembers: bool = False
    program: tuple[str, ...] = ()
