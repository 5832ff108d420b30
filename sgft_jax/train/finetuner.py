"""The one generic finetuner: sample a batch, transform it, learn from it. Methods choose the parts.

`assemble` puts parts together; `sac_finetuner` chooses them for methods whose learner is SAC. The caller owns the loop
(`train.finetuning.finetune`) and vmaps over seeds and real systems.
"""

from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType, ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from envs.types import Array, Key, Policy, PyTree, Transition, UserError
from sgft_jax.data import replay, sources
from sgft_jax.files.disk import jsonable
from sgft_jax.learners import sac
from sgft_jax.math import optim
from sgft_jax.models import dynamics, value
from sgft_jax.models.config import NetworkConfig, network_of
from sgft_jax.models.distortion import Interface, Seen, command_interface, translated
from sgft_jax.models.networks import fix_first_layer, make_dynamics
from sgft_jax.policies import sac_policy
from sgft_jax.train import options as rules
from sgft_jax.train.guard import guarded
from sgft_jax.train.options import ActorOptions, LoopOptions, MixedOptions
from sgft_jax.transforms import compose, steps_to_go
from sgft_jax.types import (
    Batch,
    Finetuner,
    Imagination,
    Learner,
    Metrics,
    Normalizer,
    Prior,
    SimulatedData,
    Simulation,
    Source,
    Task,
    Transform,
)

__all__ = ["FinetuneState", "Parts", "assemble", "sac_finetuner"]


class FinetuneState(NamedTuple):
    """The state of one agent in fine-tuning.

    learner: the agent. models: the dynamics ensemble in training, or None. frozen: parameters of the prior that do not
    change, or None. transform: states of the transforms. replay: the real transitions. interface: how the real system
    changes commands and measurements, as far as identified, or None.
    """

    learner: PyTree
    models: PyTree
    frozen: PyTree
    transform: PyTree
    replay: PyTree
    interface: Any = None


Update = Callable[[FinetuneState, Key], tuple[FinetuneState, Metrics]]


class Models(NamedTuple):
    """A part that fits dynamics models: start(params) -> fit; update(fit, normalizer, batch, key) -> (fit, metrics)."""

    start: Callable[[PyTree], PyTree]
    update: Callable[[PyTree, Normalizer, Batch, Key], tuple[PyTree, Metrics]]


class Parts(NamedTuple):
    """What a method chooses.

    learner: its `update` takes the transformed batch.
    start(params, key) -> (learner's state, frozen part of the prior). prepare: see `Finetuner`, with simulated data.
    export(state) -> params; policy: how they act.
    act: as in `Finetuner`, of a `FinetuneState`; None = the learner's.
    source(state) -> where a batch comes from, None = rows of the replay; offline: the same before the first real
        rollout.
    transform: of every batch. imagine(state, key) -> what the transform may ask, None if it asks nothing.
    models: the dynamics ensemble if it trains. memory: the module that keeps real rows, replay or sequences.
    interface: identifies what the real system makes of commands, or None. The learner then acts and learns in the
        simulator's actions, and the replay keeps the commands.
    observed(state) -> state, once the rows of a rollout are kept.
    beginner(params of a prior, what the fresh agent exports) -> params of the simulator's policy as `policy` takes
        them, where that makes the initial rollouts and is what a guard holds on to at first; None = the fresh agent.
    simulation, card: see `Finetuner`.
    """

    learner: Learner
    start: Callable[[PyTree, Key], tuple[PyTree, PyTree]]
    export: Callable[[FinetuneState], PyTree]
    policy: Policy
    prepare: Callable[[FinetuneState, SimulatedData], FinetuneState] = lambda state, simulated: state
    act: Callable[..., tuple[Array, PyTree]] | None = None
    source: Callable[[FinetuneState], Source] | None = None
    offline: Source | None = None
    transform: Transform = compose()
    imagine: Callable[[FinetuneState, Key], Any] = lambda state, key: None
    models: Models | None = None
    memory: ModuleType = replay
    interface: Interface | None = None
    observed: Callable[[FinetuneState], FinetuneState] = lambda state: state
    beginner: Callable[[PyTree, PyTree], PyTree] | None = None
    simulation: Simulation | None = None
    card: Mapping[str, Any] = MappingProxyType({})


