from .data import replay, sequences, sources
from .finetuner import FinetuneState, Parts, assemble, sac_finetuner
from .learners.iql import IQLConfig, IQLHyper, IQLState, make_iql
from .learners.sac import SACConfig, SACHyper, SACParams, SACState, extract_params, make_sac, state_from_prior
from .learners.tdmpc2 import TDMPC2Config, TDMPC2Hyper, TDMPC2Params, TDMPC2State, make_tdmpc2
from .methods import all_methods, get_method
from .models import normalizer
from .models.config import NetworkConfig
from .planning.mpc import MPCConfig
from .policies import make_policy, mpc_policy, sac_policy, tdmpc2_policy
from .systems import System
from .systems.simulated import Simulated
from .train import FinetuneProgress, evaluate, finetune, simulate
from .transforms import branch, clip, compose, relabel, shape, shaped_reward, shorten, stateless
from .types import (
    Batch,
    Finetuner,
    Imagination,
    Learner,
    Method,
    Normalizer,
    Policy,
    Prior,
    SimulatedData,
    Simulation,
    Source,
    Task,
    Transform,
    Transition,
    UserError,
)

__all__ = [
    "Batch",
    "FinetuneProgress",
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
    "Parts",
    "Policy",
    "Prior",
    "SACConfig",
    "SACHyper",
    "SACParams",
    "SACState",
    "Simulated",
    "SimulatedData",
    "Simulation",
    "Source",
    "System",
    "TDMPC2Config",
    "TDMPC2Hyper",
    "TDMPC2Params",
    "TDMPC2State",
    "Task",
    "Transform",
    "Transition",
    "UserError",
    "all_methods",
    "assemble",
    "branch",
    "clip",
    "compose",
    "evaluate",
    "extract_params",
    "finetune",
    "get_method",
    "make_iql",
    "make_policy",
    "make_sac",
    "make_tdmpc2",
    "mpc_policy",
    "normalizer",
    "relabel",
    "replay",
    "sac_finetuner",
    "sac_policy",
    "sequences",
    "shape",
    "shaped_reward",
    "shorten",
    "simulate",
    "sources",
    "state_from_prior",
    "stateless",
    "tdmpc2_policy",
]
