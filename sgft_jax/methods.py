"""The table of fine-tuning methods: which learner, which batch transforms, which rows, and the authors' settings."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from sgft_jax import extend
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.transforms import branch, shape, shorten
from sgft_jax.types import Array, BatchTransform, UserError, unknown

_WARM_TRANSITIONS = 1000  # real ones, for `lr_warmup` and `dynamics_warmup`: 20 to 25 rollouts of the tasks here

AgentName = Literal["sac", "iql", "tdmpc2", "mpc"]

# What tuning chooses from. Of every method the five options that its authors name as sensitive, or that our own
# measurements do (`FinetuneConfig` says where), with three values each: the spaces are equally large, so that the same
# number of trials searches the same share of each. The default is among the three; the others are published ones of
# close relatives, or lie a factor of two to three away. Nothing that decides what a method is can be chosen.
_UTD = (2.0, 8.0, 20.0)  # from an update or two per step to RLPD's and MBPO's twenty
_RATES = {"lr_actor": (3e-5, 1e-4, 3e-4), "lr_critic": (1e-4, 3e-4, 1e-3)}
_WARMUP = (None, 0, 5_000)  # as long as argued here, as printed in the paper, longer
_SHARE = (0.25, 0.5, 0.75)
_PLAIN_SPACE = {"utd": _UTD, **_RATES, "alpha": (0.003, 0.01, 0.03), "critic_warmup": _WARMUP}
_SEGMENT_SPACE = {"utd": _UTD, **_RATES, "horizon": (1, 2, 4), "critic_warmup": _WARMUP}
_BRANCH_SPACE = {"utd": _UTD, **_RATES, "horizon": (1, 2, 4), "branches": (2, 5, 10)}
_MODEL_SPACE = {
    "utd": _UTD, "lr_dynamics": (1e-4, 3e-4, 1e-3), "horizon": (1, 2, 4), "branch_noise": (0.25, 0.5, 1.0),
    "plan_samples": (64, 128, 256),
}  # fmt: skip
_PLANNER_SPACE = {
    "utd": (1.0, 2.0, 4.0), "lr_critic": (1e-4, 3e-4, 1e-3), "horizon": (2, 3, 4), "batch_size": (128, 256, 512),
    "plan_samples": (256, 512, 1024),
}  # fmt: skip


@dataclass(frozen=True)
class FinetuneConfig:
    """Options of fine-tuning; the defaults are the paper's where it states them (Appendix C), else argued here.

    horizon, branches: H and the model branches per sampled real state. With H = 1, the paper's, the agent never takes a
        step that costs V_sim now and pays later: on hammering, where strokes do, some seeds end up hovering. So
        SGFT-SAC has H = 4 with 2 branches, nowhere worse (docs/ablations.md). batch_size: real transitions per update.
    branch_noise: std of the noise on imagined actions. The paper draws them from the policy alone (0). On pushing, 20
        rollouts and 6,000 updates, the best of 16 actions by the critic then has r_bar -0.34 in the mean, with noise
        0.5 -0.20; by the model itself -0.15, by the truth -0.07, the policy's own -0.71.
    gamma: discount factor of imagined transitions; real ones carry theirs.
    alpha: temperature, fixed unless `tune_alpha` lets it follow a target entropy of `entropy_per_dim` nats per action
        dimension. network: must be the prior's.
    critic_network: body of a new critic. LayerNorm tames extrapolation on little data (RLPD); default as the prior's.
    size: of TD-MPC2's networks; must be the prior's. For it `horizon` is the length of plans and training windows,
        `lr_critic` the rate of all networks, and `train_critic` False makes it SGFT-TDMPC-2: encoder, critic and the
        policy in V_sim stay the simulator's; train_encoder is the ablation that lets the encoder learn.
    plan_samples: sequences that a plan tries in each of its iterations. The planner on SAC's priors, `sgft-mpc`, has
        H = `horizon` too, and `branch_noise` on what the policy proposes.
    plan_rollouts: the real rollouts are plans on the agent's own policy, models and V_sim, as those of `sgft-mpc`, and
        the policy learns from what they meet; it alone acts when it is evaluated or exported.
    explore_noise: std of the noise on what these plans, and those of `sgft-mpc`, do on the real system, in units of the
        action's range. A plan does much the same in the same state, and from such data no model learns what actions do:
        from two small priors success stayed or fell without noise and rose with it (docs/findings.md).
    critics, target_critics, actor_mean, policy_delay, train_critic: see `SACConfig`. A kept critic has two members.
        policy_delay None = the updates of a real transition (`utd`): the actor moves once for each, as in RLPD.
    reset_critic: None = the method's default. A kept critic under a shaped reward is read as Q_sim(s, a) - V_sim(s),
        its exact meaning in simulation.
    critic_warmup: critic-only updates at the start. The first data are the simulator's policy's own: they do not say
        what another action would do, and on pushing an actor that learned from them lost 12 points of success before it
        gained 60. None = as many as follow the initial rollouts (0 where nobody knows how many those are); 0 = as
        printed in the paper.
    actor_ramp: updates over which the actor's learning rate then rises from 0, for the same reason.
    train_dynamics: keep fitting the ensemble, on real transitions only.
    actor_real_only: the actor learns from the real rows, the critic from all (O-11).
    lr_warmup: updates over which the rates of an agent that comes from the simulator rise linearly from 0: of all that
        learns in one of TD-MPC2, of a kept critic; what is new learns at full rate. Adam's first steps are as long as
        its rate in every weight, however small the gradient: 40 of them, after one rollout, took plans that pushed a
        towel home in 93 % of all episodes to 4. SAC, MBPO and TD-MPC2 gain as much from the rise as SGFT, whose critics
        of several steps it only delays (docs/ablations.md). None = the updates of the first 1,000 real transitions.
    dynamics_warmup: the same for dynamics models that stand alone.
    lr_*: other Adam learning rates. tau: target averaging rate. max_grad_norm: None = no clipping.
    simulated_share: share of each batch that is drawn from the simulator's transitions instead of the real ones; it
        goes linearly to `simulated_share_end` (None = stays) over `simulated_anneal` updates.
    simulated_transitions: how many of them there are: whole episodes of the prior's policy in the training domain,
        more and more of its actions replaced by random ones from the first episode to the last, up to a share of
        `simulated_ladder`, as where the fleet of pretraining ends.
    relabel_simulated: instead, each batch gets as many of them as it has real ones, with the successors, rewards and
        ends that the models expect, which are fitted on real data; branches begin there and the actor learns there too.
        What a plan asks the models about where it is, a policy then learns wherever the simulator's policies have been.
    offline_updates: updates on the simulator's transitions alone, before the first real rollout.
    expectile, beta, reward_scale: IQL's; see `IQLHyper`. reward_scale None = episode length / (best - worst return) of
        the simulator's episodes, as the authors scale theirs.
    clip_shaped: bound on |r_bar|. V_sim falls off a cliff where a task can be lost for good (a puck over the edge): one
        such row outweighs a thousand others in a squared error, and its sign is all a policy needs. None = as printed.
    replay_capacity: transitions; 20,000 hold 400 episodes of 50 steps, more than an hour of a real robot.
    """

    horizon: int = 1
    branches: int = 5
    branch_noise: float = 0.5
    batch_size: int = 256
    gamma: float = 0.99
    alpha: float = 0.01
    tune_alpha: bool = False
    entropy_per_dim: float = -1.0
    network: NetworkConfig = field(default_factory=NetworkConfig)
    critic_network: NetworkConfig | None = None
    critics: int = 2
    target_critics: int | None = None
    actor_mean: bool = False
    policy_delay: int | None = 1
    train_critic: bool = True
    size: str = "5M"
    plan_samples: int = 512
    plan_rollouts: bool = False
    explore_noise: float = 0.4
    train_encoder: bool = False
    reset_critic: bool | None = None
    critic_warmup: int | None = None
    actor_ramp: int = 1000
    train_dynamics: bool = True
    actor_real_only: bool = True
    lr_warmup: int | None = None
    dynamics_warmup: int | None = None
    lr_actor: float = 1e-4
    lr_critic: float = 3e-4
    lr_dynamics: float = 3e-4
    tau: float = 0.005
    max_grad_norm: float | None = None
    clip_shaped: float | None = 2.0
    replay_capacity: int = 20_000
    simulated_share: float = 0.0
    simulated_share_end: float | None = None
    simulated_anneal: int = 10_000
    simulated_transitions: int = 200_000
    simulated_ladder: float = 0.6
    relabel_simulated: bool = False
    offline_updates: int = 0
    expectile: float = 0.7
    beta: float = 3.0
    reward_scale: float | None = None

    def __post_init__(self) -> None:
        for name in ("horizon", "branches", "batch_size", "replay_capacity", "simulated_anneal"):
            if getattr(self, name) < 1:
                raise UserError(f"fine-tuning option {name} is {getattr(self, name)}: must be at least 1")
        for name in ("lr_warmup", "dynamics_warmup"):
            if (getattr(self, name) or 0) < 0:
                raise UserError(f"fine-tuning option {name} is {getattr(self, name)}: must not be negative")
        if self.relabel_simulated and self.simulated_share:
            raise UserError("fine-tuning options relabel_simulated and simulated_share exclude each other: choose one")
        for name in ("simulated_share", "simulated_share_end", "simulated_ladder"):
            if not 0 <= (getattr(self, name) or 0.0) <= 1:
                raise UserError(f"fine-tuning option {name} is {getattr(self, name)}: must be a share from 0 to 1")
        if self.offline_updates and not self.simulated_share:
            raise UserError("fine-tuning option offline_updates needs the simulator's transitions: set simulated_share")

    @property
    def needs_simulation(self) -> bool:
        """Whether the learner draws from the simulator's transitions."""
        return self.simulated_share > 0 or self.relabel_simulated


