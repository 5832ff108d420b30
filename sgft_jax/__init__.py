"""Simulation-Guided Fine-Tuning in JAX: learners, batch transforms and priors as pure functions of pytrees.

docs/api.md lists what is here. Tasks, worlds and episodes are in the package `envs`.
"""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):  # MJX announces on stdout that the optional Warp backend is absent
    import mujoco.mjx as _mjx  # noqa: F401

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
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.planning.mpc import MPCConfig
from sgft_jax.players import Player, mpc_player, sac_player, tdmpc2_player
from sgft_jax.transforms import branch, compose, shape, shaped_reward, shorten
from sgft_jax.types import BatchTransform, Finetuner, Imagination, Learner, Normalizer, Prior, Transition, UserError

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
