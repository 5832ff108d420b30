"""The prior behind the correction that most systems call for which may have made the real rollouts; nothing learns.

The prior's estimator says which systems these are, simulated episodes in them what could be deployed, and real rollouts
how far to trust them (`sgft_jax/posterior`).
"""

from dataclasses import dataclass

from envs.types import Key, PyTree, UserError
from sgft_jax import checks
from sgft_jax.train.options import LoopOptions, card_of
from sgft_jax.types import Finetuner, Method, Online, Prior, Task

_MAKE = "`python -m experiments.estimate --prior PRIOR` makes it"


@dataclass(frozen=True)
class Config(checks.Checked):
    """Options of `posterior`."""

    initial_rollouts: checks.Count = 1
    """Real rollouts before the first choice."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner. Compiles a few hundred worlds of the task. Raises UserError where the prior has no estimator, or
    one of other unknowns, or the task no simulator.
    """
    from envs.base import Env
    from sgft_jax.models.config import network_of
    from sgft_jax.policies import sac_policy
    from sgft_jax.posterior.candidates import candidates
    from sgft_jax.posterior.interface import entry_of, posterior_interface
    from sgft_jax.train.finetuner import FinetuneState, assemble, unlearned

    if not isinstance(task, Env):
        raise UserError("method posterior: this task has no simulator in which systems could be tried; use `sac`")
    card = card_of(prior)
    if not (entry := card.get("estimator")):
        raise UserError(f"method posterior: the prior has no estimator; {_MAKE}")
    if entry != entry_of(task):
        raise UserError(f"method posterior: the prior's estimator knows other systems than {task.name}; {_MAKE}")
    policy = sac_policy(task.obs_dim, task.act_dim, network_of(card))

    def start(params: PyTree, key: Key) -> tuple[PyTree, PyTree]:
        del key
        return (), params._replace(estimator=None)

    def export(state: FinetuneState) -> PyTree:
        return state.frozen

    parts = unlearned(policy, start, export)
    parts = parts._replace(interface=posterior_interface(task, candidates(task), policy))
    loop = LoopOptions(initial_rollouts=config.initial_rollouts)
    return assemble(parts, loop, task)._replace(updates_per_rollout=1, estimates=True)


_ABOUT = "the prior behind a correction that is tried in the systems that rollouts allow"
METHOD = Method("posterior", Online("model-based", _ABOUT, "ours", Config, build))