class Method(NamedTuple):
    """One row of the comparison.

    transforms(horizon, branches, noise) -> the batch transforms in order; for branches and noise see `branch`.
    finite_horizon: the agent is told the steps to go (for horizon > 1). reset_critic: default at transfer.
    uses_value, uses_dynamics: what its transforms take from the prior besides the agent.
    agent: the learner. fresh: it starts from nothing, and the simulator's policy only makes the initial rollouts.
    utd: updates per real transition. options: where its `FinetuneConfig` differs from the defaults, by field.
    space: what tuning may choose (experiments/tune.py): values for `utd` and for fields of `FinetuneConfig`.
    """

    name: str
    description: str
    source: str
    transforms: Callable[[int, int, float | Array], tuple[BatchTransform, ...]]
    finite_horizon: bool
    uses_value: bool
    uses_dynamics: bool
    reset_critic: bool
    agent: AgentName
    fresh: bool
    utd: float
    options: Mapping[str, Any]
    space: Mapping[str, tuple[Any, ...]]

    @property
    def prior(self) -> str:
        """The algorithm of the priors it starts from: sac or tdmpc2."""
        return "tdmpc2" if self.agent == "tdmpc2" else "sac"

    @property
    def parts(self) -> tuple[str, ...]:
        """Its transforms by name, in order, as this table has them."""
        has = {"branch": self.uses_dynamics, "shape": self.uses_value, "shorten": self.finite_horizon}
        return tuple(name for name, there in has.items() if there)

    @property
    def needs(self) -> str:
        """What it takes from the prior, in words. Agent: policy, critic and observation statistics."""
        if self.agent == "tdmpc2":
            return "TD-MPC2"
        plans = self.agent == "mpc"
        has = {
            "agent": not self.fresh,
            "V_sim": self.uses_value or plans,
            "models": self.uses_dynamics or plans,
            "policy for data": finetune_config(self).needs_simulation,
        }
        return ", ".join(name for name, there in has.items() if there)

    @property
    def pilot(self) -> "Method":
        """The method whose agent is the simulator's policy until it learns; what critic it has does not matter."""
        return METHODS["tdmpc2" if self.agent == "tdmpc2" else "sac-reset"]


