"""A real system of your own: what can be said in numbers is own_gap.toml; what moves and measures is a class."""

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
import sgft_jax
from sgft_jax.io.priors import load_prior


class PretendedRobot:
    """A gap in the place of hardware. Write the same two methods for your driver; rehearse the loop with this one."""

    def __init__(self, env: envs.Env, gap: envs.Gap) -> None:
        self.worlds, self.key = envs.gaps.worlds(env, gap, jax.random.key(0), 64), jax.random.key(1)
        self.fresh, self.next = jax.jit(env.reset), jax.jit(env.step)

    def reset(self) -> np.ndarray:
        """Brings everything back to a start; returns the observation [obs_dim] there, in units of env.observation."""
        self.key, key_world, key = jax.random.split(self.key, 3)
        index = jax.random.randint(key_world, (), 0, 64)
        self.world = envs.rollout.pick(self.worlds, index)
        self.state = self.fresh(self.world, key)
        return np.asarray(self.state.obs)

    def step(self, action: np.ndarray) -> np.ndarray:
        """Commands action [act_dim] in [-1, 1] for env.control_dt seconds; returns the observation [obs_dim] then."""
        self.key, key = jax.random.split(self.key)
        self.state = self.next(self.world, self.state, jnp.asarray(action), key)
        return np.asarray(self.state.obs)


class Stepped:
    """A `System` of one robot: episodes from `reset` and `step`, judged by the task's functions of observations."""

    def __init__(self, env: envs.Env, robot: Any, gamma: float) -> None:
        self.env, self.robot, self.gamma = env, robot, gamma

    def play(self, policy: Any, states: Any, keys: jax.Array, *, explore: bool) -> envs.Episode:
        """One episode [1, 1]; see `System`."""
        env, act = self.env, jax.jit(policy.act)
        state = jax.tree.map(lambda x: x[0], states)
        obs, carry, rows, over = self.robot.reset(), policy.init_carry(), [], False
        while not over and len(rows) < env.episode_length:
            key = jax.random.fold_in(keys[0, 0], len(rows))
            action, carry = act(state, carry, obs, key, explore=jnp.bool_(explore))
            after = self.robot.step(np.asarray(action))
            over = bool(env.terminated(obs, action, after))
            # A time limit is no termination. Put the row on disk here, before anything learns from it.
            discount = 0.0 if over else self.gamma
            rows.append(sgft_jax.Transition(obs, action, env.reward(obs, action, after), discount, after))
            obs = after
        valid = jnp.arange(env.episode_length) < len(rows)
        rows += [jax.tree.map(jnp.zeros_like, rows[0])] * (env.episode_length - len(rows))
        stacked = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(y, jnp.float32) for y in x])[None, None], *rows)
        total, success, no = stacked.reward.sum(-1), jnp.bool_(env.success(obs))[None, None], jnp.zeros((1, 1), bool)
        print(f"return {total[0, 0]:.2f}, success {success[0, 0]}")
        score = success.astype(jnp.float32)
        return envs.Episode(stacked, valid[None, None], total, success, no, score, no.astype(int), jnp.zeros((1, 1, 0)))


def finetune(env: envs.Env, robot: Any, prior: sgft_jax.Prior, *, rollouts: int = 20, **options: Any) -> Any:
    """SGFT-SAC on a robot: act, keep what happened, learn, again. Returns the best policy's parameters."""
    method = sgft_jax.get_method("sgft-sac")
    tuner = method.build(method.config(**options), prior, env)
    system, one = Stepped(env, robot, prior.card["gamma"]), jax.tree.map(lambda x: x[None], prior.params)
    for progress, _ in sgft_jax.finetune(tuner, system, one, jnp.zeros(1, jnp.uint32), rollouts=rollouts):
        params = jax.tree.map(lambda x: np.array(x[0]), progress.best.params)
    return params


if __name__ == "__main__":  # its argument is the folder of a prior
    env = envs.make(str(Path(__file__).with_name("own_task.py")))
    gap = envs.gaps.load(env, str(Path(__file__).with_name("own_gap.toml")))
    finetune(env, PretendedRobot(env, gap), load_prior(Path(sys.argv[1]), task=env.name))
