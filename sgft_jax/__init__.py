"""Simulation-Guided Fine-Tuning in JAX: learners, batch transforms and priors as pure functions of pytrees."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):  # MJX announces on stdout that the optional Warp backend is absent
    import mujoco.mjx as _mjx  # noqa: F401

from sgft_jax.finetune import FinetuneConfig, Finetuner, FinetuneState, make_finetuner
from sgft_jax.methods import METHODS, Method, get_method
from sgft_jax.networks import NetworkConfig
from sgft_jax.sac import SACConfig, SACHyper, SACState, extract_prior, fine_tune_state, make_sac
from sgft_jax.sgft import branch, compose, shape, shorten
from sgft_jax.types import Imagination, Learner, Normalizer, Prior, Transition, UserError

__all__ = [
    "METHODS",
    "FinetuneConfig",
    "FinetuneState",
    "Finetuner",
    "Imagination",
    "Learner",
    "Method",
    "NetworkConfig",
    "Normalizer",
    "Prior",
    "SACConfig",
    "SACHyper",
    "SACState",
    "Transition",
    "UserError",
    "branch",
    "compose",
    "extract_prior",
    "fine_tune_state",
    "get_method",
    "make_finetuner",
    "make_sac",
    "shape",
    "shorten",
]
