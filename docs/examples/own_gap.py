"""A real system of your own: what can be said in numbers is own_gap.toml; what moves and measures is a class."""

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from sgft_jax import NetworkConfig, Prior, Transition, finetune_config, get_method, make_finetuner
from sgft_jax.io import checkpoint
from sgft_jax.io.config import config_from_json


class PretendedRobot:
    """A gap in the place of hardware. Write the same two methods for your driver; rehearse the loop with this one."""

    def __init__(self, env: envs.Env, gap: envs.Gap) -> None:
        self.world = jax.tree.map(lambda x: x[0], envs.gaps.worlds(env, gap, jax.random.key(0), 1))
        self.fresh, self.next, self.key = jax.jit(env.reset), jax.jit(env.step), jax.random.key(1)

    def reset(self) -> np.ndarray:
        """Brings everything back to a start; returns the observation [obs_dim] there, in units of env.observation."""
        self.key, key = jax.random.split(self.key)
        self.state = self.fresh(self.world, key)
        return np.asarray(self.state.obs)

    def step(self, action: np.ndarray) -> np.ndarray:
        """Commands action [act_dim] in [-1, 1] for env.control_dt seconds; returns the observation [obs_dim] then."""
        self.key, key = jax.random.split(self.key)
        self.state = self.next(self.world, self.state, jnp.asarray(action), key)
        return np.asarray(self.state.obs)


def finetune(env: envs.Env, robot: Any, prior: Prior, card: dict, *, rollouts: int = 20, updates: int = 120) -> Prior:
    """SGFT-SAC on a robot: act, keep what happened, learn, again. Returns the new policy in the form of a prior."""
    method, network = get_method("sgft-sac"), config_from_json(NetworkConfig, card["network"])
    config = finetune_config(method, network=network, gamma=card["gamma"], critic_warmup=5 * updates)
    task = {"obs_dim": env.obs_dim, "act_dim": env.act_dim, "reward": env.reward, "terminated": env.terminated}
    tuner = make_finetuner(method, config, **task)
    act, learn, state = (
        jax.jit(tuner.act),
        jax.jit(tuner.learn, static_argnums=2),
        jax.jit(tuner.init)(prior, jax.random.key(0)),
    )
    for n in range(rollouts):
        key_learn, *keys = jax.random.split(jax.random.key(n), 1 + env.episode_length)
        rows, obs, carry = [], robot.reset(), tuner.init_carry()
        for t, key in enumerate(keys, start=1):
            action, carry = act(state, carry, obs, key, explore=True)
            after = robot.step(np.asarray(action))
            step = (jnp.asarray(obs), action, jnp.asarray(after))
            discount = card["gamma"] * (1.0 - env.terminated(*step))  # a time limit is no termination
            row = Transition(*step[:2], env.reward(*step), discount, step[2], np.bool_(t == len(keys)), np.int32(0))
            rows, obs = [*rows, row], after
        episode = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)  # [T, ...]; put it on disk first
        state, _ = learn(tuner.observe(state, episode, jnp.ones(len(rows), bool)), key_learn, updates)
        print(f"rollout {n + 1}: return {episode.reward.sum():.2f}, success {bool(env.success(obs))}")
    return tuner.export(state)


if __name__ == "__main__":  # its argument is the folder of a prior
    env = envs.make(str(Path(__file__).with_name("own_task.py")))
    gap = envs.gaps.load(env, str(Path(__file__).with_name("own_gap.toml")))
    prior, card = checkpoint.load_prior(Path(sys.argv[1]), task=env.name, obs_dim=env.obs_dim, act_dim=env.act_dim)
    finetune(env, PretendedRobot(env, gap), prior, card)
