"""System identification: fits what varies in simulation to the real rollouts, and tells it to a policy that knows it.

No network learns. The prior's dynamics models are told the system too, so they say how likely real steps are in each;
or the simulator does, replaying them.
"""

from dataclasses import dataclass
from functools import partial
from typing import Literal

from envs.types import Array, Key, PyTree, UserError
from sgft_jax import checks
from sgft_jax.train.options import LoopOptions
from sgft_jax.types import Batch, Finetuner, Method, Metrics, Online, Prior, SimulatedData, Simulation, Task

_ROWS, _FEW = 320, 80  # what `rows` is if it is left open; DROPO takes two trajectories, and so does the slow simulator
_SIMULATED = 2048  # rows that tell how far the models are off in simulation


@dataclass(frozen=True)
class Config(checks.Checked):
    """Options of `sysid`."""

    fit: Literal["map", "dropo"] = "map"
    """map: the most probable system. dropo: the mean of a distribution over systems (Tiboni et al. 2023)."""
    through: Literal["models", "simulator"] = "models"
    """What is asked about real steps: the prior's dynamics models, or the simulator, set to what was measured before
    each step. The simulator is right about itself and slower."""
    rows: checks.Count | None = None
    """Real transitions that are fitted, the first ones; None = 320 for map through models, else 80."""
    initial_rollouts: checks.Count = 1
    """Real rollouts before the first fit."""
    guard: bool = False
    """Deploy a fit only while its real rollouts say that it is better than the policy that knows nothing of the system,
    or than the best fit since (sgft_jax/train/guard.py)."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner; a prior that is told nothing has nothing to fit and acts as it is."""
    import jax
    import jax.numpy as jnp

    from sgft_jax.learners.sac import SACParams
    from sgft_jax.models import dynamics, system
    from sgft_jax.models.config import network_of
    from sgft_jax.models.networks import make_dynamics
    from sgft_jax.models.robust import spread_of
    from sgft_jax.policies import sac_policy
    from sgft_jax.train.finetuner import FinetuneState, assemble, unlearned
    from sgft_jax.train.options import card_of

    card = card_of(prior)
    network, varying = network_of(card), card.get("system", [])
    loop = LoopOptions(initial_rollouts=config.initial_rollouts, guard=config.guard)
    few = config.fit == "dropo" or config.through == "simulator"
    rows_fitted = min(config.rows or (_FEW if few else _ROWS), loop.replay_capacity)
    model = make_dynamics(task.obs_dim, task.act_dim, network)
    asked = None
    if config.through == "simulator":
        if task.simulator is None:
            raise UserError("--options.through simulator: this task cannot be set to what was measured; use models")
        asked = task.simulator()

    def change(params: SACParams, obs: Array, action: Array) -> Array:
        if asked is not None:
            return asked(obs, action)
        after = dynamics.predict(model, params.dynamics, params.normalizer, obs, action).mean(axis=0)
        return (after - obs)[: task.measured_dim]

    def start(params: SACParams, key: Key) -> tuple[PyTree, PyTree]:
        del key
        return (jnp.zeros(task.measured_dim), system.unknown(len(varying))), params

    def prepare(state: FinetuneState, simulated: SimulatedData) -> FinetuneState:
        """Measures how far the models are off."""
        rows = simulated.draw(jax.random.key(0), _SIMULATED)
        after = (rows.next_obs - rows.obs)[:, : task.measured_dim]
        missed = after - jax.vmap(lambda row: change(state.frozen, row.obs, row.action))(rows)
        spread = spread_of(missed, after, jnp.ones(_SIMULATED, bool))
        return state._replace(learner=(spread, state.learner[1]))

    def observed(state: FinetuneState) -> FinetuneState:
        if not varying:
            return state
        spread, _ = state.learner
        held = jnp.arange(rows_fitted) < state.replay.size
        data = jax.tree.map(lambda x: x[:rows_fitted], state.replay.data)
        fit = system.dropo if config.fit == "dropo" else system.most_probable_system
        fitted = fit(partial(change, state.frozen), data, held, spread, len(varying))
        return state._replace(learner=(spread, fitted))

    def export(state: FinetuneState) -> SACParams:
        return state.frozen._replace(system=state.learner[1].mean) if varying else state.frozen

    def report(learner: PyTree, batch: Batch, key: Key) -> tuple[PyTree, Metrics]:
        """Learns nothing; its metrics are the fitted system, in raw units."""
        del batch, key
        metrics = {}
        for v, mean in zip(varying, learner[1].mean, strict=True):
            metrics[f"system/{v['name']}_{v['index']}"] = v["low"] + 0.5 * (1.0 + mean) * (v["high"] - v["low"])
        return learner, metrics

    parts = unlearned(sac_policy(task.obs_dim, task.act_dim, network), start, export)
    parts = parts._replace(
        learner=parts.learner._replace(update=report),
        prepare=prepare,
        observed=observed,
        simulation=Simulation(20_000, 0.6),
    )
    # One update after a rollout says what was fitted; more would say it again.
    return assemble(parts, loop, task)._replace(updates_per_rollout=1)


_ABOUT = "fits parameters and effects, and tells them to a policy that knows them"
METHOD = Method("sysid", Online("model-based", _ABOUT, "DROPO (Tiboni 2023)", Config, build, sees_system=True))