def assemble(parts: Parts, options: LoopOptions, task: Task) -> Finetuner:
    """The finetuner of these parts."""

    def source_of(state: FinetuneState, offline: bool) -> Source:
        if offline and parts.offline:
            return parts.offline
        return parts.source(state) if parts.source else sources.real_rows(options.batch_size)

    def init(params: PyTree, key: Key) -> FinetuneState:
        key_learner, key_transform = jax.random.split(key)
        learner, frozen = parts.start(params, key_learner)
        models = None if parts.models is None else parts.models.start(params)
        empty = parts.memory.init(replay.blank(task.obs_dim, task.act_dim), options.replay_capacity)
        key_interface = jax.random.fold_in(key, 1)
        interface = None if parts.interface is None else parts.interface.start(params, key_interface)
        state = FinetuneState(learner, models, frozen, parts.transform.init(params, key_transform), empty, interface)
        # The caller may donate the state. The prior must survive that, and no two leaves may share a buffer.
        return jax.tree.map(jnp.copy, state)

    def prepare(state: FinetuneState, simulated: SimulatedData | None) -> FinetuneState:
        if simulated is None:
            return state
        if parts.interface is not None:
            state = state._replace(interface=parts.interface.prepare(state.interface, simulated))
        return parts.prepare(state, simulated)

    def observe(state: FinetuneState, rows: Transition, valid: Array, score: Array | None) -> FinetuneState:
        state = parts.observed(state._replace(replay=parts.memory.add_episode(state.replay, rows, valid)))
        if parts.interface is None:
            return state
        held = jnp.arange(options.replay_capacity) < state.replay.size
        rollout = None if score is None else (rows, valid, score > 0.5)
        seen = Seen(state.replay.data, held, rollout)
        return state._replace(interface=parts.interface.refit(state.interface, seen))

    def act(
        state: FinetuneState, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array
    ) -> tuple[Array, PyTree]:
        interface = state.interface
        obs = obs if interface is None else interface.distortion.seen(obs)
        if parts.act is None:
            action, carry = parts.learner.act(state.learner, carry, obs, key, explore=explore)
        else:
            action, carry = parts.act(state, carry, obs, key, explore=explore)
        return action if interface is None else interface.distortion.command(action), carry

    def export(state: FinetuneState) -> PyTree:
        params = parts.export(state)
        return params if state.interface is None else params._replace(distortion=state.interface.distortion)

    def learn(
        state: FinetuneState,
        key: Key,
        updates: int,
        simulated: SimulatedData | None = None,
        *,
        offline: bool = False,
        limit: Array | None = None,
    ) -> tuple[FinetuneState, Metrics]:
        if parts.simulation is not None and simulated is None:
            raise UserError("this method learns from transitions of the simulator too: give it some (`SimulatedData`)")

        def update(state: FinetuneState, key: Key) -> tuple[FinetuneState, Metrics]:
            return _update(parts, source_of(state, offline), state, key, simulated)

        # An empty replay is sampled as zeros, which nobody has lived through.
        ready = state.replay.size > 0 if source_of(state, offline).n_real else jnp.ones((), bool)
        return _learn(update, state, jax.random.split(key, updates), ready, limit)

    finetuner = Finetuner(
        init=init,
        prepare=prepare,
        init_carry=parts.policy.init_carry,
        act=act,
        observe=observe,
        learn=learn,
        export=export,
        policy=parts.policy,
        updates_per_rollout=rules.updates_per_rollout(options, task),
        initial_rollouts=options.initial_rollouts,
        initial_policy=parts.policy if parts.beginner else None,
        simulation=parts.simulation,
        card=parts.card,
    )
    if not options.guard:
        return finetuner
    return guarded(finetuner, parts.beginner or (lambda params, fresh: fresh), score=task.score)


def _update(
    parts: Parts, source: Source, state: FinetuneState, key: Key, simulated: SimulatedData | None
) -> tuple[FinetuneState, Metrics]:
    """One batch: models learn from its real rows, transforms and the learner from all."""
    keys = jax.random.split(key, 6)
    rows = source.sample((state.replay, simulated), keys[0])
    metrics: Metrics = {}
    if parts.interface is not None:
        rows = translated(state.interface.distortion, rows)
        metrics = parts.interface.report(state.interface)
    if parts.models is not None and source.n_real:
        real = jax.tree.map(lambda x: x[: source.n_real], rows)
        fit, of_models = parts.models.update(state.models, state.frozen.normalizer, real, keys[1])
        state, metrics = state._replace(models=fit), metrics | of_models
    transform, of_transform = parts.transform.update(state.transform, rows, keys[2])
    batch = parts.transform.apply(transform, parts.imagine(state, keys[3]), rows, keys[4])
    learner, of_learner = parts.learner.update(state.learner, batch, keys[5])
    where = True if batch.valid is None else batch.valid
    metrics |= (
        of_transform
        | of_learner
        | {
            "batch/reward_mean": jnp.mean(batch.reward, where=where),
            "batch/reward_std": jnp.std(batch.reward, where=where),
        }
    )
    return state._replace(learner=learner, transform=transform), metrics


