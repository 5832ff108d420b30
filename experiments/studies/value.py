"""How good is a V_sim that is fitted anew to shipped priors? In states off their path, against what can be known.

Goals, in the simulator: told the system V explains 95 % of the variance of returns; V(obs) 95 % of what 16 worlds with
the same observation leave to explain; bias within 2 % of the returns' range; rank correlation 95 % of its ceiling.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs.base import Env
from envs.domains import sample_worlds, with_actuators
from envs.mujoco.worlds import choose_impl
from envs.observations import all_varying, blurred
from envs.types import UserError
from experiments.runner import cli
from experiments.runner.cli import Json
from experiments.runner.options import Impl, Out
from experiments.runner.progress import doing
from experiments.runner.report import make_judges, value_numbers
from sgft_jax.algorithms import make_policy
from sgft_jax.analysis import tables
from sgft_jax.io.log import write_summary
from sgft_jax.io.priors import load_prior, save_prior, variant
from sgft_jax.models.config import network_of
from sgft_jax.presets import PRESETS, PretrainConfig
from sgft_jax.stacking import stack
from sgft_jax.train import pretraining
from sgft_jax.train.value_fit import WORLDS
from sgft_jax.types import Prior

_SHOWN = {
    "prior": "prior",
    "seconds": "seconds",
    "value/system_explained_variance": "V(obs, system) explains",
    "value/system_explainable_variance": "of",
    "value/off_path_explained_variance": "V(obs) explains",
    "value/explainable_variance": "of ",
    "value/system_bias_of_range": "bias / range, told",
    "value/off_path_bias_of_range": "bias / range",
    "value/system_rank_correlation": "rank correlation, told",
    "value/off_path_rank_correlation": "rank correlation",
    "value/rank_ceiling": "its ceiling",
    "before": "V(obs) explained before",
}


@dataclass(frozen=True)
class ValueArgs:
    """One study of V_sim."""

    priors: tuple[str, ...] = ("shipped:push/seed-0", "shipped:insert/seed-0", "shipped:hammer/seed-0")
    """Priors of SAC; their policies stay as they are."""
    episodes: int | None = None
    """Simulated episodes of a fit; default that of the prior's preset."""
    updates: int | None = None
    """Gradient steps of a fit; default likewise."""
    sparse: bool = False
    """Fit V_sim to success alone; tasks pay that to whoever takes the saved prior. Its critic stays."""
    held: int = 1024
    """Fresh episodes, each with one state where the policy takes over."""
    states: int = 256
    """Of these states, those that are played again in 16 worlds."""
    save: bool = False
    """Save the priors with their new V_sim, in <out>/value/<task>."""
    seed: int = 0
    """Another seed draws other worlds and episodes."""
    impl: Impl = "auto"
    json: Json = False
    out: Out = Path("runs")


def main(args: ValueArgs) -> None:
    """Measures, prints a table, and leaves `value/summary.json`."""
    priors = [load_prior(name) for name in args.priors]
    folder = args.out / "value"
    homes = [folder / prior.card["task"] / Path(name).name for name, prior in zip(args.priors, priors, strict=True)]
    if args.save and len(set(homes)) < len(homes):
        raise UserError(f"--save: {folder} would hold two priors in one folder; study them in --out of their own")
    lines = [_line(args, *row) for row in zip(args.priors, priors, homes, strict=True)]
    folder.mkdir(parents=True, exist_ok=True)
    write_summary(folder, {"lines": lines})
    print(json.dumps(lines) if args.json else _table(lines))
    for home in homes if args.save and not args.json else ():
        print(f"prior: {home}")


def _line(args: ValueArgs, name: str, prior: Prior, home: Path) -> dict[str, Any]:
    """The numbers of one prior, whose new V_sim goes home if asked for; seconds of its fit, compiled."""
    config, env = _config(args, prior), _env(args, prior)
    key_held, key_again, key_worlds = jax.random.split(jax.random.fold_in(jax.random.key(2**31 + 3), args.seed), 3)
    # On two cores of a CPU the updates take most of the time.
    about = 30 + 0.1 * config.value_updates if jax.default_backend() == "cpu" else 60
    with doing(f"fitting V_sim of {name}", about, once=True):
        program, inputs = pretraining.value_fit_of(env, config, [prior], seed=args.seed)
        fit = program.lower(*inputs).compile()
        begun = time.perf_counter()
        values = jax.block_until_ready(fit(*inputs))
        seconds = time.perf_counter() - begun
        (new,) = pretraining.with_values(env, [prior], values)
    system, policy = all_varying(env), make_policy(new.card, env)
    value_of = policy.value
    assert value_of is not None  # as priors of SAC have it
    judges = make_judges(env, system, policy, config.gamma, episodes=args.held, members=1)
    pool, params = sample_worlds(env, key_worlds, WORLDS), stack([new.params])
    with doing("measuring it", 60, once=True):
        held = jax.tree.map(lambda x: np.asarray(x)[0], judges.hold(stack([pool]), params, key_held[None]))
        judged = value_numbers(judges, env, held, pool, new.params, key_again, args.states)
        old = jax.vmap(lambda obs: value_of(prior.params, obs))(jnp.asarray(held.obs))
    missed = held.returns - np.asarray(old)
    if args.save:
        save_prior(home, Prior(new.params, {**new.card, "metrics": judged}))
    before = float(1 - np.var(missed) / np.var(held.returns)) if prior.params.value is not None else None
    return {"prior": name, "seconds": seconds, "before": before, **judged}


def _config(args: ValueArgs, prior: Prior) -> PretrainConfig:
    """The settings of the prior's preset, with its own networks."""
    card = prior.card
    config = PRESETS.get(card.get("preset", ""), PretrainConfig())
    chosen = {"value_episodes": args.episodes, "value_updates": args.updates}
    numbers = {name: x for name, x in chosen.items() if x is not None}
    return replace(config, gamma=card["gamma"], network=network_of(card), **numbers)


def _env(args: ValueArgs, prior: Prior) -> Env:
    """The training domain of the prior."""
    config = prior.card.get("config", {})
    rewards = {"sparse": args.sparse or prior.card.get("sparse", False)}
    env = envs.make(prior.card["task"], choose_impl(args.impl), **{**variant(prior.card), **rewards})
    env = with_actuators(env) if config.get("actuators") else env
    return blurred(env, config["system_noise"]) if config.get("sees_system") else env


def _table(lines: Sequence[dict[str, Any]]) -> str:
    def cell(x: Any) -> str:
        return f"{x:.3f}" if isinstance(x, float) else "" if x is None else str(x)

    return tables.markdown(list(_SHOWN.values()), [[cell(line.get(name)) for name in _SHOWN] for line in lines])


if __name__ == "__main__":
    cli.run_main(main, ValueArgs, __doc__ or "")
