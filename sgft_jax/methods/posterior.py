"""The prior's policy behind the correction that pays: chosen in the systems that may have made the real rollouts.

The prior's estimator says which systems these are, simulated episodes in them what could be deployed: the prior as it
is, or behind what undoes the errors of commands and sensors. Real rollouts say how far to trust them, and where none of
the systems is the real one, the correction that fits real steps best is tried (`sgft_jax/posterior`). Nothing learns.
"""

from dataclasses import dataclass

from envs.types import UserError
from sgft_jax import checks
from sgft_jax.train.options import LoopOptions, card_of
from sgft_jax.types import Finetuner, Method, Online, Prior, Simulation, Task


@dataclass(frozen=True)
class Config(checks.Checked):
    """Options of `posterior`."""

    initial_rollouts: checks.Count = 1
    """Real rollouts before the first metrics; from then on they follow every rollout."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner. Compiles a few hundred worlds of the task. Raises UserError where the prior has no estimator, or
    one of other unknowns, or the task no simulator.
    """
    from envs.base import Env
    from sgft_jax.models.config import network_of
    from sgft_jax.models.distortion import command_interface
    from sgft_jax.policies import sac_policy
    from sgft_jax.posterior.candidates import candidates
    from sgft_jax.posterior.interface import check_estimator, deployed, posterior_interface
    from sgft_jax.train.finetuner import assemble, unlearned

    if not isinstance(task, Env):
        raise UserError("method posterior: this task has no simulator in which systems could be tried; use `sac`")
    card = card_of(prior)
    check_estimator(card, task)
    network = network_of(card)
    policy, systems = sac_policy(task.obs_dim, task.act_dim, network), candidates(task)
    parts = unlearned(policy, lambda params, key: ((), params._replace(estimator=None)), lambda state: state.frozen)
    interface = posterior_interface(task, systems, policy, command_interface(network, task))
    loop = LoopOptions(initial_rollouts=config.initial_rollouts)
    # Simulated rows tell how far the models are off.
    parts = parts._replace(interface=interface, simulation=Simulation(20_000, 0.6))
    return deployed(assemble(parts, loop, task)._replace(updates_per_rollout=1), policy)


_ABOUT = "the prior behind a correction, tried in the systems that rollouts allow"
METHOD = Method("posterior", Online("model-based", _ABOUT, "ours", Config, build))
