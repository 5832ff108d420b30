"""What tuning chooses from: of every method five to seven of its options with two or three values each.

The options are those that the method's authors name as sensitive, or our own measurements do (docs/lessons.md): warm-up
of the critic is among them wherever a method has it, except for `guarded`, which the guard protects instead. The
spaces have 243 to 324 settings, so that the same number of trials searches about the same share of each. The default is
among the values; the others are published ones of close relatives, switch off what the method's authors do not have, or
lie a factor of two to three away. Nothing that decides what a method is can be chosen.
"""

from typing import Any

from envs.types import UserError
from sgft_jax.methods import get_method

_UTD = (2.0, 8.0, 20.0)  # from an update or two per step to RLPD's and MBPO's twenty
_ACTOR, _CRITIC = (3e-5, 1e-4, 3e-4), (1e-4, 3e-4, 1e-3)  # rates
_RATES = {"lr_actor": _ACTOR, "lr_critic": _CRITIC}
_WARMUP = (None, 0, 5_000)  # as long as argued here, as printed in the paper, longer
_SWITCHED = {"critic_warmup": (None, 0), "lr_warmup": (None, 0)}  # as argued here, or none
_ALPHA = (0.003, 0.01, 0.03)
_SHARE = {"simulated_share": (0.25, 0.5, 0.75)}
_BATCH = {"batch_size": (128, 256, 512)}
_SHORT = {"utd": _UTD, **_RATES, "horizon": (1, 2, 4), **_SWITCHED}
_SHAPED = {"utd": _UTD, "lr_actor": (1e-4, 3e-4), "lr_critic": _CRITIC, "reset_critic": (True, False), **_SWITCHED}
_PLANNER = {"utd": (1.0, 2.0, 8.0), "lr": _CRITIC, "horizon": (2, 3, 4), **_BATCH, "plan_samples": (256, 512, 1024)}
_TDMPC2 = {**_PLANNER, "utd": (1.0, 8.0), "lr_warmup": (None, 0)}  # 8 and none are what `sgft-mpc` has

SPACES: dict[str, dict[str, tuple[Any, ...]]] = {
    "sac": {"utd": (1.0, 2.0, 8.0), **_RATES, "critic_warmup": _WARMUP, "lr_warmup": (None, 0, 1_000)},
    "guarded": {"utd": _UTD, **_RATES, "anchor": (0.0, 0.03, 0.1), **_SHARE},
    "sac-reset": {"utd": _UTD, **_RATES, "alpha": _ALPHA, "critic_warmup": _WARMUP},
    "pbrs": {**_SHAPED, "clip_shaped": (None, 2.0)},
    "mbpo": _SHORT,
    "pbrs-branch": {**_SHAPED, "horizon": (1, 4)},
    "sgft-sac": _SHORT,
    "sgft-relabel": _SHORT,
    "sgft-parts": _SHORT,
    "sgft": _SHORT,
    "frozen-critic": {"utd": _UTD, "lr_actor": _ACTOR, "alpha": _ALPHA, "actor_ramp": (0, 1_000, 5_000), **_BATCH},
    "sac-online": {
        "utd": (2.0, 5.0, 10.0),
        "lr_actor": (1e-5, 3e-5, 1e-4),
        "lr_critic": _CRITIC,
        **_SHARE,
        **_SWITCHED,
    },
    "rlpd": {"utd": (10.0, 20.0, 40.0), "lr_actor": _CRITIC, "lr_critic": _CRITIC, "target_critics": (1, 2), **_SHARE}
    | {"critic_warmup": (None, 0)},
    "iql": {"utd": _UTD, "lr_actor": _CRITIC, "expectile": (0.7, 0.8, 0.9), "beta": (1.0, 3.0, 10.0), **_SHARE},
    "tdmpc2": _TDMPC2,
    "sgft-tdmpc2": _TDMPC2,
    "sgft-tdmpc2-code": _PLANNER,
    "sgft-mpc": {"utd": _UTD, "lr_dynamics": _CRITIC, "horizon": (1, 2, 4), "plan_noise": (0.25, 0.5, 1.0)}
    | {"plan_samples": (64, 128, 256)},
}

# Tried before others, if there are trials enough: what papers print, what practice here has shown.
_COLD = {"critic_warmup": 0, "lr_warmup": 0}
_AS_PRINTED = {"reset_critic": True, "clip_shaped": None, "branch_noise": 0.0, **_COLD}
_AS_PRINTED |= {"dynamics_warmup": 0, "actor_ramp": 0}
FIRST: dict[str, tuple[dict[str, Any], ...]] = {
    "guarded": ({"anchor": 0.1}, {"utd": 1.0}),
    "sac": ({"utd": 8.0}, _COLD),
    "mbpo": ({"horizon": 4}, {"utd": 1.0}, _COLD),
    "pbrs": ({"reset_critic": True}, {"clip_shaped": 2.0, "reset_critic": True}),
    "sgft-sac": ({"horizon": 1, **_AS_PRINTED}, {"utd": 1.0}, _AS_PRINTED),
    "rlpd": ({"lr_critic": 3e-4, "target_critics": 2}, {"utd": 10.0, "critic_warmup": None}),
    "sac-online": ({"utd": 5.0, "lr_actor": 1e-5, "lr_critic": 3e-4, "lr_warmup": 0}, {"critic_warmup": None}),
    "tdmpc2": ({"utd": 8.0}, {"lr_warmup": 0}, {"utd": 8.0, "lr_warmup": 0}),
}


def space_of(method: str) -> dict[str, tuple[Any, ...]]:
    """The options of a method that tuning may choose; raises UserError for a method without a space."""
    if method not in SPACES:
        raise UserError(f"--methods {method}: studies/spaces.py says nothing of what to tune; add a line for it")
    return SPACES[method]


def first(method: str) -> list[dict[str, Any]]:
    """The settings of the first trials: the defaults, then those of `FIRST`."""
    config, named = get_method(method).config(), FIRST.get(method, ())
    names = dict.fromkeys([*space_of(method), *(name for settings in named for name in settings)])
    default = {name: getattr(config, name) for name in names}
    return [default | settings for settings in ({}, *named)]