def _method(
    name: str,
    parts: str,
    description: str,
    source: str,
    *,
    reset_critic: bool = False,
    agent: AgentName = "sac",
    fresh: bool = False,
    utd: float = 8.0,
    space: Mapping[str, tuple[Any, ...]],
    **options: Any,
) -> Method:
    finite = "shorten" in parts

    def transforms(horizon: int, branches: int, noise: float | Array) -> tuple[BatchTransform, ...]:
        built: dict[str, Callable[[], BatchTransform]] = {
            "branch": lambda: branch(horizon, branches, noise=noise, segments=finite),
            "shape": lambda: shape,
            "shorten": lambda: shorten(horizon),
        }
        return tuple(built[part]() for part in parts.split())

    uses = ("shape" in parts, "branch" in parts)
    return Method(name, description, source, transforms, finite, *uses, reset_critic, agent, fresh, utd, options, space)


METHODS: dict[str, Method] = {
    m.name: m
    for m in (
        _method("sac", "", "task reward, critic kept", "Haarnoja 2018", space=_PLAIN_SPACE),
        _method("sac-reset", "", "task reward, new critic", "Haarnoja 2018", reset_critic=True, space=_PLAIN_SPACE),
        _method(
            "pbrs", "shape", "shaped reward, infinite horizon", "Ng 1999", reset_critic=True, space=_PLAIN_SPACE,
        ),
        _method("mbpo", "branch", "SAC with model branches", "Janner 2019", space=_BRANCH_SPACE),
        _method(
            "pbrs-branch", "branch shape",
            "shaped reward and branches, infinite horizon: SGFT-SAC without shortening", "SGFT 2025", reset_critic=True,
            space=_BRANCH_SPACE,
        ),
        _method(
            "frozen-critic", "", "the actor alone learns, from the simulator's critic", "SGFT 2025, reviews",
            train_critic=False, critic_warmup=0,
            space={"utd": _UTD, "lr_actor": _RATES["lr_actor"], "alpha": _PLAIN_SPACE["alpha"],
                   "actor_ramp": (0, 1_000, 5_000), "batch_size": (128, 256, 512)},
        ),
        _method(
            "sac-online", "", "SAC from kept networks and simulator data, many critic updates a slow actor update",
            "As 2026", utd=5.0, lr_actor=1e-5, policy_delay=20, actor_mean=True, simulated_share=0.5,
            simulated_share_end=0.0, simulated_anneal=10_000, critic_warmup=0, actor_ramp=0, lr_warmup=0,
            space={"utd": (2.0, 5.0, 10.0), "lr_actor": (1e-5, 3e-5, 1e-4), "lr_critic": _RATES["lr_critic"],
                   "policy_delay": (5, 10, 20), "simulated_share": _SHARE},
        ),
        _method(
            "rlpd", "", "from scratch; ten normalised critics, half of each batch from the simulator", "Ball 2023",
            fresh=True, utd=20.0, lr_actor=3e-4, policy_delay=None, critics=10, target_critics=2, actor_mean=True,
            critic_network=NetworkConfig(hidden=(256, 256), layer_norm=True),
            # The temperature begins at the default's 0.01, as on real robots (SERL, Luo et al. 2024). From RLPD's own 1
            # a few thousand updates do not bring it down: pushing ended at 0.4, and at no success.
            tune_alpha=True, entropy_per_dim=-0.5, simulated_share=0.5, critic_warmup=0, actor_ramp=0,
            space={"utd": (10.0, 20.0, 40.0), "lr_actor": (1e-4, 3e-4, 1e-3), "lr_critic": _RATES["lr_critic"],
                   "target_critics": (1, 2, 10), "simulated_share": _SHARE},
        ),
        _method(
            "iql", "", "in-sample learning: offline from the simulator, then online", "Kostrikov 2022",
            agent="iql", fresh=True, lr_actor=3e-4, simulated_share=0.5, simulated_transitions=1_000_000,
            offline_updates=500_000, critic_warmup=0, actor_ramp=0,
            space={"utd": _UTD, "lr_actor": (1e-4, 3e-4, 1e-3), "expectile": (0.7, 0.8, 0.9), "beta": (1.0, 3.0, 10.0),
                   "simulated_share": _SHARE},
        ),
        _method(
            "tdmpc2", "", "plans with the simulator's world model, and all of it learns", "Hansen 2024",
            agent="tdmpc2", utd=1.0, horizon=4, tau=0.01, space=_PLANNER_SPACE,
        ),
        _method(
            "sgft-tdmpc2-code", "shape", "SGFT as its released code has it: TD-MPC2 from scratch, shaped rewards",
            "SGFT 2025, code", agent="tdmpc2", fresh=True, utd=1.0, horizon=3, tau=0.01, space=_PLANNER_SPACE,
        ),
        _method(
            "sgft-tdmpc2", "", "SGFT-TDMPC-2: plans of H steps that end in a frozen V_sim", "SGFT 2025",
            agent="tdmpc2", utd=1.0, horizon=4, tau=0.01, train_critic=False, space=_PLANNER_SPACE,
        ),
        _method(
            "sgft-mpc", "", "MPC-SGFT: plans of H steps by SAC's prior's models, which learn, that end in V_sim",
            # Models whose rates rise are better on insert, but worse on push and hammer (docs/ablations.md).
            "SGFT 2025", agent="mpc", plan_samples=128, dynamics_warmup=0, space=_MODEL_SPACE,
        ),
        # Their critics are never asked beyond H steps, where V_sim stands, so they need no protection (lr_warmup).
        _method("sgft", "shape shorten", "model-free SGFT", "SGFT 2025", lr_warmup=0, space=_SEGMENT_SPACE),
        # The relabelled rows know of all kinds of actions from the first update on, so the actor need not wait.
        _method(
            "sgft-relabel", "branch shape shorten",
            "SGFT-SAC that also learns at the simulator's states, with what the fitted models expect there",
            "SGFT 2025, ours", horizon=4, branches=2, lr_warmup=0, relabel_simulated=True, critic_warmup=0,
            space=_BRANCH_SPACE,
        ),
        _method(
            "sgft-sac", "branch shape shorten", "SGFT-SAC", "SGFT 2025", horizon=4, branches=2, lr_warmup=0,
            space=_BRANCH_SPACE,
        ),
    )
}  # fmt: skip


