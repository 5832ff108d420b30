"""IQL: in-sample learning (Kostrikov et al. 2021), from the data's actions, without asking what another is worth.

From simulated data, then with real transitions in half of each batch; or from a fixed set of real data alone.
"""

from dataclasses import dataclass, replace
from math import inf
from typing import ClassVar

from envs.types import Key, PyTree
from sgft_jax import checks
from sgft_jax.methods.options import RowsOptions, agent_of, return_scale
from sgft_jax.train.options import MixedOptions
from sgft_jax.types import (
    Finetuner,
    Fixed,
    HybridAgent,
    Method,
    Online,
    Prior,
    RealData,
    SimulatedData,
    Simulation,
    Task,
)


@dataclass(frozen=True)
class Config(MixedOptions):
    """Options of `iql`; the defaults are Kostrikov et al. 2022's for locomotion."""

    max_weight: ClassVar[float] = 100.0
    actor_updates: ClassVar[float] = inf

    lr_actor: checks.Positive = 3e-4
    """Adam learning rate of the actor."""
    lr_critic: checks.Positive = 3e-4
    """Adam learning rate of critic and value."""
    tau: checks.Share = 0.005
    """Averaging rate of the target critic."""
    expectile: checks.Share = 0.7
    """V is the mean of the data's actions at 0.5 and tends to their best towards 1."""
    beta: checks.NotNegative = 3.0
    """Inverse temperature of the advantage weights; 0 clones the data."""
    reward_scale: checks.Positive | None = None
    """Factor on every reward; None = episode length / (best - worst return of the simulated episodes)."""
    simulated_share: float = 0.5
    """Share of each batch that is simulated, once there are real transitions."""
    simulated_transitions: int = 1_000_000
    offline_updates: checks.Updates = 500_000
    """Updates on the simulated transitions alone, before the first real rollout."""

    @property
    def lr_value(self) -> float:
        """That of the critic."""
        return self.lr_critic


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner; the simulator's policy makes data and the initial rollouts, the agent starts from nothing."""
    import jax.numpy as jnp

    from sgft_jax.data import sources
    from sgft_jax.learners import iql
    from sgft_jax.learners.sac import SACParams
    from sgft_jax.models.config import network_of
    from sgft_jax.policies import sac_policy
    from sgft_jax.train.finetuner import FinetuneState, Parts, assemble, mixed_rows, simulator_actor
    from sgft_jax.train.options import card_of

    network = network_of(card_of(prior))
    structure = iql.IQLConfig(task.obs_dim, task.act_dim, network, config.max_grad_norm)
    learner = iql.make_iql(structure, replace(config, reward_scale=config.reward_scale or 1.0))

    def start(params: SACParams | None, key: Key) -> tuple[PyTree, PyTree]:
        state = learner.init(key)
        if params is None:
            return state, SACParams(None, None, None, None, state.normalizer)
        return state.replace(normalizer=params.normalizer), params._replace(actor=None, critic=None)

    def prepare(state: FinetuneState, simulated: SimulatedData) -> FinetuneState:
        if config.reward_scale is not None:
            return state
        span = jnp.max(simulated.returns) - jnp.min(simulated.returns)  # published: that of the length of an episode
        scale = jnp.float32(task.episode_length / jnp.maximum(span, 1e-6))
        hyper = state.learner.hyper._replace(reward_scale=scale)
        return state._replace(learner=state.learner.replace(hyper=hyper))

    def export(state: FinetuneState) -> SACParams:
        actor = iql.as_tanh_gaussian(state.learner.actor.params)
        return state.frozen._replace(actor=actor, critic=state.learner.critic.params)

    source, _ = mixed_rows(config, prior)
    simulation = Simulation(config.simulated_transitions, config.simulated_ladder, config.offline_updates)
    parts = Parts(
        learner=learner,
        start=start,
        prepare=prepare,
        export=export,
        policy=sac_policy(task.obs_dim, task.act_dim, network),
        source=lambda state: source,
        offline=sources.simulated_rows(config.batch_size),
        beginner=None if prior is None else simulator_actor,
        simulation=None if prior is None else simulation,
    )
    return assemble(parts, config, task)


@dataclass(frozen=True)
class FixedConfig(RowsOptions):
    """Options of `iql` from a fixed set of real data; the published ones for locomotion."""

    max_weight: ClassVar[float] = 100.0
    reward_scale: ClassVar[float] = 1.0
    actor_updates: ClassVar[float] = inf

    expectile: checks.Share = 0.7
    """V is the mean of the data's actions at 0.5 and their best towards 1."""
    beta: checks.NotNegative = 3.0
    """Inverse temperature of the advantage weights; 0 clones the data."""
    falling_rate: bool = True
    """Let the actor's learning rate fall to 0 along a cosine over all updates of the run, as the authors do."""
    scale_rewards: bool = True
    """Divide rewards by the span of the data's returns and multiply them by 1,000, as the authors do. A log of one
    episode keeps its rewards."""


def build_fixed(config: FixedConfig, task: Task) -> HybridAgent:
    """The agent."""
    import jax.numpy as jnp

    from sgft_jax.learners import iql
    from sgft_jax.policies import ActorParams, actor_params

    def prepare(state: iql.IQLState, real: RealData, updates: int) -> iql.IQLState:
        hyper = state.hyper
        if config.scale_rewards:
            hyper = hyper._replace(reward_scale=return_scale(real))
        if config.falling_rate:
            hyper = hyper._replace(actor_updates=jnp.float32(updates))
        return state.replace(hyper=hyper)

    def export(state: iql.IQLState) -> ActorParams:
        return ActorParams(iql.as_tanh_gaussian(state.actor.params), actor_params(state).normalizer)

    learner = iql.make_iql(iql.IQLConfig(task.obs_dim, task.act_dim, config.network), config)
    return agent_of(learner, config, task, prepare=prepare, export=export)


_ABOUT = "in-sample learning: offline from simulated data, then online"
_ABOUT_FIXED = "the best of the data's own actions"
METHOD = Method(
    "iql",
    Online("offline", _ABOUT, "Kostrikov 2022", Config, build, needs_prior=False, zero_shot=False),
    Fixed("offline", _ABOUT_FIXED, "Kostrikov et al. 2021", {"default": FixedConfig()}, build_fixed),
)
