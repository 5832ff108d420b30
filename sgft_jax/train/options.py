"""Options that several methods share, each with its help, and the rules for those left open.

Command lines read this module and the method files: they import neither JAX nor Flax at the top.
"""

from dataclasses import dataclass, fields
from typing import Annotated, Any, ClassVar

from sgft_jax import checks
from sgft_jax.models.config import NetworkConfig
from sgft_jax.types import Prior, Task

_WARMUP_TRANSITIONS = 1000  # real transitions over which learning rates of kept networks rise: 20 to 25 rollouts here
_BODY = {"hidden": [256, 256], "layer_norm": True, "actor_layer_norm": False, "activation": "relu"}
_WITHOUT_PRIOR = {"algorithm": "sac", "network": _BODY, "gamma": 0.99}


@dataclass(frozen=True)
class LoopOptions(checks.Checked):
    """Options of every method."""

    utd: Annotated[float, checks.positive, checks.few] = 8.0
    """Gradient updates per real transition."""
    batch_size: checks.Count = 256
    """Real transitions in a batch (windows of them for TD-MPC2)."""
    initial_rollouts: checks.Count = 1
    """Real rollouts before the first update, by the simulator's policy, or by plans if the method plans. The paper
    makes 20; with one, every method here reaches its level as early or earlier (docs/lessons.md)."""
    replay_capacity: checks.Count = 20_000
    """Real transitions that the replay holds; 20,000 are more than an hour of a robot at 5 Hz."""
    max_grad_norm: checks.Positive | None = None
    """Bound on the norm of each network's gradient; None = no bound."""
    guard: bool = False
    """Deploy what learns only while its real rollouts say that it is better than the policy that it began with, or
    than its own best since (sgft_jax/train/guard.py). That policy then plays the training rollouts too."""


@dataclass(frozen=True)
class SimulatedOptions(LoopOptions):
    """Options of methods that also learn from transitions of the simulator."""

    simulated_transitions: checks.Count = 200_000
    """Simulated transitions, of the simulator's policy with more and more random actions."""
    simulated_ladder: checks.Share = 0.6
    """Share of random actions in the last of these episodes; it grows from 0 in the first."""


@dataclass(frozen=True)
class MixedOptions(SimulatedOptions):
    """Options of methods whose batches are partly simulated."""

    simulated_share: checks.Share = 0.5
    """Share of each batch that is simulated."""


@dataclass(frozen=True)
class DynamicsOptions(LoopOptions):
    """Options of methods that train a dynamics ensemble."""

    lr_dynamics: checks.Positive = 3e-4
    """Adam learning rate of the dynamics ensemble, which trains on real rows."""
    dynamics_warmup: checks.Updates | None = None
    """Updates over which that rate rises from 0; None = the updates of 1,000 real transitions."""


@dataclass(frozen=True)
class ActorOptions(LoopOptions):
    """Options of methods in which SAC's actor learns, and what else `train.sac_finetuner` asks them.

    A `ClassVar` is no option: a method's class sets it, or makes an option of it. Those of the same name are fields of
    `SACConfig` and `SACHyper`. Besides:
    fresh: start from new networks; the simulator's policy makes the initial rollouts alone. reset_critic: start from
    the simulator's actor and a new critic. lr_warmup, anchor, identify, train_dynamics: see the options below.
    """

    critic_network: ClassVar[NetworkConfig | None] = None
    critics: ClassVar[int] = 2
    target_critics: ClassVar[int | None] = None
    actor_batch: ClassVar[int | None] = None
    actor_mean: ClassVar[bool] = False
    weighted_actor: ClassVar[bool] = True
    tune_alpha: ClassVar[bool] = False
    entropy_per_dim: ClassVar[float] = -1.0
    train_critic: ClassVar[bool] = True
    lr_critic: ClassVar[float] = 3e-4
    tau: ClassVar[float] = 0.005
    critic_warmup: ClassVar[int | None] = 0
    policy_delay: ClassVar[int | None] = 1
    fresh: ClassVar[bool] = False
    reset_critic: ClassVar[bool] = False
    lr_warmup: ClassVar[int | None] = 0
    anchor: ClassVar[float] = 0.0
    identify: ClassVar[bool] = False
    train_dynamics: ClassVar[bool] = False

    lr_actor: checks.Positive = 1e-4
    """Adam learning rate of the actor."""
    alpha: checks.Positive = 0.01
    """Entropy temperature."""
    actor_ramp: checks.Updates = 1000
    """Updates over which the actor's learning rate rises from 0."""

    @property
    def lr_alpha(self) -> float:
        """Adam learning rate of the temperature, where it follows a target."""
        return self.lr_actor


