"""Simulation-Guided Fine-Tuning in JAX: learners, batch transforms and priors as pure functions of pytrees.

docs/api.md lists what is here. Tasks, worlds and episodes are in the package `envs`. A name is imported when it is
first used, so that a program which only reads its command line starts neither JAX nor MuJoCo.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sgft_jax.agents import Agent, make_agent
    from sgft_jax.data import replay, sequences
    from sgft_jax.data.sequences import Sequences
    from sgft_jax.finetune import FinetuneState, make_finetuner
    from sgft_jax.io import checkpoint
    from sgft_jax.learners.iql import IQLConfig, IQLHyper, IQLState, make_iql
    from sgft_jax.learners.sac import SACConfig, SACHyper, SACState, extract_prior, fine_tune_state, make_sac
    from sgft_jax.learners.tdmpc2 import TDMPC2Config, TDMPC2Hyper, TDMPC2Prior, TDMPC2State, make_tdmpc2
    from sgft_jax.methods import METHODS, FinetuneConfig, Method, finetune_config, get_method
    from sgft_jax.models import normalizer
    from sgft_jax.models.config import NetworkConfig
    from sgft_jax.planning.mpc import MPCConfig
    from sgft_jax.players import Player, mpc_player, sac_player, tdmpc2_player
    from sgft_jax.transforms import branch, compose, shape, shaped_reward, shorten
    from sgft_jax.types import BatchTransform, Finetuner, Imagination, Learner, Normalizer, Prior, Transition, UserError

_MODULES = {
    "agents": "Agent make_agent",
    "data": "replay sequences",
    "data.sequences": "Sequences",
    "finetune": "FinetuneState make_finetuner",
    "io": "checkpoint",
    "learners.iql": "IQLConfig IQLHyper IQLState make_iql",
    "learners.sac": "SACConfig SACHyper SACState extract_prior fine_tune_state make_sac",
    "learners.tdmpc2": "TDMPC2Config TDMPC2Hyper TDMPC2Prior TDMPC2State make_tdmpc2",
    "methods": "METHODS FinetuneConfig Method finetune_config get_method",
    "models": "normalizer",
    "models.config": "NetworkConfig",
    "planning.mpc": "MPCConfig",
    "players": "Player mpc_player sac_player tdmpc2_player",
    "transforms": "branch compose shape shaped_reward shorten",
    "types": "BatchTransform Finetuner Imagination Learner Normalizer Prior Transition UserError",
}
_HOME = {name: f"{__name__}.{module}" for module, names in _MODULES.items() for name in names.split()}

__all__ = [
    "METHODS",
    "Agent",
    "BatchTransform",
    "FinetuneConfig",
    "FinetuneState",
    "Finetuner",
    "IQLConfig",
    "IQLHyper",
    "IQLState",
    "Imagination",
    "Learner",
    "MPCConfig",
    "Method",
    "NetworkConfig",
    "Normalizer",
    "Player",
    "Prior",
    "SACConfig",
    "SACHyper",
    "SACState",
    "Sequences",
    "TDMPC2Config",
    "TDMPC2Hyper",
    "TDMPC2Prior",
    "TDMPC2State",
    "Transition",
    "UserError",
    "branch",
    "checkpoint",
    "compose",
    "extract_prior",
    "fine_tune_state",
    "finetune_config",
    "get_method",
    "make_agent",
    "make_finetuner",
    "make_iql",
    "make_sac",
    "make_tdmpc2",
    "mpc_player",
    "normalizer",
    "replay",
    "sac_player",
    "sequences",
    "shape",
    "shaped_reward",
    "shorten",
    "tdmpc2_player",
]


def __getattr__(name: str) -> Any:
    """Import a public name from its module (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = importlib.import_module(_HOME[name])
    if not hasattr(home, name):  # a module of a package
        importlib.import_module(f"{_HOME[name]}.{name}")
    globals()[name] = value = getattr(home, name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
