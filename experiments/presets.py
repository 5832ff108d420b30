"""Named settings of pretraining. A preset never changes meaning; a new idea is a new preset."""

from dataclasses import dataclass, field
from typing import Literal

from sgft_jax import checks
from sgft_jax.models.config import NetworkConfig, Precision


@dataclass(frozen=True)
class PretrainConfig:
    """Everything that decides the result of pretraining, apart from task and seeds."""

    algorithm: Literal["sac", "tdmpc2"] = "sac"
    """What trains: SAC, whose V_sim and models SGFT-SAC needs, or TD-MPC2 for the methods that plan."""
    n_envs: int = 4096
    """Environments stepped together."""
    worlds: int = 2048
    """Domain parameter vectors compiled; each episode lives in a random one."""
    env_steps: int = 8_000_000
    """Environment steps of training, after the random-action data."""
    random_transitions: int = 500_000
    """Random-action transitions: observation statistics and part of every batch."""
    random_fraction: float = 0.5
    """Share of each batch that comes from the random-action data (paper: 0.5)."""
    random_ladder: float = 0.0
    """Environment i of n acts uniformly at random in a share i / (n - 1) * random_ladder of its steps (0 = never), so
    that V_sim knows what lies beside the policy's own path: a real system leads there."""
    updates_per_step: int = 16
    """Gradient steps per step of all environments."""
    batch_size: int = 4096
    replay_capacity: int = 1_000_000
    gamma: float = 0.99
    lr: float = 3e-4
    """Adam learning rate of every network, at the start."""
    lr_end: float = 1.0
    """Share of it that is left at the end; it falls linearly. A falling rate settles V_sim and the last policies."""
    tau: float = 0.005
    """Averaging rate of the target critic."""
    alpha: float = 1.0
    """Initial temperature; it follows the target entropy."""
    entropy_per_dim: float = -1.0
    """Target entropy per action dimension, nats."""
    policy_delay: int = 1
    """Critic updates per actor update."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    precision: Precision = "default"
    """Of the updates' matrix products on GPUs. V_sim is evaluated in float32 whatever it was trained in."""
    ensemble_size: int = 5
    size: str = "5M"
    """TD-MPC2's networks by their published number of parameters: 1M, 5M, 19M, 48M or 317M."""
    horizon: int = 3
    """Steps of TD-MPC2's plans and training windows; a batch holds `batch_size` windows."""
    plan_samples: int = 512
    """Sequences that a plan tries in each of its iterations; plans are made in evaluations alone."""
    chunk_steps: int = 50
    """Steps of all environments per compiled chunk: between chunks we log, evaluate and checkpoint."""
    eval_every: int = 4
    """Chunks between evaluations."""
    choose_from: float = 0.75
    """Share of training after which evaluations compete to give the prior. On the way there a critic may promise twice
    what can be had while its policy already succeeds: a good policy with a useless V_sim."""
    eval_episodes: int = 256
    report_episodes: int = 256
    """At least that many fresh episodes judge the prior; 256 give a 95 % interval of +-6 points at worst."""
    checkpoint_every: int = 8
    """Chunks between checkpoints."""

    def __post_init__(self) -> None:
        checks.at_least(
            self, 1, "n_envs", "worlds", "env_steps", "random_transitions", "updates_per_step", "batch_size",
            "replay_capacity", "policy_delay", "ensemble_size", "horizon", "plan_samples", "chunk_steps", "eval_every",
            "eval_episodes", "report_episodes", "checkpoint_every",
        )  # fmt: skip
        checks.positive(self, "lr", "tau", "alpha")
        checks.share(self, "random_ladder", "lr_end", "tau", "choose_from")
        checks.below_one(self, "gamma", "random_fraction")
        checks.finite(self, "entropy_per_dim")
        for name in ("random_transitions", "replay_capacity"):
            if getattr(self, name) < self.n_envs:
                wanted = f"at least n-envs = {self.n_envs}, one step of all environments"
                raise checks.refusal(name, getattr(self, name), wanted)


_NORMED = NetworkConfig(hidden=(256, 256), layer_norm=True)

PRESETS: dict[str, PretrainConfig] = {
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
    # What pays on one GPU today: learning needs some 30,000 updates whatever the number of environments, so enough of
    # both to keep the device busy; layer-normed critics, fast targets, a falling learning rate.
    "fast": PretrainConfig(
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
    ),
    # TD-MPC2 in many environments at once, for the methods that plan. Its own numbers but for what massive collection
    # asks for: larger batches, and the discount factor and the exploration of `fast`.
    "tdmpc2": PretrainConfig(
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
        chunk_steps=100,
        eval_every=1,
        eval_episodes=32,
        report_episodes=64,
    ),
}
