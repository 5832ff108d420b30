"""Behaviour cloning of the real rollouts, from the simulator's actor."""

from dataclasses import dataclass

from sgft_jax.methods.options import LoopOptions
from sgft_jax.types import Finetuner, Method, Prior, Task


@dataclass(frozen=True)
class Config(LoopOptions):
    """Options of `bc`."""

    lr_actor: float = 1e-4
    """Adam learning rate of the actor."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.data import sources
    from sgft_jax.finetuner import Parts, assemble
    from sgft_jax.learners import bc
    from sgft_jax.methods.options import card_of
    from sgft_jax.policies import network_of, sac_policy
    from sgft_jax.transforms import compose

    network = network_of(card_of(prior))
    learner = bc.make_bc(task.obs_dim, task.act_dim, network, config.lr_actor)

    def start(params, key, simulated):  # noqa: ANN001, ANN202
        state = learner.init(key)
        fit = state.actor._replace(params=params.actor)
        return state.replace(actor=fit, normalizer=params.normalizer), params._replace(actor=None)

    parts = Parts(
        learner=learner,
        start=start,
        init_carry=learner.init_carry,
        act=lambda state, carry, obs, key, *, explore: learner.act(state.learner, carry, obs, key, explore=explore),
        export=lambda state: state.frozen._replace(actor=state.learner.actor.params),
        policy=sac_policy(task.obs_dim, task.act_dim, network),
        source=lambda state: sources.real_rows(config.batch_size),
        transform=compose(),
    )
    return assemble(parts, config, task)


METHOD = Method("bc", "offline", "imitates the real rollouts", "Pomerleau 1989", Config, build)