def _learn(
    update: Update, state: FinetuneState, keys: Key, ready: Array, limit: Array | None
) -> tuple[FinetuneState, Metrics]:
    """An update with each of the keys, the first `limit` [] of them if given, or none unless `ready` []."""
    updates = jnp.where(ready, keys.shape[0] if limit is None else limit, 0)

    def step(i: Array, carry: tuple[dict[str, PyTree], Metrics]) -> tuple[dict[str, PyTree], Metrics]:
        new, metrics = update(state._replace(**carry[0]), keys[i])
        return _changing(new), jax.tree.map(jnp.add, carry[1], metrics)

    if limit is None:
        learned, metrics = jax.lax.scan(update, state, keys)
        changed = optax.tree.where(ready, _changing(learned), _changing(state))
        means = jax.tree.map(jnp.mean, metrics)
    else:
        sums = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(update, state, keys[0])[1])
        changed, sums = jax.lax.fori_loop(0, updates, step, (_changing(state), sums))
        means = jax.tree.map(lambda total: total / jnp.maximum(updates, 1), sums)
    means = {name: jnp.where(updates > 0, x, jnp.nan) for name, x in means.items()}
    return state._replace(**changed), means | {"updates": updates.astype(jnp.float32)}


def _changing(state: FinetuneState) -> dict[str, PyTree]:
    """What an update changes of a state: all but what is large."""
    return {name: getattr(state, name) for name in ("learner", "models", "transform")}


def unlearned(
    policy: Policy,
    start: Callable[[PyTree, Key], tuple[PyTree, PyTree]],
    export: Callable[[FinetuneState], PyTree],
) -> Parts:
    """Parts of a method whose policy never learns: it acts as what is exported, whatever else adapts."""

    def act(
        state: FinetuneState, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array
    ) -> tuple[Array, PyTree]:
        return policy.act(export(state), carry, obs, key, explore=explore)

    nothing = Learner(lambda key: (), policy.init_carry, act, lambda state, batch, key: (state, {}))
    return Parts(nothing, start, export, policy, act=act)


# --- SAC --------------------------------------------------------------------------------------------------------------


def sac_finetuner(
    options: ActorOptions,
    prior: Prior | None,
    task: Task,
    *,
    transforms: tuple[Transform, ...] = (),
    horizon_dim: int = 0,
    value_baseline: bool = False,
    source: Callable[[FinetuneState], Source] | None = None,
    simulation: Simulation | None = None,
) -> Finetuner:
    """Fine-tuning whose learner is SAC, in networks and with numbers that the options tell.

    transforms: of every batch. horizon_dim: entries of the context that tell steps to go (`shorten`), 0 = none.
    value_baseline: a kept critic under shaped rewards is read as Q(s, a) - V_sim(s), its exact meaning in simulation.
    source: of batches, default real rows alone.
    """
    card = rules.card_of(prior)
    network, fresh = network_of(card), options.fresh or prior is None
    identifies = options.identify and prior is not None
    if identifies:  # compares with simulated rows
        simulation = simulation or Simulation(20_000, 0.6)
    kept = not (fresh or options.reset_critic)  # the critic
    config = sac.SACConfig.chosen(
        options,
        obs_dim=task.obs_dim,
        act_dim=task.act_dim,
        network=network,
        context_dim=horizon_dim if horizon_dim > 1 else 0,
        critic_baseline=value_baseline and kept,
        anchored=options.anchor > 0 and prior is not None,
        policy_delay=rules.policy_delay(options),
    )
    hyper = sac.SACHyper.chosen(
        options,
        actor_start=rules.critic_warmup(options, task),
        lr_warmup=rules.warmup(options, options.lr_warmup) if kept else 0,  # a new critic has nothing to lose
        anchor=options.anchor if config.anchored else 0.0,
    )
    learner = sac.make_sac(config, hyper)
    models = dynamics_models(options, network, task) if options.train_dynamics else None
    whole = steps_to_go(jnp.int32(horizon_dim), horizon_dim) if config.context_dim else None

    def start(params: sac.SACParams | None, key: Key) -> tuple[PyTree, PyTree]:
        if params is None:
            state = learner.init(key)
            return state, sac.SACParams(None, None, None, None, state.normalizer)
        simulated_models = None if models else params.dynamics  # else they are in training
        frozen = sac.SACParams(None, None, params.value, simulated_models, params.normalizer)
        if fresh:
            return learner.init(key).replace(normalizer=params.normalizer), frozen
        return sac.state_from_prior(config, hyper, params, key, reset_critic=options.reset_critic), frozen

    def export(state: FinetuneState) -> sac.SACParams:
        actor = state.learner.actor.params
        twin = jax.tree.map(lambda x: x[:2], state.learner.critic.params)
        if whole is not None:
            actor, twin = (fix_first_layer(x, task.obs_dim, whole) for x in (actor, twin))
        return state.frozen._replace(actor=actor, critic=twin, dynamics=_ensemble(state))

    parts = Parts(
        learner=learner._replace(act=partial(learner.act, context=whole)),
        start=start,
        export=export,
        policy=sac_policy(task.obs_dim, task.act_dim, network),
        source=source,
        offline=sources.simulated_rows(options.batch_size) if simulation else None,
        transform=compose(*transforms),
        imagine=_imagine(learner, network, card["gamma"], task) if transforms else lambda state, key: None,
        models=models,
        interface=command_interface(network, task) if identifies else None,
        beginner=simulator_actor if fresh and prior is not None else None,
        simulation=simulation,
        card={"critic_network": config.critic_network and jsonable(config.critic_network)},
    )
    return assemble(parts, options, task)


