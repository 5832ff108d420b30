"""Problems with known answers, each of which isolates one fault, and the learners that must solve them, all tiny.

Everything has two observation entries, one action entry and ROWS rows, so that a learner's update is compiled once for
all tests of a module. The first observation entry is the state s of a problem, the other is 0.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sgft_jax.learners import cql, darc, edac, h2o, h2oplus, iql, rebrac, recurrent, sac, tdmpc2, tdmpc2_model
from sgft_jax.models import gru, networks, ratio
from sgft_jax.types import Batch, Learner

ROWS = 32
NET = networks.NetworkConfig(hidden=(32,))


class Probe(NamedTuple):
    """A world of a few states in which actions change nothing but the reward.

    states: s of the rows, equally likely. reward(s, a); discount(s); following(s) -> the next s. values: s -> V;
    actions: s -> the best action.
    """

    states: tuple[float, ...]
    reward: Callable = lambda s, a: jnp.ones_like(s)
    discount: Callable = jnp.zeros_like
    following: Callable = lambda s: s
    values: Mapping[float, float] = MappingProxyType({})
    actions: Mapping[float, float] = MappingProxyType({})


PROBES = {
    "constant reward": Probe((0.0,), values={0.0: 1.0}),
    "reward seen in the observation": Probe((-1.0, 1.0), lambda s, a: s, values={-1.0: -1.0, 1.0: 1.0}),
    # 0 pays nothing and leads to 1, which pays 1 and ends
    "reward one step later": Probe(
        (0.0, 1.0), lambda s, a: s, lambda s: 0.8 * (s == 0), jnp.ones_like, values={0.0: 0.8, 1.0: 1.0}
    ),
    # 1 / (1 - 0.8): a time limit ends an episode, not what could still be had
    "time limit": Probe((0.0, 1.0), discount=lambda s: 0.8 + 0 * s, values={0.0: 5.0, 1.0: 5.0}),
    "termination": Probe((0.0, 1.0), discount=lambda s: 0.8 * (s == 0), values={0.0: 5.0, 1.0: 1.0}),
    "action decides": Probe((0.0,), lambda s, a: 1 - (a - 0.5) ** 2, actions={0.0: 0.5}),
    "state and action decide": Probe((-1.0, 1.0), lambda s, a: 1 - (a - 0.6 * s) ** 2, actions={-1.0: -0.6, 1.0: 0.6}),
}


def obs_of(s):
    """The observation [2] of state s."""
    return jnp.array([s, 0.0], jnp.float32)


def rows(probe, key):
    """[ROWS] transitions of random states and actions."""
    key_state, key_action = jax.random.split(key)
    s = jax.random.choice(key_state, jnp.array(probe.states), (ROWS,))
    action = jax.random.uniform(key_action, (ROWS, 1), minval=-1)

    def wide(s):
        return jnp.stack([s, jnp.zeros(ROWS)], axis=1)

    reward, discount = (jnp.asarray(x, jnp.float32) for x in (probe.reward(s, action[:, 0]), probe.discount(s)))
    return Batch(wide(s), action, reward, discount, wide(probe.following(s)))


def windows(batch):
    """The same rows as windows of two steps, of which the second does not belong to them."""
    twice = jax.tree.map(lambda x: jnp.stack([x, jnp.zeros_like(x)], axis=1), batch)
    return twice._replace(valid=jnp.stack([jnp.ones(ROWS, bool), jnp.zeros(ROWS, bool)], axis=1))


class Case(NamedTuple):
    """A learner as all tests of a module share it: compiled, and its `update` counted by `traces` (a list of one).

    start(key) -> state. feed(rows) -> the batch it wants. values(state, obs) -> all its estimates of V(obs), or
    None where its V is frozen. mode(state, obs) -> the action [1] that its policy takes for best. steps: updates to
    solve a probe.
    """

    learner: Learner
    start: Callable
    feed: Callable
    values: Callable | None
    mode: Callable
    steps: int
    traces: list[int]


def counted(learner, **case):
    """A Case of a learner."""
    traces = [0]

    def update(state, batch, key):
        traces[0] += 1
        return learner.update(state, batch, key)

    act = jax.jit(learner.act, static_argnames="explore")
    compiled = learner._replace(init=jax.jit(learner.init), update=jax.jit(update), act=act)
    return Case(**{"learner": compiled, "start": compiled.init, "traces": traces, **case})


class Ratio(NamedTuple):
    """The functions of `models.ratio`, bound to a configuration."""

    init: Callable
    update: Callable
    log_ratio: Callable


def make_ratio(config):
    """Of a configuration."""
    return Ratio(*(functools.partial(function, config) for function in (ratio.init, ratio.update, ratio.log_ratio)))


def compiled_once(learner):
    """A learner whose compiled `update` may be traced once."""
    traces = itertools.count(1)

    def update(state, batch, key):
        assert next(traces) == 1, "update was traced again"
        return learner.update(state, batch, key)

    return learner._replace(init=jax.jit(learner.init), update=jax.jit(update))


# alpha 1e-4: entropy changes the answers by less than their tolerance
SAC_HYPER = sac.SACHyper(lr_actor=3e-3, lr_critic=1e-2, lr_dynamics=1e-2, tau=0.1, alpha=1e-4)


def _sac(**options: Any):
    config = sac.SACConfig(2, 1, network=NET, tune_alpha=False, **options)
    learner = sac.make_sac(config, SAC_HYPER)
    critic = networks.make_critic(2, 1, config.critic_network or NET, members=config.critics)

    @jax.jit
    def values(state, obs):
        return critic.apply(state.critic.params, obs, jnp.zeros(1))

    case = counted(learner, feed=lambda batch: batch, values=values, mode=None, steps=400)
    return case._replace(mode=_mode(case))


def _iql():
    # beta 20: the policy is close to the best of the data's actions
    learner = iql.make_iql(
        iql.IQLConfig(2, 1, network=NET), iql.IQLHyper(lr_actor=3e-3, lr_critic=1e-2, lr_value=1e-2, tau=0.1, beta=20.0)
    )
    critic, value_net = networks.make_critic(2, 1, NET), networks.make_value(2, NET)

    @jax.jit
    def values(state, obs):
        q = critic.apply(state.critic.params, obs, jnp.zeros(1))
        return jnp.append(q, value_net.apply(state.value.params, obs))

    case = counted(learner, feed=lambda batch: batch, values=values, mode=None, steps=400)
    return case._replace(mode=_mode(case))


def _h2oplus(critics=2, diversity=0.0):
    learner = h2oplus.make_h2oplus(
        h2oplus.H2OPlusConfig(
            2, 1, network=NET, ratio_network=NET, tune_alpha=False, critics=critics, diversity=diversity
        ),
        h2oplus.H2OPlusHyper(lr_actor=3e-3, lr_critic=1e-2, lr_value=1e-2, tau=0.1, alpha=1e-4),
    )
    return _soft(learner, half_simulated, value=True, members=critics)


def _h2o():
    """Hardly conservative: the answers are those of plain values."""
    learner = h2o.make_h2o(
        h2o.H2OConfig(2, 1, network=NET, ratio_network=NET, tune_alpha=False),
        h2o.H2OHyper(lr_actor=3e-3, lr_critic=1e-2, tau=0.1, alpha=1e-4, conservatism=1e-3),
    )
    return _soft(learner, half_simulated)


def _darc():
    """Its discriminators begin without a clue, log w = 0: the probes' answers are those of the unchanged reward."""
    config = darc.DARCConfig(2, 1, network=NET, ratio_network=NET, tune_alpha=False)
    learner = darc.make_darc(config, SAC_HYPER, lr_ratio=1e-4)
    case = _soft(learner, half_simulated, critic_of=lambda state: state.sac.critic)

    def start(key):
        state = case.learner.init(key)
        return state.replace(
            ratio=jax.tree.map(jnp.zeros_like, state.ratio)._replace(normalizer=state.ratio.normalizer)
        )

    return case._replace(start=start)


