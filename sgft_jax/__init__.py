"""Simulation-Guided Fine-Tuning in JAX: learners, batch transforms and priors as pure functions of pytrees."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):  # MJX announces on stdout that the optional Warp backend is absent
    import mujoco.mjx as _mjx  # noqa: F401

from sgft_jax.finetune import FinetuneState, make_finetuner
from sgft_jax.iql import IQLConfig, IQLHyper, IQLState, make_iql
from sgft_jax.methods import METHODS, FinetuneConfig, Method, finetune_config, get_method
from sgft_jax.networks import NetworkConfig
from sgft_jax.sac import SACConfig, SACHyper, SACState, extract_prior, fine_tune_state, make_sac
from sgft_jax.sequences import Sequences
from sgft_jax.sgft import branch, compose, shape, shorten
from sgft_jax.tdmpc2 import TDMPC2Config, TDMPC2Hyper, TDMPC2Prior, TDMPC2State, make_tdmpc2
from sgft_jax.types import Finetuner, Imagination, Learner, Normalizer, Prior, Transition, UserError

__all__ = [
    "METHODS",
    "FinetuneConfig",
    "FinetuneState",
    "Finetuner",
    "IQLConfig",
    "IQLHyper",
    "IQLState",
    "Imagination",
    "Learner",
    "Method",
    "NetworkConfig",
    "Normalizer",
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
    "compose",
    "extract_prior",
    "fine_tune_state",
    "finetune_config",
    "get_method",
    "make_finetuner",
    "make_iql",
    "make_sac",
    "make_tdmpc2",
    "shape",
    "shorten",
]
