"""MPC-SGFT on a prior of SAC: plans of H steps by its dynamics ensemble, which learns, that end in V_sim.

Source: SGFT (Yin et al., ICLR 2025), Algorithm 3. The paper plans in TD-MPC2's latent space (`sgft-tdmpc2`).
"""

from dataclasses import dataclass
from typing import Annotated

from envs.types import Key, PyTree
from sgft_jax import checks
from sgft_jax.train.options import DynamicsOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(DynamicsOptions):
    """Options of `sgft-mpc`."""

    horizon: checks.Few = 1
    """Steps of a plan, the paper's H."""
    plan_samples: Annotated[int, checks.least(8), checks.countable] = 128
    """Action sequences that a plan tries in each of its iterations."""
    plan_noise: checks.NotNegative = 0.5
    """Std of the noise on what the policy proposes, in units of the action's range."""
    explore_noise: checks.NotNegative = 0.4
    """Std of the noise on what a plan does in a training rollout. A plan does much the same in the same state, and from
    such data no model learns what actions do."""
    dynamics_warmup: int | None = 0


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.learners.sac import SACParams
    from sgft_jax.models.config import network_of
    from sgft_jax.planning import MPCConfig
    from sgft_jax.policies import mpc_policy
    from sgft_jax.train.finetuner import FinetuneState, assemble, dynamics_models, unlearned
    from sgft_jax.train.options import card_of

    card = card_of(prior)
    network = network_of(card)
    plan = {"horizon": config.horizon, "samples": config.plan_samples, "noise": config.plan_noise}
    structure = MPCConfig(task.obs_dim, task.act_dim, network, **plan, gamma=card["gamma"])

    def start(params: SACParams, key: Key) -> tuple[PyTree, PyTree]:
        del key
        return (), params._replace(dynamics=None)

    def export(state: FinetuneState) -> SACParams:
        return state.frozen._replace(dynamics=state.models.params)

    parts = unlearned(mpc_policy(structure, task, explore_noise=config.explore_noise), start, export)
    models = dynamics_models(config, network, task)
    return assemble(parts._replace(models=models, card={"plan": plan}), config, task)


_ABOUT = "plans of H steps by learning models, ended by V_sim"
METHOD = Method("sgft-mpc", Online("sgft", _ABOUT, "SGFT 2025", Config, build, zero_shot=False))