def _cql():
    config = cql.CQLConfig(2, 1, network=NET, conservatism=1e-3, tune_alpha=False)
    return _soft(cql.make_cql(config, SAC_HYPER), lambda batch: batch)


def _edac():
    config = edac.EDACConfig(2, 1, network=NET, critics=4, diversity=1e-2, tune_alpha=False)
    return _soft(edac.make_edac(config, SAC_HYPER), lambda batch: batch, members=4)


def _rebrac():
    """Hardly penalised: the answers are those of plain values."""
    learner = rebrac.make_rebrac(
        rebrac.ReBRACConfig(2, 1, network=NET, policy_delay=1),
        rebrac.ReBRACHyper(lr_actor=1e-2, lr_critic=1e-2, tau=0.1, actor_penalty=1e-3, critic_penalty=1e-3),
    )
    # Q is divided by its mean size, which is nearly 0 at first: Adam remembers these steps for a while
    return _soft(learner, windows)._replace(steps=800)


def _soft(learner, feed, *, value=False, members=2, critic_of=lambda state: state.critic):
    """A Case of an actor-critic whose networks are those of NET."""
    critic, value_net = networks.make_critic(2, 1, NET, members=members), networks.make_value(2, NET)

    @jax.jit
    def values(state, obs):
        q = critic.apply(critic_of(state).params, obs, jnp.zeros(1))
        return jnp.append(q, value_net.apply(state.value.params, obs)) if value else q

    case = counted(learner, feed=feed, values=values, mode=None, steps=400)
    return case._replace(mode=_mode(case))


