"""What a critic believes of actions, and what they return, while SAC learns where nothing is to be learned.

    python docs/examples/critic_against_returns.py                   # eight updates per real transition
    python docs/examples/critic_against_returns.py lr_critic=1e-12   # the simulator's critic stays as it is

The real system is the simulator of push, the prior the one in sgft_jax/priors/push. After 0, 1, 2, 4, 8 and 16 rollouts
the policy begins 256 episodes from the same starts twice: with its own first action, and with a uniformly random one.
Printed, as means over starts and three seeds: Q of both first actions, what they returned on average, and the share of
starts in which the critic prefers the random action. Returns are discounted, and their episodes are twice as long as
the task's, so that little is cut off.
"""

import sys
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
import sgft_jax
from envs.rollout import play_episode
from envs.types import Array, Key, PyTree
from sgft_jax.models import normalizer
from sgft_jax.models.config import network_of
from sgft_jax.models.networks import Network, make_critic

STARTS, ROLLOUTS, SEEDS = 256, (0, 1, 2, 4, 8, 16), 3
HEAD = ("rollouts", "Q of its action", "return", "Q of a random one", "return", "random preferred")


def main(options: Mapping[str, float]) -> None:
    """Prints a line for each number of rollouts. options: of the method `sac`."""
    prior = sgft_jax.load_prior("shipped:push/seed-0")
    env = sgft_jax.make_env(prior)
    setup = sgft_jax.setup(env, envs.gaps.load(env, "sim"), prior, method="sac", seeds=SEEDS, **{"utd": 8.0, **options})
    look = jax.jit(partial(compare, setup, prior.card))
    print("  ".join(HEAD))
    for state, _ in sgft_jax.finetune(*setup, rollouts=ROLLOUTS[-1]):
        if (done := int(state.rollouts)) in ROLLOUTS:
            numbers = np.asarray(look(state.agent)).mean(0)
            print("  ".join(f"{x:{len(name)}.2f}" for name, x in zip(HEAD, (done, *numbers), strict=True)), flush=True)


def compare(setup: sgft_jax.Setup, card: Mapping[str, Any], agents: PyTree) -> Array:
    """[M, 5] the numbers of a line for agents [M]. card: of the prior."""
    critic = make_critic(card["obs_dim"], card["act_dim"], network_of(card))
    keys = jax.random.split(jax.random.key(0), STARTS)

    def one(agent: PyTree) -> Array:
        policy, chance = (
            jax.vmap(partial(first_step, setup, card["gamma"], agent, random=random))(keys) for random in (False, True)
        )
        q_policy, q_chance = (
            jax.vmap(partial(value, critic, agent.learner))(obs, action) for obs, action, _ in (policy, chance)
        )
        return jnp.stack(
            [q_policy.mean(), policy[2].mean(), q_chance.mean(), chance[2].mean(), (q_chance > q_policy).mean()]
        )

    return jax.lax.map(one, agents)


def first_step(
    setup: sgft_jax.Setup, gamma: float, agent: PyTree, key: Key, *, random: bool
) -> tuple[Array, Array, Array]:
    """The first observation and action of an episode, and its discounted return []."""
    finetuner, system = setup.finetuner, setup.system

    def act(carry: PyTree, obs: Array, key: Key) -> tuple[Array, PyTree]:
        first, inner = carry
        action, inner = finetuner.act(agent, inner, obs, key, explore=True)
        chance = jax.random.uniform(jax.random.fold_in(key, 1), action.shape, minval=-1.0)
        return jnp.where(first & random, chance, action), (jnp.zeros((), bool), inner)

    start = (jnp.ones((), bool), finetuner.init_carry())
    length = 2 * system.env.episode_length
    rows = play_episode(
        system.env, system.pools, act, start, key, gamma=gamma, length=length, which=jnp.int32(0)
    ).transitions
    weights = jnp.cumprod(jnp.concatenate([jnp.ones(1), rows.discount[:-1]]))
    return rows.obs[0], rows.action[0], weights @ rows.reward


def value(critic: Network, learner: Any, obs: Array, action: Array) -> Array:
    """[] the lower of the critic's two values."""
    return critic.apply(learner.critic.params, normalizer.normalize(learner.normalizer, obs), action).min()


if __name__ == "__main__":
    main({name: float(number) for name, number in (word.split("=") for word in sys.argv[1:])})
