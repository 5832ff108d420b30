"""What tuning chooses from: of every method five of its options with three values each.

The options are those that the method's authors name as sensitive, or our own measurements do (docs/history.md). The
spaces are equally large, so that the same number of trials searches the same share of each. The default is among the
three values; the others are published ones of close relatives, or lie a factor of two to three away. Nothing that
decides what a method is can be chosen.
"""

from typing import Any

from sgft_jax.methods import get_method
from sgft_jax.types import UserError

_UTD = (2.0, 8.0, 20.0)  # from an update or two per step to RLPD's and MBPO's twenty
_RATES = {"lr_actor": (3e-5, 1e-4, 3e-4), "lr_critic": (1e-4, 3e-4, 1e-3)}
_WARMUP = (None, 0, 5_000)  # as long as argued here, as printed in the paper, longer
_SHARE = (0.25, 0.5, 0.75)
_PLAIN = {"utd": _UTD, **_RATES, "alpha": (0.003, 0.01, 0.03), "critic_warmup": _WARMUP}
_BRANCH = {"utd": _UTD, **_RATES, "horizon": (1, 2, 4), "branches": (2, 5, 10)}
_PLANNER = {
    "utd": (1.0, 2.0, 4.0), "lr": (1e-4, 3e-4, 1e-3), "horizon": (2, 3, 4), "batch_size": (128, 256, 512),
    "plan_samples": (256, 512, 1024),
}  # fmt: skip

SPACES: dict[str, dict[str, tuple[Any, ...]]] = {
    "sac": _PLAIN,
    "anchored": {"utd": _UTD, **_RATES, "anchor": (0.03, 0.1, 0.3), "simulated_share": _SHARE},
    "sac-reset": _PLAIN,
    "pbrs": _PLAIN,
    "mbpo": _BRANCH,
    "pbrs-branch": _BRANCH,
    "sgft-sac": _BRANCH,
    "sgft-relabel": _BRANCH,
    "sgft-parts": _BRANCH,
    "sgft": {"utd": _UTD, **_RATES, "horizon": (1, 2, 4), "critic_warmup": _WARMUP},
    "frozen-critic": {
        "utd": _UTD, "lr_actor": _RATES["lr_actor"], "alpha": _PLAIN["alpha"], "actor_ramp": (0, 1_000, 5_000),
        "batch_size": (128, 256, 512),
    },
    "sac-online": {
        "utd": (2.0, 5.0, 10.0), "lr_actor": (1e-5, 3e-5, 1e-4), "lr_critic": _RATES["lr_critic"],
        "policy_delay": (5, 10, 20), "simulated_share": _SHARE,
    },
    "rlpd": {
        "utd": (10.0, 20.0, 40.0), "lr_actor": (1e-4, 3e-4, 1e-3), "lr_critic": _RATES["lr_critic"],
        "target_critics": (1, 2, 10), "simulated_share": _SHARE,
    },
    "iql": {
        "utd": _UTD, "lr_actor": (1e-4, 3e-4, 1e-3), "expectile": (0.7, 0.8, 0.9), "beta": (1.0, 3.0, 10.0),
        "simulated_share": _SHARE,
    },
    "tdmpc2": _PLANNER,
    "sgft-tdmpc2": _PLANNER,
    "sgft-tdmpc2-code": _PLANNER,
    "sgft-mpc": {
        "utd": _UTD, "lr_dynamics": (1e-4, 3e-4, 1e-3), "horizon": (1, 2, 4), "plan_noise": (0.25, 0.5, 1.0),
        "plan_samples": (64, 128, 256),
    },
}  # fmt: skip


def space_of(method: str) -> dict[str, tuple[Any, ...]]:
    """The options of a method that tuning may choose; raises UserError for a method without a space."""
    if method not in SPACES:
        raise UserError(f"--methods {method}: experiments/spaces.py says nothing of what to tune; add a line for it")
    return SPACES[method]


def defaults(method: str) -> dict[str, Any]:
    """What these options are unless somebody chooses."""
    config = get_method(method).config()
    return {name: getattr(config, name) for name in space_of(method)}
