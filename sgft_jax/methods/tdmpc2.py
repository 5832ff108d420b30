"""TD-MPC2: plans with the simulator's latent world model; all of it learns."""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Annotated, ClassVar

from envs.types import Array, Key, PyTree
from sgft_jax import checks
from sgft_jax.train.options import LoopOptions
from sgft_jax.types import Batch, Finetuner, Method, Online, Prior, Task, Transform


@dataclass(frozen=True)
class PlannerOptions(LoopOptions):
    """Options of methods whose learner is TD-MPC2; the defaults are Hansen et al. 2024's, but for the horizon.

    A `ClassVar` is no option: a method's class sets it, or makes an option of it. shaped: rewards are shaped by draws
    of the simulator's value. fresh: the agent starts from nothing. sgft: see `TDMPC2Config`.
    """

    shaped: ClassVar[bool] = False
    fresh: ClassVar[bool] = False
    sgft: ClassVar[bool] = False
    lr_warmup: ClassVar[int | None] = 0

    utd: float = 1.0
    horizon: checks.Few = 4
    """Steps of a plan and of a training window."""
    plan_samples: Annotated[int, checks.least(8), checks.countable] = 512
    """Action sequences that a plan tries in each of its iterations."""
    lr: checks.Positive = 3e-4
    """Adam learning rate of all networks; the encoder's is 0.3 of it."""
    tau: checks.Share = 0.01
    """Averaging rate of the target critic and of the range of values that scales the policy's loss."""
    max_grad_norm: float | None = 20.0
    """Bound on the norm of the gradient of world model with critic, and of the policy's; None = no bound."""


@dataclass(frozen=True)
class Config(PlannerOptions):
    """Options of `tdmpc2`."""

    lr_warmup: checks.Updates | None = None
    """Updates over which the rate rises from 0; None = the updates of 1,000 real transitions. 40 updates at full rate
    took plans that pushed a towel home in 93 % of all episodes to 4 % (docs/lessons.md)."""


def build(config: PlannerOptions, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.data import sequences, sources
    from sgft_jax.learners import tdmpc2, tdmpc2_model
    from sgft_jax.learners.tdmpc2_model import TDMPC2Params
    from sgft_jax.policies import tdmpc2_policy
    from sgft_jax.train.finetuner import FinetuneState, Parts, assemble
    from sgft_jax.train.options import card_of, warmup
    from sgft_jax.transforms import compose

    card, fresh = card_of(prior), config.fresh or prior is None
    plan = {"horizon": config.horizon, "plan_samples": config.plan_samples}
    described = {"size": "5M", **card.get("config", {}), **plan, "sgft": config.sgft}
    structure = tdmpc2_model.named_config(task.obs_dim, task.act_dim, size=described["size"], sgft=config.sgft, **plan)
    hyper = tdmpc2.TDMPC2Hyper(
        config.lr,
        0 if fresh else warmup(config, config.lr_warmup),
        tau=config.tau,
        gamma=card["gamma"],
        max_grad_norm=inf if config.max_grad_norm is None else config.max_grad_norm,
    )
    learner = tdmpc2.make_tdmpc2(structure, hyper)

    def start(params: TDMPC2Params | None, key: Key) -> tuple[PyTree, PyTree]:
        if params is None:
            return learner.init(key), None
        if fresh:
            return learner.init(key).replace(normalizer=params.normalizer), params
        return tdmpc2.state_from_prior(structure, hyper, params), params if config.shaped else None

    def drawn_value(state: FinetuneState, key: Key) -> Callable[[Array, Key], Array]:
        """V_sim as SGFT's released code has it: every value is a new draw of two heads and of an action."""
        del key
        frozen = tdmpc2.state_from_prior(structure, hyper, state.frozen)
        return lambda obs, key: tdmpc2_model.value_sample(structure, frozen, obs, key)

    parts = Parts(
        learner=learner,
        start=start,
        export=lambda state: tdmpc2.extract_params(state.learner),
        policy=tdmpc2_policy(structure, hyper),
        source=lambda state: sources.real_windows(config.batch_size, config.horizon),
        transform=compose(_shape()) if config.shaped else compose(),
        imagine=drawn_value if config.shaped else lambda state, key: None,
        memory=sequences,
        beginner=(lambda params, fresh: params) if fresh and prior is not None else None,
        card={"algorithm": "tdmpc2", "config": described},
    )
    return assemble(parts, config, task)


def _shape() -> Transform:
    """Shaped rewards of windows, by draws of a value."""
    import jax

    from sgft_jax.transforms import stateless

    def shape(value: Callable[[Array, Key], Array], batch: Batch, key: Key) -> Batch:
        def reward(row: Batch, key: Key) -> Array:
            key_now, key_then = jax.random.split(key)
            return row.reward + row.discount * value(row.next_obs, key_then) - value(row.obs, key_now)

        keys = jax.random.split(key, batch.reward.shape)
        return batch._replace(reward=jax.vmap(jax.vmap(reward))(batch, keys))

    return stateless(shape)


_ABOUT = "plans with the simulator's world model, and all of it learns"
METHOD = Method("tdmpc2", Online("planning", _ABOUT, "Hansen 2024", Config, build, prior="tdmpc2", needs_prior=False))
