"""Options that several methods share, each with its help, and the rules for those left open.

Command lines read this module and the method files: they import neither JAX nor Flax at the top.
"""

from dataclasses import dataclass
from typing import Any

from sgft_jax import checks
from sgft_jax.types import Prior, Task

_WARMUP_TRANSITIONS = 1000  # real transitions over which learning rates of kept networks rise: 20 to 25 rollouts here
_BODY = {"hidden": [256, 256], "layer_norm": True, "actor_layer_norm": False, "activation": "relu"}
_WITHOUT_PRIOR = {"algorithm": "sac", "network": _BODY, "gamma": 0.99}


@dataclass(frozen=True)
class LoopOptions:
    """Options of every method."""

    utd: float = 8.0
    """Gradient updates per real transition."""
    batch_size: int = 256
    """Real transitions in a batch (windows of them for TD-MPC2)."""
    initial_rollouts: int = 1
    """Real rollouts before the first update, by the simulator's policy, or by plans if the method plans. The paper
    makes 20; with one, every method here reaches its level as early or earlier (docs/history.md)."""
    replay_capacity: int = 20_000
    """Real transitions that the replay holds; 20,000 are more than an hour of a robot at 5 Hz."""
    max_grad_norm: float | None = None
    """Bound on the norm of each network's gradient; None = no bound."""
    guard: bool = False
    """Deploy what learns only while its real rollouts say that it is better than the policy that it began with, or
    than its own best since (sgft_jax/train/guard.py). That policy then plays the training rollouts too."""

    def __post_init__(self) -> None:
        checks.positive(self, "utd", "max_grad_norm")
        checks.few(self, 0, "utd")
        checks.at_least(self, 1, "batch_size", "initial_rollouts", "replay_capacity")


@dataclass(frozen=True)
class SACOptions(LoopOptions):
    """Options of methods whose learner is SAC."""

    lr_actor: float = 1e-4
    """Adam learning rate of the actor."""
    lr_critic: float = 3e-4
    """Adam learning rate of the critic."""
    tau: float = 0.005
    """Averaging rate of the target critic."""
    alpha: float = 0.01
    """Entropy temperature."""
    critic_warmup: int | None = None
    """Updates at the start in which the critic alone learns. The first real data are the simulator's policy's own; they
    do not say what another action would do. None = the updates that follow the initial rollouts; the paper has 0."""
    actor_ramp: int = 1000
    """Updates over which the actor's learning rate then rises from 0, for the same reason."""
    policy_delay: int | None = 1
    """Critic updates per update of the actor; None = `utd`, one actor update per real transition (RLPD)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.positive(self, "lr_actor", "lr_critic", "alpha")
        checks.share(self, "tau")
        checks.not_negative(self, "critic_warmup", "actor_ramp")
        checks.few(self, 1, "policy_delay")


@dataclass(frozen=True)
class KeptCriticOptions(SACOptions):
    """Options of methods that may go on with the simulator's critic."""

    lr_warmup: int | None = None
    """Updates over which the learning rate of a critic kept from the simulator rises from 0. Adam's first steps are as
    long as its rate in every weight, however small the gradient. None = the updates of 1,000 real transitions."""
    anchor: float = 0.0
    """Price of the actor's divergence from the simulator's policy, in reward per nat; 0 = free. Where that policy is
    right already, 0.1 keeps it so (docs/protocol.md)."""
    identify: bool = False
    """Estimate from real rollouts, through the prior's models, by which scale, rotation and bias the real system
    changes commands and by which constant errors its sensors are wrong, and correct for both."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.not_negative(self, "lr_warmup", "anchor")


@dataclass(frozen=True)
class ModelOptions(KeptCriticOptions):
    """Options of methods that branch with dynamics models."""

    horizon: int = 1
    """Steps of an imagined branch; with shortening also of a segment (the paper's H)."""
    branches: int = 5
    """Imagined branches from each real row of a batch."""
    branch_noise: float = 0.5
    """Std of Gaussian noise on imagined actions, in units of the action's range; 0 as in the paper. Without noise the
    critic never hears of actions better than the policy's (docs/history.md)."""
    lr_dynamics: float = 3e-4
    """Adam learning rate of the dynamics ensemble, which trains on real rows."""
    dynamics_warmup: int | None = None
    """Updates over which that rate rises from 0; None = the updates of 1,000 real transitions."""
    train_dynamics: bool = True
    """Fit the models to real rows; False keeps the simulator's."""
    actor_real_only: bool = True
    """The actor learns from the sampled rows alone, the critic from the imagined ones too."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.few(self, 1, "horizon", "branches")
        checks.not_negative(self, "branch_noise", "dynamics_warmup")
        checks.positive(self, "lr_dynamics")


# --- options left open ------------------------------------------------------------------------------------------------


def updates_per_rollout(options: LoopOptions, task: Task) -> int:
    """Gradient updates that follow one real rollout of full length; `finetune` makes fewer after a shorter one."""
    return max(round(options.utd * task.episode_length), 1)


def critic_warmup(options: SACOptions, task: Task) -> int:
    """Critic-only updates at the start."""
    follow = options.initial_rollouts * updates_per_rollout(options, task)
    return follow if options.critic_warmup is None else options.critic_warmup


def warmup(options: LoopOptions, updates: int | None) -> int:
    """Updates over which a learning rate rises."""
    return round(_WARMUP_TRANSITIONS * options.utd) if updates is None else updates


def policy_delay(options: SACOptions) -> int:
    """Critic updates per update of the actor."""
    return max(round(options.utd), 1) if options.policy_delay is None else options.policy_delay


def card_of(prior: Prior | None) -> dict[str, Any]:
    """What a prior says of its networks and its discount factor; without one, RLPD's critic body and gamma 0.99."""
    return dict(_WITHOUT_PRIOR if prior is None else prior.card)