def get_method(name: str) -> Method:
    """The method of that name, or the `METHOD` of a Python file or module of your own (docs/extending.md).

    UserError lists what exists and guesses what was meant, or says what is wrong with the file.
    """
    if name in METHODS:
        return METHODS[name]
    if not extend.is_source(name):
        raise UserError(f"{unknown('method', name, METHODS)}; or name a file, e.g. my_{name}.py")
    method = extend.load("method", name, "METHOD").METHOD
    if not isinstance(method, Method):
        raise UserError(f"method {name}: METHOD is a {type(method).__name__}, not a sgft_jax.Method")
    if method.name in METHODS or not re.fullmatch(r"[\w-]+", method.name):
        raise UserError(f"method {name}: the name {method.name!r} is taken or names no folder; choose another")
    return method


def finetune_config(method: Method, **changes: Any) -> FinetuneConfig:
    """The options that a method's authors use, where ours have them, and any changes to these."""
    return FinetuneConfig(**{**method.options, **changes})


def check_options(method: Method, config: FinetuneConfig) -> None:
    """Raises UserError for options that ask for what the method lacks."""
    if config.plan_rollouts and not (method.uses_value and method.uses_dynamics):
        raise UserError(f"fine-tuning option plan_rollouts needs branches and shaped rewards: not with {method.name}")
    if config.relabel_simulated and not method.uses_dynamics:
        raise UserError(f"fine-tuning option relabel_simulated needs branches: not with {method.name}")


def lr_warmup(config: FinetuneConfig, utd: float) -> int:
    """Updates over which the rates of the simulator's agent rise where there are `utd` of them per real transition."""
    return _rise(config.lr_warmup, utd)


def dynamics_warmup(config: FinetuneConfig, utd: float) -> int:
    """The same for its dynamics models."""
    return _rise(config.dynamics_warmup, utd)


def _rise(updates: int | None, utd: float) -> int:
    return round(_WARM_TRANSITIONS * utd) if updates is None else updates


def policy_delay(config: FinetuneConfig, utd: float) -> int:
    """Critic updates per update of the actor where there are `utd` updates per real transition."""
    return max(round(utd), 1) if config.policy_delay is None else config.policy_delay


def default_settings(method: Method) -> dict[str, Any]:
    """What the options of a method's space are unless told otherwise."""
    own = finetune_config(method)
    return {name: method.utd if name == "utd" else getattr(own, name) for name in method.space}
