"""A method of your own: SGFT-SAC whose shaped rewards are bent, not clipped: the larger one stays the larger."""

import jax
import jax.numpy as jnp

import sgft_jax
from sgft_jax import BatchTransform, Imagination, Transition, branch, shape, shorten
from sgft_jax.types import Array, Key

BOUND = 2.0  # of |r_bar|


def bend(bound: float) -> BatchTransform:
    """Rewards [B] to bound * tanh(reward / bound): unchanged where they are small, never larger than the bound."""

    def transform(imagination: Imagination, batch: Transition, key: Key) -> Transition:
        del imagination, key  # what V_sim, the models and the policy say, and chance: not needed here
        return batch._replace(reward=bound * jnp.tanh(batch.reward / bound))

    return transform


def transforms(horizon: int, branches: int, noise: float | Array) -> tuple[BatchTransform, ...]:
    """What happens to every sampled batch, in order. `horizon`, `branches` and `noise` are options of fine-tuning."""
    return branch(horizon, branches, noise=noise), shape, bend(BOUND), shorten(horizon)


METHOD = sgft_jax.get_method("sgft-sac")._replace(  # what `--method docs/examples/own_method.py` looks for
    name="sgft-bent",
    description="SGFT-SAC with shaped rewards that are bent instead of clipped",
    source="docs/extending.md",
    transforms=transforms,
    options={"clip_shaped": None},  # its own defaults of `FinetuneConfig`
)


def main() -> None:
    """Twenty updates on random data of a point on a line, without any command: the library alone."""
    network = sgft_jax.NetworkConfig(hidden=(16,))
    agent = sgft_jax.make_sac(sgft_jax.SACConfig(1, 1, network=network))
    prior = sgft_jax.extract_prior(jax.jit(agent.init)(jax.random.key(0)))
    config = sgft_jax.finetune_config(METHOD, network=network, batch_size=16, replay_capacity=64, critic_warmup=0)
    tuner = sgft_jax.make_finetuner(
        METHOD, config, obs_dim=1, act_dim=1,
        reward=lambda obs, action, next_obs: -jnp.abs(next_obs[0]),
        terminated=lambda obs, action, next_obs: jnp.bool_(False),
    )  # fmt: skip
    obs, action = jax.random.uniform(jax.random.key(1), (2, 32, 1), minval=-1)
    zero, next_obs = jnp.zeros(32), obs + 0.1 * action
    rows = Transition(obs, action, -jnp.abs(next_obs[:, 0]), zero + 0.9, next_obs, zero > 0, zero.astype(jnp.int32))
    state = tuner.observe(jax.jit(tuner.init)(prior, jax.random.key(2)), rows, jnp.ones(32, bool))
    state, metrics = jax.jit(tuner.learn, static_argnums=2)(state, jax.random.key(3), 20)
    print(f"mean shaped reward {metrics['batch/reward_mean']:.3f}, critic loss {metrics['critic/loss']:.3f}")


if __name__ == "__main__":
    main()
