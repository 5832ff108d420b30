"""A method of your own: SGFT-SAC whose shaped rewards are bent, not clipped: the larger one stays the larger.

Commands read this file before they start JAX, so JAX is imported where it is used.
"""

from dataclasses import dataclass

from sgft_jax.methods import sgft_sac
from sgft_jax.types import Finetuner, Method, Online, Prior, Task, Transform


@dataclass(frozen=True)
class Config(sgft_sac.Config):
    """Options of `sgft-bent`: those of SGFT-SAC with their defaults, but for what is written here."""

    clip_shaped: float | None = 2.0
    """Bound that the shaped reward approaches; None = no bound."""


def bend(bound: float) -> Transform:
    """Rewards become bound * tanh(reward / bound): unchanged where they are small, never larger than the bound."""
    import jax.numpy as jnp

    from sgft_jax import stateless

    return stateless(lambda imagination, batch, key: batch._replace(reward=bound * jnp.tanh(batch.reward / bound)))


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """What happens to every sampled batch, in order, and which learner gets it."""
    from sgft_jax import branch, sac_finetuner, shape, shorten

    bent = () if config.clip_shaped is None else (bend(config.clip_shaped),)
    imagined = branch(config.horizon, config.branches, noise=config.branch_noise)
    transforms = (imagined, shape, *bent, shorten(config.horizon))
    return sac_finetuner(config, prior, task, transforms=transforms, horizon_dim=config.horizon, value_baseline=True)


METHOD = Method(  # what `--method docs/examples/own_method.py` looks for
    "sgft-bent", Online("sgft", "SGFT-SAC with bent instead of clipped rewards", "docs/extending.md", Config, build)
)


def main() -> None:
    """Twenty updates on random data of a point on a line, without any command: the library alone."""
    from dataclasses import asdict
    from types import SimpleNamespace

    import jax
    import jax.numpy as jnp

    import sgft_jax
    from sgft_jax.learners import sac

    network = sgft_jax.NetworkConfig(hidden=(16,))
    agent = sac.make_sac(sac.SACConfig(1, 1, network=network))
    params = sac.extract_params(jax.jit(agent.init)(jax.random.key(0)))
    prior = Prior(params, {"algorithm": "sac", "network": {**asdict(network), "hidden": [16]}, "gamma": 0.9})
    line = SimpleNamespace(
        obs_dim=1,
        act_dim=1,
        previous_actions=0,
        episode_length=32,
        reward=lambda obs, action, next_obs: -jnp.abs(next_obs[0]),
        terminated=lambda obs, action, next_obs: jnp.bool_(False),
    )
    tuner = METHOD.online.build(Config(batch_size=16, replay_capacity=64), prior, line)
    obs, action = jax.random.uniform(jax.random.key(1), (2, 32, 1), minval=-1)
    next_obs = obs + 0.1 * action
    rows = sgft_jax.Transition(obs, action, -jnp.abs(next_obs[:, 0]), jnp.full(32, 0.9), next_obs)
    state = tuner.observe(tuner.init(params, jax.random.key(2)), rows, jnp.ones(32, bool), jnp.float32(0))
    state, metrics = jax.jit(tuner.learn, static_argnums=2)(state, jax.random.key(3), 20)
    print(f"mean shaped reward {metrics['batch/reward_mean']:.3f}, critic loss {metrics['critic/loss']:.3f}")


if __name__ == "__main__":
    main()
