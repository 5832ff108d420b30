from . import learners
from .algorithms import make_policy
from .api import ActingPolicy, Setup, evaluate_prior, finetuned_priors, load_policy, make_env, setup
from .data import replay, sequences, sources
from .export.exported import save_exported
from .io.priors import load_prior, save_prior
from .methods import all_methods, get_method
from .models import dynamics, normalizer, ratio, value
from .models.config import NetworkConfig
from .models.ratio import RatioConfig
from .planning import MPCConfig
from .policies import mpc_policy, sac_policy, tdmpc2_policy
from .presets import PRESETS, PretrainConfig
from .systems.gymnasium import Gymnasium
from .systems.remote import Remote
from .systems.simulated import Simulated, System
from .train import guard
from .train.finetuner import FinetuneState, Parts, assemble, sac_finetuner
from .train.finetuning import FinetuneProgress, evaluate, finetune
from .train.fleet import FleetState
from .train.pretraining import pretrain, priors_of
from .train.simulation import simulate
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
    "PRESETS",
    "ActingPolicy",
    "Batch",
    "FinetuneProgress",
    "FinetuneState",
    "Finetuner",
    "Fixed",
    "FleetState",
    "Gymnasium",
    "HybridAgent",
    "Imagination",
    "Learner",
    "MPCConfig",
    "Method",
    "NetworkConfig",
    "Normalizer",
    "Online",
    "Parts",
    "Policy",
    "PretrainConfig",
    "Prior",
    "RatioConfig",
    "Remote",
    "Setup",
    "Simulated",
    "SimulatedData",
    "Simulation",
    "Source",
    "System",
    "Task",
    "Transform",
    "Transition",
    "UserError",
    "all_methods",
    "assemble",
    "branch",
    "clip",
    "compose",
    "dynamics",
    "evaluate",
    "evaluate_prior",
    "finetune",
    "finetuned_priors",
    "get_method",
    "guard",
    "learners",
    "load_policy",
    "load_prior",
    "make_env",
    "make_policy",
    "mpc_policy",
    "normalizer",
    "pretrain",
    "priors_of",
    "ratio",
    "relabel",
    "replay",
    "sac_finetuner",
    "sac_policy",
    "save_exported",
    "save_prior",
    "sequences",
    "setup",
    "shape",
    "shaped_reward",
    "shorten",
    "simulate",
    "sources",
    "stateless",
    "tdmpc2_policy",
    "value",
    "weigh",
]
