"""A method of your own with a learner of its own: behaviour cloning, which does in every state what the data did."""

from dataclasses import dataclass
from typing import Any, NamedTuple

from sgft_jax.methods.options import RowsOptions, agent_of
from sgft_jax.types import Batch, Fixed, HybridAgent, Learner, Method, Normalizer, Task


@dataclass(frozen=True)
class Config(RowsOptions):
    """Options of `cloning`: learning rate, widths and rows of a batch; it has no use for the others."""


class State(NamedTuple):
    """An agent in training. actor: network and moments. normalizer: of the observations that it reads."""

    actor: Any
    normalizer: Normalizer


def make_cloning(config: Config, task: Task) -> Learner:
    """A deterministic actor that learns from real rows alone."""
    import jax
    import jax.numpy as jnp

    from sgft_jax.math import losses, optim
    from sgft_jax.models import normalizer
    from sgft_jax.models.networks import add_noise, make_deterministic_actor

    actor, optimiser = make_deterministic_actor(task.obs_dim, task.act_dim, config.network), optim.adam()

    def init(key: Any) -> State:
        return State(optim.start(optimiser, actor.init(key)), normalizer.identity(task.obs_dim))

    def act(state: State, carry: Any, obs: Any, key: Any, *, explore: Any) -> tuple[Any, Any]:
        action = actor.apply(state.actor.params, normalizer.normalize(state.normalizer, obs))
        return jnp.where(explore, add_noise(action, 0.1, key), action), carry

    def update(state: State, batch: Batch, key: Any) -> tuple[State, dict[str, Any]]:
        del key  # draws nothing
        rows = normalizer.normalize_rows(state.normalizer, batch)

        def loss(params: Any) -> tuple[Any, tuple[()]]:
            apart = jax.vmap(actor.apply, (None, 0))(params, rows.obs) - rows.action
            return losses.row_mean(jnp.sum(apart**2, axis=1), rows), ()

        fit, value, _ = optim.minimise(optimiser, loss, state.actor, config.lr)
        return state._replace(actor=fit), {"actor/loss": value}

    return Learner(init, lambda: (), act, update)


def build(config: Config, task: Task) -> HybridAgent:
    """The agent."""
    return agent_of(make_cloning(config, task), config, task, head="deterministic")


METHOD = Method("cloning", fixed=Fixed("offline", "does what the data did", "", {"default": Config()}, build))