def simulator_actor(params: sac.SACParams, fresh: sac.SACParams) -> sac.SACParams:
    """The simulator's policy in the form that an agent with new networks exports."""
    return fresh._replace(actor=params.actor)


def mixed_rows(options: MixedOptions, prior: Prior | None) -> tuple[Source, Simulation | None]:
    """Batches of which the options' share is simulated, and what they are drawn from; all real without a prior."""
    n_sim = round(options.simulated_share * options.batch_size) if prior is not None else 0
    simulation = Simulation(options.simulated_transitions, options.simulated_ladder) if n_sim else None
    return sources.mixture(options.batch_size - n_sim, n_sim), simulation


def _ensemble(state: FinetuneState) -> PyTree:
    """The dynamics models as they are now, in training or the prior's."""
    return state.frozen.dynamics if state.models is None else state.models.params


def dynamics_models(options: Any, network: NetworkConfig, task: Task) -> Models:
    """The dynamics ensemble of a prior, in training on real rows.

    options: with lr_dynamics, dynamics_warmup and max_grad_norm.
    """
    model = make_dynamics(task.obs_dim, task.act_dim, network)
    optimiser = optim.adam(options.max_grad_norm)
    rise = rules.warmup(options, options.dynamics_warmup)

    def update(fit: optim.Fit, normalizer: Normalizer, batch: Batch, key: Key) -> tuple[optim.Fit, Metrics]:
        rate = options.lr_dynamics * optim.warmup_factor(optim.steps_of(fit), rise)
        return dynamics.update(model, optimiser, fit, normalizer, batch, key, rate=rate)

    return Models(lambda params: optim.start(optimiser, params.dynamics), update)


def _imagine(
    learner: Learner, network: NetworkConfig, gamma: float, task: Task
) -> Callable[[FinetuneState, Key], Imagination]:
    value_net = value.make_v_sim(task.obs_dim, network)
    model = make_dynamics(task.obs_dim, task.act_dim, network)

    def imagine(state: FinetuneState, key: Key) -> Imagination:
        frozen, act = state.frozen, partial(learner.act, state.learner, learner.init_carry(), explore=True)
        # One member for the whole batch, redrawn at each update: the same expected gradient as one per row, at a
        # fraction of the cost, and no rollout mixes two models.
        member = dynamics.draw_member(_ensemble(state), key)
        return Imagination(
            value=lambda obs: value.predict(value_net, frozen.value, frozen.normalizer, obs),
            policy=lambda obs, context, key: act(obs, key, context=context)[0],
            dynamics=lambda obs, action, key: dynamics.predict(model, member, frozen.normalizer, obs, action)[0],
            reward=_needed(task.reward, "reward"),
            terminated=_needed(task.terminated, "terminated"),
            gamma=gamma,
        )

    return imagine


def _needed(function: Callable[..., Array] | None, name: str) -> Callable[..., Array]:
    """The task's function; where it has none, one that refuses to be asked."""

    def missing(*transition: Array) -> Array:
        del transition
        raise UserError(f"methods that imagine need a task with `{name}` as a function of observations")

    return missing if function is None else function