def half_simulated(batch):
    """The same rows, of which every other one is the simulator's."""
    return batch._replace(is_sim=jnp.arange(ROWS) % 2 == 1)


def _recurrent():
    """Rows are first steps of episodes."""
    config = recurrent.RecurrentConfig(2, 1, network=NET, gru=8)
    memory = gru.make_gru(2, 1, 8)
    critic = networks.make_critic(memory.features, 1, NET)
    # the temperature stays so low that entropy changes the answers by less than their tolerance
    learner = recurrent.make_recurrent(config, recurrent.RecurrentHyper(lr=4e-3, tau=0.1, alpha=1e-4))

    @jax.jit
    def values(state, obs):
        params = state.critic.params
        return critic.apply(
            params["head"], memory.along(params["memory"], jnp.zeros((1, 1)), obs[None])[0], jnp.zeros(1)
        )

    case = counted(learner, feed=windows, values=values, mode=None, steps=800)
    return case._replace(mode=_mode(case))


def _mode(case):
    key = jax.random.key(0)
    return lambda state, obs: case.learner.act(state, case.learner.init_carry(), obs, key, explore=False)[0]


SIZE = tdmpc2_model.Size(encoder=24, mlp=24, latent=16, members=3)
PLAIN = tdmpc2.TDMPC2Config(
    2, 1, horizon=2, size=SIZE, simnorm_group=4, dropout=0.0, samples=32, elites=6, policy_samples=4, iterations=4
)
PLANNER_HYPER = tdmpc2.TDMPC2Hyper(lr=3e-3, tau=0.2, encoder_lr_scale=1.0)


def _tdmpc2(config, steps):
    learner = tdmpc2.make_tdmpc2(config, PLANNER_HYPER)
    first = tdmpc2.make_tdmpc2(PLAIN, PLANNER_HYPER).init

    def start(key):
        state = first(key)
        return tdmpc2.state_from_prior(config, PLANNER_HYPER, tdmpc2.extract_params(state)) if config.sgft else state

    value = jax.jit(functools.partial(tdmpc2_model.value_of, config))
    policy = jax.jit(functools.partial(tdmpc2.policy_action, config), static_argnames="explore")
    return counted(
        learner,
        start=jax.jit(start),
        feed=windows,
        values=None if config.sgft else value,
        mode=lambda state, obs: policy(state, obs, jax.random.key(0), explore=False),
        steps=steps,
    )


MAKERS = {
    "sac": lambda: _sac(ensemble_size=2),
    # RLPD's: ten normalised critics, targets from two of them, the actor follows their mean
    "sac, ten critics": lambda: _sac(
        critics=10,
        target_critics=2,
        actor_mean=True,
        train_dynamics=False,
        critic_network=dataclasses.replace(NET, layer_norm=True),
    ),
    "iql": _iql,
    "h2oplus": _h2oplus,
    "h2oplus, four critics": lambda: _h2oplus(4, 1e-2),
    "h2o": _h2o,
    "darc": _darc,
    "cql": _cql,
    "edac": _edac,
    "rebrac": _rebrac,
    "recurrent": _recurrent,
    "tdmpc2": lambda: _tdmpc2(PLAIN, 800),
    "sgft-tdmpc2": lambda: _tdmpc2(dataclasses.replace(PLAIN, sgft=True), 1000),
}


@functools.cache
def case(name):
    """The learner of that name, compiled once."""
    return MAKERS[name]()
