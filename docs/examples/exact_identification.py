"""How far would the identification of `guarded` carry, with nothing learned, if it were exact?

    python docs/examples/exact_identification.py push-2-00 insert-2-00      # test gaps; default: the ones named below

The prior in sgft_jax/priors plays every gap three times: as it is; told exactly what the gap makes of its commands; and
told its constant sensor errors too. Printed is the success of 200 episodes with its 95 % Wilson interval. Commands
stay in [-1, 1], so what the real robot cannot do remains. With folders of priors after `--priors`, these play instead.
"""

import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import envs
import sgft_jax
from envs.base import Env
from envs.gaps import Gap
from sgft_jax.analysis import tables
from sgft_jax.math.stats import success_interval
from sgft_jax.models.distortion import Distortion, turned_and_scaled

GAPS = ("push-2-00", "insert-2-00", "hammer-2-14", "hammer-2-19", "hammer-2-28")  # where `guarded` ends below 90 %
EPISODES = 200


def main(names: list[str], folders: list[str]) -> None:
    """Prints a line for each gap and prior."""
    for name in names or GAPS:
        task = name.partition("-")[0]
        for folder in folders or [f"shipped:{task}/seed-0"]:
            prior = sgft_jax.load_prior(folder)
            env = sgft_jax.make_env(prior)
            gap = envs.gaps.load(env, f"envs/gaps/test/{task}.toml:{name}")
            commands, both = exact(env, gap)
            known = {"as it is": None, "commands": commands, "commands and sensors": both}
            results = [f"{what} {played(prior, env, gap, distortion)}" for what, distortion in known.items()]
            print(f"{name}, {Path(folder).name}: {', '.join(results)}")


def exact(env: Env, gap: Gap) -> tuple[Distortion, Distortion]:
    """What a gap without varying effects makes of commands, and of commands and measurements."""
    effects = jax.tree.map(lambda x: x[0], envs.gaps.worlds(env, gap, jax.random.key(0), 1).theta.effects.low)
    scale = jnp.broadcast_to(effects.action_scale, env.act_dim)
    bias = jnp.broadcast_to(effects.action_bias, env.act_dim)
    offset = jnp.broadcast_to(effects.obs_bias, env.measured_dim)
    both = turned_and_scaled(effects.action_rotation, jnp.log(scale), bias, offset)
    return both._replace(offset=jnp.zeros(env.measured_dim)), both


def played(prior: sgft_jax.Prior, env: Env, gap: Gap, distortion: Distortion | None) -> str:
    """Success of the policy that knows the distortion, in per cent."""
    corrected = replace(prior, params=prior.params._replace(distortion=distortion))
    success = np.asarray(sgft_jax.evaluate_prior(corrected, env, gap, episodes=EPISODES).success)
    return tables.number(success_interval(int(success.sum()), len(success)))


if __name__ == "__main__":
    words = sys.argv[1:]
    at = words.index("--priors") if "--priors" in words else len(words)
    main(words[:at], words[at + 1 :])
