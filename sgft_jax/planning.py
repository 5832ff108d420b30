"""Planning by sampling: MPPI on any score of action sequences, and with it plans by the models of a prior of SAC.

Model predictive path integral control: Williams et al. 2015, as in TD-MPC2 (Hansen et al. 2024): elites alone count,
and a policy makes proposals. MPC-SGFT is the SGFT paper's Algorithm 3, which plans in the latent space of TD-MPC2. A
prior of SAC has all that a plan needs in the space of observations: an ensemble of models, the task's reward, V_sim,
and a policy that proposes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp

from envs.types import Array, Key, PyTree, UserError
from sgft_jax import checks
from sgft_jax.models import dynamics, networks, value
from sgft_jax.models.config import NetworkConfig
from sgft_jax.models.normalizer import normalize

__all__ = ["MPCConfig"]

_WORST = -1e9  # finite, so that weights stay defined where no score is


@dataclass(frozen=True)
class MPPIConfig(checks.Checked):
    """samples: sequences per iteration, proposals among them. elites: the best of them. iterations: of the search."""

    samples: int = 512
    elites: checks.Count = 64
    iterations: checks.Count = 6

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.elites > self.samples:
            raise checks.refusal("elites", self.elites, f"at most samples, {self.samples}")


class MPPIHyper(NamedTuple):
    """The numbers of the search, each [].

    temperature: elites weigh exp(temperature (score - best score)), so larger is greedier; per unit of score.
    std_min, std_max: bounds on the spread of the samples, units of the action's range [-1, 1]; std_max at the start.
    """

    temperature: float | Array = 0.5
    std_min: float | Array = 0.05
    std_max: float | Array = 2.0


class _Search(NamedTuple):
    """mean, std: [H, act_dim] of the next samples. elites: [elites, H, act_dim] with their log-weights [elites]."""

    mean: Array
    std: Array
    elites: Array
    logits: Array


def plan(
    config: MPPIConfig,
    hyper: MPPIHyper,
    score: Callable[[Array], Array],
    proposals: Array,
    previous: Array,
    key: Key,
    *,
    explore: bool | Array,
) -> tuple[Array, Array]:
    """One action [act_dim] in [-1, 1], and the mean [H, act_dim] of the plan, which is the next call's `previous`.

    score(sequence [H, act_dim]) -> []: higher is better; a score that is not finite ranks last. Each of the
        `proposals` is scored once.
    proposals: [n, H, act_dim] sequences in [-1, 1] that compete with the samples, n < samples (n = 0: none).
    previous: [H, act_dim] the last plan; its first step lies in the past by now. Zeros at the start of an episode.
    explore: [] bool, may be traced. Both modes draw one elite by its weight; exploring adds noise of the search's final
        spread. As published: the mean of the elites can lie between two good ways round an obstacle, an elite cannot.
        Evaluation is a function of the key for it, not of the observation alone.
    """
    n = proposals.shape[0]
    if n >= config.samples:
        raise UserError(f"planner: {n} proposals leave none of {config.samples} samples to draw; raise samples")
    key_search, key_pick, key_noise = jax.random.split(key, 3)

    def rate(sequences: Array) -> Array:
        scores = jax.vmap(score)(sequences)
        return jnp.where(jnp.isfinite(scores), scores, _WORST)

    known = rate(proposals) if n else jnp.zeros(0)

    def refine(search: _Search, key: Key) -> tuple[_Search, None]:
        noise = jax.random.normal(key, (config.samples - n, *previous.shape))
        drawn = jnp.clip(jax.vmap(lambda e: search.mean + search.std * e)(noise), -1.0, 1.0)
        candidates = jnp.concatenate([proposals, drawn])
        best, index = jax.lax.top_k(jnp.concatenate([known, rate(drawn)]), config.elites)
        return _fit(candidates[index], hyper.temperature * (best - best[0]), hyper), None

    mean, std = jnp.concatenate([previous[1:], jnp.zeros_like(previous[:1])]), jnp.full(previous.shape, hyper.std_max)
    start = _Search(mean, std, jnp.zeros((config.elites, *previous.shape)), jnp.zeros(config.elites))
    end, _ = jax.lax.scan(refine, start, jax.random.split(key_search, config.iterations))
    action = end.elites[jax.random.categorical(key_pick, end.logits), 0]
    return networks.add_noise(action, jnp.where(explore, end.std[0], 0.0), key_noise), end.mean


def _fit(elites: Array, logits: Array, hyper: MPPIHyper) -> _Search:
    """Weighted mean and spread of elites [elites, H, act_dim] with log-weights [elites]."""
    weights = jax.nn.softmax(logits)
    mean = jnp.einsum("n,nha->ha", weights, elites)
    variance = jnp.einsum("n,nha->ha", weights, jax.vmap(lambda e: (e - mean) ** 2)(elites))
    return _Search(mean, jnp.clip(jnp.sqrt(variance), hyper.std_min, hyper.std_max), elites, logits)


# --- with the models of a prior of SAC -------------------------------------------------------------------------------

_ITERATIONS = 3  # of the search: half of TD-MPC2's, for plans a quarter as long
_PROPOSALS, _ELITES = 4, 8  # one of so many samples is the policy's, and an elite
# TD-MPC2 averages over elites that differ by some units of return; here a plan is a step or a few, a tenth is a lot.
_SEARCH = MPPIHyper(temperature=20.0, std_min=0.05, std_max=1.0)


@dataclass(frozen=True)
class MPCConfig(checks.Checked):
    """obs_dim, act_dim; network: the prior's. horizon: steps of a plan, H. samples: sequences tried per iteration.

    noise: std of the noise on the policy's proposals, in units of the action's range [-1, 1]. gamma: discount factor.
    """

    obs_dim: int
    act_dim: int
    network: NetworkConfig
    horizon: checks.Count = 1
    samples: Annotated[int, checks.least(_ELITES), checks.countable] = 128
    noise: float = 0.5
    gamma: float = 0.99


def init_carry(config: MPCConfig) -> Array:
    """The plan [H, act_dim] of a step that never was, for the first step of an episode."""
    return jnp.zeros((config.horizon, config.act_dim))


def make_act(
    config: MPCConfig,
    *,
    reward: Callable[[Array, Array, Array], Array],
    terminated: Callable[[Array, Array, Array], Array],
) -> Callable[..., tuple[Array, PyTree]]:
    """act(params, carry, obs [obs_dim], key, *, explore) -> (action [act_dim], carry); explore: [] bool, may be traced.

    params: as `SACParams`, of which the critic is not read. reward, terminated: the task as functions of one (obs,
    action, next_obs). A plan's score is the mean over the ensemble's members, each followed on its own, of
    sum_t gamma^t r_t + gamma^H V_sim(s_H). Source: SGFT equation (1) but for V_sim(s_0), which is the same for all.
    """
    actor = networks.make_actor(config.obs_dim, config.act_dim, config.network)
    value_net = value.make_v_sim(config.obs_dim, config.network)
    model = networks.make_dynamics(config.obs_dim, config.act_dim, config.network)
    search = MPPIConfig(config.samples, config.samples // _ELITES, _ITERATIONS)

    def score(params: PyTree, obs: Array, sequence: Array) -> Array:
        members = jax.tree.leaves(params.dynamics)[0].shape[0]

        def step(carry: tuple[Array, Array, Array], action: Array) -> tuple[tuple[Array, Array, Array], None]:
            obs, discount, total = carry  # of every member: [members, obs_dim], [members], [members]
            next_obs = dynamics.predict_each(model, params.dynamics, params.normalizer, obs, action)
            moved = obs, action, next_obs
            goes_on = config.gamma * (1.0 - jax.vmap(terminated, (0, None, 0))(*moved).astype(jnp.float32))
            earned = discount * jax.vmap(reward, (0, None, 0))(*moved)
            return (next_obs, discount * goes_on, total + earned), None

        start = (jnp.tile(obs, (members, 1)), jnp.ones(members), jnp.zeros(members))
        (end, discount, total), _ = jax.lax.scan(step, start, sequence)
        to_go = jax.vmap(lambda obs: value.predict(value_net, params.value, params.normalizer, obs))(end)
        return jnp.mean(total + discount * to_go)

    def propose(params: PyTree, member: PyTree, obs: Array, key: Key) -> Array:
        """[H, act_dim]: the policy with noise, followed by one member of the ensemble."""

        def step(obs: Array, key: Key) -> tuple[Array, Array]:
            key_policy, key_noise = jax.random.split(key)
            moments = actor.apply(params.actor, normalize(params.normalizer, obs))
            action = networks.tanh_gaussian_action(moments, key_policy, explore=True)
            action = networks.add_noise(action, config.noise, key_noise)
            return dynamics.predict(model, member, params.normalizer, obs, action)[0], action

        return jax.lax.scan(step, obs, jax.random.split(key, config.horizon))[1]

    def act(params: PyTree, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        key_member, key_propose, key_search = jax.random.split(key, 3)
        member = dynamics.draw_member(params.dynamics, key_member)
        keys = jax.random.split(key_propose, config.samples // _PROPOSALS)
        proposals = jax.vmap(lambda key: propose(params, member, obs, key))(keys)
        rate = partial(score, params, obs)
        return plan(search, _SEARCH, rate, proposals, carry, key_search, explore=explore)

    return act
