"""SAC behind the correction that most systems call for which may have made the real rollouts, deployed where it pays.

The prior's estimator says which systems these are, simulated episodes in them what could be deployed: the prior as it
is, the prior behind a correction, or what learns behind it. Real rollouts say how far to trust them
(`sgft_jax/posterior`).
"""

from dataclasses import dataclass
from typing import ClassVar

from envs.types import UserError
from sgft_jax.methods import sac
from sgft_jax.train.options import LoopOptions, card_of
from sgft_jax.types import Finetuner, Method, Online, Prior, Task

_MAKE = "`python -m experiments.estimate --prior PRIOR` makes it"


@dataclass(frozen=True)
class Config(sac.Config):
    """Options of `posterior`."""

    identify: ClassVar[bool] = False  # the posterior does
    guard: ClassVar[bool] = False  # and decides

    learns: bool = True
    """Also try what SAC learns from the real rollouts; False: nothing learns."""
    simulated_share: float = 0.5
    """Share of each batch that is simulated, so that the critic does not forget what real rows do not show."""
    simulated_transitions: int = 50_000
    """Simulated transitions, of the simulator's policy with more and more random actions."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner. Compiles a few hundred worlds of the task. Raises UserError where the prior has no estimator, or
    one of other unknowns, or the task no simulator.
    """
    from envs.base import Env
    from sgft_jax.models.config import network_of
    from sgft_jax.policies import sac_policy
    from sgft_jax.posterior.candidates import candidates
    from sgft_jax.posterior.interface import deployed, entry_of, posterior_interface
    from sgft_jax.train.finetuner import assemble, mixed_rows, sac_finetuner, unlearned

    if not isinstance(task, Env):
        raise UserError("method posterior: this task has no simulator in which systems could be tried; use `sac`")
    card = card_of(prior)
    if not (entry := card.get("estimator")):
        raise UserError(f"method posterior: the prior has no estimator; {_MAKE}")
    if entry != entry_of(task):
        raise UserError(f"method posterior: the prior's estimator knows other systems than {task.name}; {_MAKE}")
    policy, systems = sac_policy(task.obs_dim, task.act_dim, network_of(card)), candidates(task)
    interface = posterior_interface(task, systems, policy)
    if config.learns:
        source, simulation = mixed_rows(config, prior)
        inner = sac_finetuner(
            config, prior, task, source=lambda state: source, simulation=simulation, interface=interface
        )
    else:
        parts = unlearned(policy, lambda params, key: ((), params._replace(estimator=None)), lambda state: state.frozen)
        loop = LoopOptions(initial_rollouts=config.initial_rollouts)
        inner = assemble(parts._replace(interface=interface), loop, task)._replace(updates_per_rollout=1)
    return deployed(inner, task, systems, policy, learns=config.learns)


_ABOUT = "SAC, or the prior, behind a correction, tried in the systems that rollouts allow"
METHOD = Method("posterior", Online("model-free", _ABOUT, "ours", Config, build))
