"""A recurrent policy, zero-shot: trained where actuators, latency and sensors differ, it finds out while it acts.

Nothing learns from real rollouts. Source: Ni et al. 2022 (pomdp-baselines), with domain randomisation.
"""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.train.options import LoopOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(checks.Checked):
    """Options of methods in which nothing learns."""

    initial_rollouts: checks.Count = 1
    """Real rollouts before the first learning phase; the policy does not learn, so results do not depend on it."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.algorithms import make_policy
    from sgft_jax.train.finetuner import assemble, unlearned
    from sgft_jax.train.options import card_of

    policy = make_policy(card_of(prior), task)
    parts = unlearned(policy, start=lambda params, key: ((), params), export=lambda state: state.frozen)
    return assemble(parts, LoopOptions(initial_rollouts=config.initial_rollouts), task)._replace(updates_per_rollout=1)


_ABOUT = "zero-shot: a policy with memory, from a simulator whose actuators and sensors differ"
METHOD = Method("recurrent", Online("model-free", _ABOUT, "Ni 2022", Config, build, prior="recurrent"))
