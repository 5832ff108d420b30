"""Settings of pretraining, some of them by name: `PRESETS`. A preset keeps its meaning; a new idea is a new preset.

Command lines read this module, so it imports neither JAX nor MuJoCo.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

from envs.types import UserError, unknown
from sgft_jax import checks
from sgft_jax.algorithms import PretrainedName, algorithm_of, get_algorithm
from sgft_jax.models.config import SIZES, NetworkConfig, Precision
from sgft_jax.types import Fixed, Online

__all__ = ["PRESETS", "PretrainConfig"]

DEFAULT_PRESET = "robust"


@dataclass(frozen=True)
class PretrainConfig(checks.Checked):
    """Everything that decides the result of pretraining, apart from the task, the worlds and the seeds."""

    algorithm: PretrainedName = "sac"
    """What is trained. sac: for all methods but these. tdmpc2: for `tdmpc2`, `sgft-tdmpc2` and `sgft-tdmpc2-code`.
    recurrent: for `recurrent`."""
    env_steps: Annotated[int, checks.least(1), checks.greatest(2**40)] = 8_000_000
    """Environment steps of training, after the random actions."""
    n_envs: checks.Count = 4096
    """Environments stepped together."""
    updates_per_step: checks.Count = 16
    """Gradient steps per step of all environments."""
    batch_size: checks.Count = 4096
    """Transitions in a batch (TD-MPC2: windows of `horizon` steps; recurrent SAC: episodes)."""
    gamma: checks.BelowOne = 0.99
    """Discount factor per control step."""
    previous_actions: Annotated[int, checks.least(0), checks.few] = 0
    """Last actions that end the observation of all networks. Where commands arrive late, measurements alone do not say
    what will happen next."""
    actuators: bool = False
    """Also vary between episodes how commands reach the robot (scale, bias, rotation, latency) and how noisy its
    sensors are, see `envs.domains`. What such a policy sees should end with its previous actions."""
    sees_system: bool = False
    """End the observation of all networks with what varies between episodes of the training domain, parameters and
    effects. Such a prior is for the method `sysid`, which tells it what it has identified."""
    blind_actor: bool = False
    """Hide the system from the actor: an asymmetric actor-critic, for the method `asymmetric`."""
    system_noise: checks.NotNegative = 0.3
    """Std of the noise on that in training, where each number's range is [-1, 1]; new at every step. Without it,
    networks of few episodes learn to tell these apart (docs/methods.md)."""
    lr: checks.Positive = 3e-4
    """Adam learning rate of every network at the start."""
    lr_end: checks.Share = 1.0
    """Share of the learning rate that is left at the end; it falls linearly. A falling rate settles the critic."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Networks of SAC; of recurrent SAC what follows the GRUs."""
    gru: checks.Few = 128
    """Units of the GRUs of recurrent SAC."""
    worlds: checks.Count = 2048
    """Worlds compiled for each seed; every episode takes place in a random one."""
    refresh_every: Annotated[int, checks.least(0), checks.countable] = 0
    """Chunks after which new worlds are drawn and all environments start new episodes; 0 keeps the first worlds."""
    doraemon: bool = False
    """Draw worlds from a domain that begins around the nominal system and widens with every new set, as fast as the
    policy succeeds, see `envs.doraemon`."""
    replay_capacity: checks.Count = 1_000_000
    """Transitions kept; new ones replace the oldest."""
    random_transitions: checks.Count = 500_000
    """Transitions under random actions, collected first: they give the observation statistics and a part of every
    batch. Where an environment would make more than 3,125 steps, a multiple of n-envs collects them."""
    normalize: bool = True
    """Networks read observations in units of the statistics of random actions; the paper's do not on insert."""
    random_fraction: checks.BelowOne = 0.5
    """Share of each batch that comes from the random actions (paper: 0.5)."""
    random_ladder: checks.Share = 0.0
    """Environment i of n replaces a share i / (n - 1) * random_ladder of its actions by random ones. The
    networks then also know states beside the policy's own path, where a real system leads; 0 replaces none."""
    tau: Annotated[float, checks.positive, checks.share] = 0.005
    """Averaging rate of the target critic."""
    alpha: checks.Positive = 1.0
    """Initial temperature of SAC; training adapts it to the target entropy."""
    entropy_per_dim: checks.Finite = -1.0
    """Target entropy of SAC per action dimension, nats."""
    policy_delay: checks.Few = 1
    """Critic updates of SAC per actor update."""
    ensemble_size: checks.Few = 5
    """Dynamics models that SAC trains alongside, and networks of V_sim."""
    value_episodes: checks.Count = 65_536
    """Simulated episodes that V_sim is fitted to, after training. They begin with random actions."""
    value_updates: checks.Count = 16_000
    """Gradient steps of that fit, with batches of `batch_size` steps."""
    value_left: Annotated[float, checks.positive, checks.share] = 0.3
    """Share of the discounted weight that is left where these episodes end, past their time limit; there V_sim itself
    stands for what follows."""
    precision: Precision = "default"
    """Matrix products of the updates on GPUs. V_sim is always evaluated in float32."""
    size: str = "5M"
    """TD-MPC2's networks by their published number of parameters: 1M, 5M, 19M, 48M or 317M."""
    horizon: checks.Few = 3
    """Steps of TD-MPC2's plans and training windows."""
    plan_samples: checks.Count = 512
    """Action sequences that TD-MPC2 samples in each iteration of a plan; it plans in evaluations alone."""
    chunk_steps: checks.Count = 50
    """Steps of all environments per compiled chunk; logs, evaluations and checkpoints come between chunks."""
    eval_every: checks.Count = 4
    """Chunks between evaluations."""
    eval_episodes: checks.Count = 256
    """Episodes of an evaluation, in worlds that training does not see."""
    choose_from: checks.Share = 0.75
    """Share of training after which evaluations compete for the prior. Earlier policies may succeed while their critic
    still promises twice what can be had."""
    report_episodes: checks.Count = 256
    """Fresh episodes that measure the prior, at least; 256 give a 95 % interval of +-6 points at worst."""
    checkpoint_every: checks.Count = 8
    """Chunks between checkpoints."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.size not in SIZES:
            raise UserError(unknown("size", self.size, SIZES))
        if self.sees_system and self.algorithm != "sac":
            wanted = f"off for a prior of {self.algorithm}, which no method could tell anything"
            raise checks.refusal("sees_system", True, wanted)
        if self.blind_actor and not self.sees_system:
            raise checks.refusal("blind_actor", True, "off where sees-system is off: there is nothing to hide")
        if self.network.blind and not self.blind_actor:
            raise checks.refusal("network.blind", self.network.blind, "0: blind-actor sets it")
        if self.doraemon and not self.refresh_every:
            raise checks.refusal("doraemon", True, "off where refresh-every is 0: the domain widens with new worlds")
        for name in ("random_transitions", "replay_capacity"):
            if getattr(self, name) < self.n_envs:
                wanted = f"at least n-envs = {self.n_envs}, one step of all environments"
                raise checks.refusal(name, getattr(self, name), wanted)

    @property
    def chunk_env_steps(self) -> int:
        """Environment steps of one chunk."""
        return self.n_envs * self.chunk_steps

    @property
    def chunks(self) -> int:
        """Chunks of the whole training."""
        return math.ceil(self.env_steps / self.chunk_env_steps)


_NORMED = NetworkConfig(hidden=(256, 256), layer_norm=True)

# What pays on one GPU: learning needs many updates whatever the number of environments, so enough of both to keep the
# device busy; layer-normed critics, fast targets, a falling learning rate.
_FAST = PretrainConfig(
    n_envs=1024,
    env_steps=2_500_000,
    random_transitions=102_400,
    random_fraction=0.1,
    random_ladder=0.6,
    updates_per_step=32,
    batch_size=1024,
    gamma=0.97,
    lr=5e-4,
    lr_end=0.05,
    tau=0.01,
    alpha=0.1,
    network=_NORMED,
)

# For real systems that nobody knows yet: actuators and sensors differ between episodes, and the policy remembers what
# it commanded. Four times the environments and the learning rate of `fast` do with 30,000 of its 78,400 updates
# (docs/lessons.md).
_ROBUST = replace(
    _FAST,
    previous_actions=2,
    actuators=True,
    n_envs=4096,
    env_steps=2_560_000,
    random_transitions=204_800,
    updates_per_step=48,
    lr=2e-3,
    chunk_steps=25,
    eval_every=10,
)

# TD-MPC2 in many environments at once, for the methods with a world model. It has the authors' numbers, except that
# many environments need larger batches; discount factor and exploration are those of `fast`.
_TDMPC2 = PretrainConfig(
    algorithm="tdmpc2",
    n_envs=512,
    env_steps=1_024_000,
    random_transitions=51_200,
    random_fraction=0.1,
    random_ladder=0.6,
    updates_per_step=16,
    batch_size=512,
    replay_capacity=512_000,
    gamma=0.97,
    lr=3e-4,
    lr_end=0.1,
    tau=0.01,
    eval_every=10,
    eval_episodes=128,
)

PRESETS: dict[str, PretrainConfig] = {
    "robust": _ROBUST,
    # The same, told what differs: for the method `sysid`, which identifies it.
    "informed": replace(_ROBUST, sees_system=True, system_noise=0.1),
    "asymmetric": replace(_ROBUST, sees_system=True, system_noise=0.0, blind_actor=True),
    # Half the environments, so that 25 sets of worlds fit into the same steps and updates.
    "doraemon": replace(_ROBUST, doraemon=True, refresh_every=1, n_envs=2048, updates_per_step=24, chunk_steps=50),
    # The paper's numbers (Appendix C): one update of batch 256 per environment step, 2 x 512 units, alpha from 1.
    "paper": PretrainConfig(
        n_envs=64,
        env_steps=5_000_000,
        random_transitions=25_000_000,
        updates_per_step=64,
        batch_size=256,
        replay_capacity=5_000_000,
        chunk_steps=200,
    ),
    # The task's own domain and measurements alone: the priors of docs/results.md, and of the strata of drawn gaps.
    "fast": _FAST,
    "tdmpc2": _TDMPC2,
    "robust-tdmpc2": replace(_TDMPC2, previous_actions=2, actuators=True),  # in the domain of `robust`
    # A policy that remembers the episode, in the domain of `robust`. A batch has 3,200 transitions (64 episodes of 50
    # steps), so 24,000 updates see as many as 75,000 of `fast`.
    "recurrent": replace(
        _FAST,
        algorithm="recurrent",
        actuators=True,
        env_steps=1_536_000,
        updates_per_step=16,
        batch_size=64,
        lr=3e-4,
        lr_end=0.1,
    ),
    # Two CPU cores, under three minutes, most of which go into the updates: one small update per environment step
    # learns pushing from 40,000 steps; 30,000 updates are too few, with 60,000 steps too.
    "cpu": PretrainConfig(
        n_envs=32,
        worlds=32,
        env_steps=38_400,
        random_transitions=1_024,
        random_fraction=0.1,
        random_ladder=0.5,
        updates_per_step=32,
        batch_size=128,
        replay_capacity=100_000,
        gamma=0.95,
        lr=1e-3,
        lr_end=0.1,
        tau=0.02,
        alpha=0.1,
        network=NetworkConfig(hidden=(96, 96), layer_norm=True),
        ensemble_size=3,
        value_episodes=768,
        value_updates=4000,
        chunk_steps=100,
        eval_every=1,
        eval_episodes=32,
        report_episodes=64,
    ),
}


def preset_of(method: Online) -> str:
    """The preset that makes the priors which a method needs."""
    if method.blind_actor:
        return "asymmetric"
    return "informed" if method.sees_system else get_algorithm(method.prior).preset


def check_card(card: Mapping[str, Any], method: Online, task: str) -> None:
    """Raises UserError for the card of a prior of another algorithm or task, or of a policy told more or less."""
    command = f"python -m experiments.pretrain --task {task} --preset {preset_of(method)}"
    if (algorithm := algorithm_of(card).name) != method.prior:
        raise UserError(f"{method.name} needs a prior of {method.prior}, not of {algorithm}; make one with: {command}")
    if method.sees_system != bool(card.get("system")):
        negation = "" if method.sees_system else "not "
        raise UserError(f"{method.name} needs a prior that was {negation}told the system; make one with: {command}")
    if method.blind_actor != bool((card.get("network") or {}).get("blind")):
        negation = "not " if method.blind_actor else ""
        raise UserError(
            f"{method.name} needs a prior whose actor is {negation}told the system; make one with: {command}"
        )
    if card["task"] != task:
        raise UserError(f"the prior is of the task {card['task']!r}, not of {task!r}")


# --- presets of methods that learn from a log -------------------------------------------------------------------------

_GOES_ON = r"(?!-(?:replay|expert)\b)"  # halfcheetah-medium-replay and -medium-expert are not halfcheetah-medium


def preset_for(method: Fixed, data: str) -> str:
    """The preset of a method with presets `by_data` that is called after this data set; "" for its first one.

    data: a name such as `walker2d_medium-v2`, in which the data set stands between other words. The longest fits best.
    """
    fitting = [name for name in method.presets if _names(data, name)] if method.by_data else []
    return max(fitting, key=len, default="")


def say_preset(method: Fixed, preset: str, data: str) -> str:
    """Which preset a method with presets `by_data` uses, in words. preset: its name, "" for the first."""
    if preset:
        return f"preset {preset}"
    return f"preset {next(iter(method.presets))}, as none is called after {data}"


def _names(data: str, preset: str) -> bool:
    """Whether the name of the data has that of the preset as whole words."""
    words = re.sub(r"[^a-z0-9]+", "-", data.lower())
    return re.search(rf"\b{re.escape(preset)}\b{_GOES_ON}", words) is not None
