from .api import ActingPolicy, Setup, evaluate_prior, finetuned_priors, load_policy, make_env, setup
from .data import replay, sequences, sources
from .export.folder import save_exported
from .io.priors import load_prior, save_prior
from .learners.iql import IQLConfig, IQLHyper, IQLState, make_iql
from .learners.sac import SACConfig, SACHyper, SACParams, SACState, extract_params, make_sac, state_from_prior
from .learners.tdmpc2 import TDMPC2Config, TDMPC2Hyper, TDMPC2Params, TDMPC2State, make_tdmpc2
from .methods import all_methods, get_method
from .models import normalizer
from .models.config import NetworkConfig
from .models.ratio import RatioConfig
from .planning.mpc import MPCConfig
from .policies import make_policy, mpc_policy, sac_policy, tdmpc2_policy
from .presets import PRESETS, PretrainConfig
from .systems import System
from .systems.gymnasium import Gymnasium
from .systems.remote import Remote
from .systems.simulated import Simulated
from .train.finetuner import FinetuneState, Parts, assemble, sac_finetuner
from .train.finetuning import FinetuneProgress, evaluate, finetune, simulate
from .train.pretraining import pretrain, priors_of
from .transforms import branch, clip, compose, relabel, shape, shaped_reward, shorten, stateless, weigh
from .types import (
    Batch,
    Finetuner,
    Fixed,
    HybridAgent,
    Imagination,
    Learner,
    Method,
    Normalizer,
    Online,
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
    "PRESETS", "ActingPolicy", "Batch", "FinetuneProgress", "FinetuneState", "Finetuner", "Fixed", "Gymnasium",
    "HybridAgent", "IQLConfig", "IQLHyper", "IQLState", "Imagination", "Learner", "MPCConfig", "Method",
    "NetworkConfig", "Normalizer", "Online", "Parts",
    "Policy", "PretrainConfig", "Prior", "RatioConfig", "Remote", "SACConfig", "SACHyper",
    "SACParams", "SACState", "Setup", "Simulated", "SimulatedData", "Simulation", "Source", "System",
    "TDMPC2Config", "TDMPC2Hyper", "TDMPC2Params", "TDMPC2State", "Task", "Transform", "Transition", "UserError",
    "all_methods", "assemble", "branch", "clip", "compose", "evaluate", "evaluate_prior", "extract_params",
    "finetune", "finetuned_priors", "get_method", "load_policy", "load_prior", "make_env", "make_iql", "make_policy",
    "make_sac", "make_tdmpc2", "mpc_policy", "normalizer", "pretrain", "priors_of", "relabel", "replay",
    "sac_finetuner", "sac_policy", "save_exported", "save_prior", "sequences", "setup", "shape", "shaped_reward",
    "shorten", "simulate", "sources", "state_from_prior", "stateless", "tdmpc2_policy", "weigh",
]  # fmt: skip