@dataclass(frozen=True)
class SACOptions(ActorOptions):
    """Options of methods whose learner is SAC."""

    lr_critic: checks.Positive = 3e-4
    """Adam learning rate of the critic."""
    tau: checks.Share = 0.005
    """Averaging rate of the target critic."""
    critic_warmup: checks.Updates | None = None
    """Updates at the start in which the critic alone learns. The first real data are the simulator's policy's own; they
    do not say what another action would do; `actor_ramp` follows for the same reason. None = the updates that follow
    the initial rollouts; the paper has 0."""
    policy_delay: checks.Few | None = 1
    """Critic updates per update of the actor; None = `utd`, one actor update per real transition (RLPD)."""


@dataclass(frozen=True)
class KeptCriticOptions(SACOptions):
    """Options of methods that may go on with the simulator's critic."""

    lr_warmup: checks.Updates | None = None
    """Updates over which the learning rate of a critic kept from the simulator rises from 0. Adam's first steps are as
    long as its rate in every weight, however small the gradient. None = the updates of 1,000 real transitions."""
    anchor: checks.NotNegative = 0.0
    """Price of the actor's divergence from the simulator's policy, in reward per nat; 0 = free. Where that policy is
    right already, 0.1 keeps it so (docs/rules.md)."""
    identify: bool = False
    """Estimate from real rollouts, through the prior's models, by which scale, rotation and bias the real system
    changes commands and by which constant errors its sensors are wrong, and correct for both."""


@dataclass(frozen=True)
class ModelOptions(KeptCriticOptions, DynamicsOptions):
    """Options of methods that branch with dynamics models."""

    horizon: checks.Few = 1
    """Steps of an imagined branch; with shortening also of a segment (the paper's H)."""
    branches: checks.Few = 5
    """Imagined branches from each real row of a batch."""
    branch_noise: checks.NotNegative = 0.5
    """Std of Gaussian noise on imagined actions, in units of the action's range; 0 as in the paper. Without noise the
    critic never hears of actions better than the policy's (docs/lessons.md)."""
    train_dynamics: bool = True
    """Fit the models to real rows; False keeps the simulator's."""
    actor_real_only: bool = True
    """The actor learns from the sampled rows alone, the critic from the imagined ones too."""

    @property
    def actor_batch(self) -> int | None:
        """Leading rows of a batch that the actor learns from, None = all."""
        return self.batch_size if self.actor_real_only else None


@dataclass(frozen=True)
class ShapedOptions(KeptCriticOptions):
    """Options of methods that shape rewards by V_sim."""

    clip_shaped: checks.Positive | None = 2.0
    """Bound on the shaped reward; None = no bound, as in the paper."""


# --- options left open ------------------------------------------------------------------------------------------------


def loop_of(options: Any) -> LoopOptions:
    """What every method's loop has, of options that may name only some of it: the rest has its defaults."""
    names = [field.name for field in fields(LoopOptions) if hasattr(options, field.name)]
    return LoopOptions(**{name: getattr(options, name) for name in names})


def updates_per_rollout(options: LoopOptions, task: Task) -> int:
    """Gradient updates that follow one real rollout of full length; `finetune` makes fewer after a shorter one."""
    return max(round(options.utd * task.episode_length), 1)


def critic_warmup(options: ActorOptions, task: Task) -> int:
    """Critic-only updates at the start."""
    follow = options.initial_rollouts * updates_per_rollout(options, task)
    return follow if options.critic_warmup is None else options.critic_warmup


def warmup(options: LoopOptions, updates: int | None) -> int:
    """Updates over which a learning rate rises."""
    return round(_WARMUP_TRANSITIONS * options.utd) if updates is None else updates


def policy_delay(options: ActorOptions) -> int:
    """Critic updates per update of the actor."""
    return max(round(options.utd), 1) if options.policy_delay is None else options.policy_delay


def card_of(prior: Prior | None) -> dict[str, Any]:
    """What a prior says of its networks and its discount factor; without one, RLPD's critic body and gamma 0.99."""
    return dict(_WITHOUT_PRIOR if prior is None else prior.card)
