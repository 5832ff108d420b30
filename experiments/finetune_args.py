"""What fine-tuning is told: its options, what can be wrong with them, and the folders that follow from them."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import envs
from envs.mujoco.worlds import Impl
from experiments import cli
from experiments.options import seed_list, seeds_name
from sgft_jax.presets import PRESETS
from sgft_jax.io import checkpoint
from sgft_jax.methods import FinetuneConfig, Method, check_options, finetune_config, get_method
from sgft_jax.types import UserError

DEFAULT_METHOD, DEFAULT_PRESET = "sgft-sac", "fast"
VOLATILE = ("resume", "overwrite", "rollouts", "devices", "video", "out", "tuned")  # may differ when a run goes on


@dataclass(frozen=True)
class FinetuneArgs:
    """Fine-tuning of several seeds on one or more real systems at once, all in one compiled program."""

    task: str = "push"
    """push, push-towel, push-ball, hammer or insert; or a Python file with a task of your own (docs/extending.md)."""
    method: str = DEFAULT_METHOD
    """How it learns; the table is at the top. Or a Python file with a method of your own (docs/extending.md). The
    defaults below are those of the method that is chosen."""
    real: tuple[str, ...] = ("default",)
    """The real system: mild, default, hard, or a .toml/.json file with tables `params` and `effects`. Several are
    stepped together in one program, which takes little longer; each has a run folder of its own."""
    set: tuple[str, ...] = ()
    """Changes to it, e.g. --set latency=0.05 action_scale=[1,0.5]; of several, to each."""
    preset: str = DEFAULT_PRESET
    """Pretraining preset whose priors to start from."""
    prior: Path | None = None
    """Folder of a prior, of several (prior/seed-*) or of runs; default: <out>/pretrain/<task>/<preset>."""
    seed: int = 0
    """First seed."""
    seeds: int = 10
    """Number of seeds; seed i starts from prior i modulo the number of priors."""
    rollouts: int = 100
    """Real rollouts per seed, the initial ones included; may grow with --resume."""
    initial_rollouts: int = 1
    """Rollouts of the simulator's policy, or of plans if the method plans, that fill the buffer before learning starts.
    The paper has 20; with one, every method that has been run with both gets to 90 % as early or earlier
    (docs/five-rollouts.md)."""
    utd: float = 8.0
    """Updates per real transition."""
    eval_every: int = 5
    """Rollouts between evaluations."""
    eval_episodes: int = 50
    """Episodes per seed and evaluation, always the same ones; they cost no real transitions."""
    checkpoint_every: int = 10
    """Rollouts between checkpoints."""
    options: FinetuneConfig = field(default_factory=lambda: finetune_config(get_method(DEFAULT_METHOD)))
    """Method options; `network`, `size` and `gamma` always are the prior's."""
    tuned: bool = False
    """Begin with what `experiments.tune` chose for this task and method, in place of the defaults below: the variant
    `tuned`."""
    variant: str = ""
    """A word for these options: the run gets a folder of its own beside the method's, and a curve in the figures."""
    impl: Impl = "auto"
    """Who steps the physics: MJX's own code, MuJoCo Warp, or MuJoCo's C engine. auto: $SGFT_IMPL, or else c on a CPU,
    warp on an NVIDIA GPU where it is installed, jax elsewhere."""
    devices: int | None = None
    """Devices that share the seeds of all real systems; 0: all there are; default: one."""
    video: bool = True
    """Render an episode before and after fine-tuning side by side, where MuJoCo can render."""
    out: Path = Path("runs")
    """Parent of all run folders."""
    resume: bool = False
    """Continue from the last checkpoint."""
    overwrite: bool = False
    """Replace an earlier run of the same name."""


def arguments(method: str, **changes: Any) -> FinetuneArgs:
    """The arguments with which a method runs unless told otherwise, and any changes to these."""
    chosen = get_method(method)
    own = {
        "method": method, "utd": chosen.utd, "options": finetune_config(chosen), "preset": _preset(chosen),
    }  # fmt: skip
    return FinetuneArgs(**{**own, **changes})


def with_settings(args: FinetuneArgs, settings: Mapping[str, Any]) -> FinetuneArgs:
    """The arguments with other values for some of the options that a method's space names."""
    options = {name: value for name, value in settings.items() if name != "utd"}
    return replace(args, utd=settings.get("utd", args.utd), options=replace(args.options, **options))


def _preset(method: Method) -> str:
    """The preset that makes the priors a method needs."""
    return "tdmpc2" if method.prior == "tdmpc2" else DEFAULT_PRESET


def run_folder(args: FinetuneArgs, real: str) -> Path:
    """Where the run on that real system lives; the seeds of one call share a folder."""
    system = "_".join([Path(real).stem, *(change.replace("/", "") for change in args.set)])
    seeds = seeds_name(seed_list(args.seed, args.seeds))
    return args.out / "finetune" / envs.name_of(args.task) / system / label(args) / seeds


def label(args: FinetuneArgs) -> str:
    """The method with its variant, as folders and figures name it."""
    return "_".join(filter(None, [get_method(args.method).name, args.variant]))


def check(args: FinetuneArgs) -> tuple[Method, list[int]]:
    """The method and the seeds; raises UserError for what is wrong in the arguments alone."""
    envs.name_of(args.task)  # complains if there is none
    cli.choose("--preset", args.preset, PRESETS)
    for name in ("rollouts", "initial_rollouts", "eval_every", "eval_episodes", "checkpoint_every"):
        if getattr(args, name) < 1:
            raise UserError(f"--{name.replace('_', '-')} is {getattr(args, name)}: must be at least 1")
    if args.initial_rollouts > args.rollouts:
        raise UserError(f"--initial-rollouts {args.initial_rollouts} is more than --rollouts {args.rollouts}")
    if not re.fullmatch(r"[\w.-]*", args.variant):
        raise UserError(f"--variant {args.variant!r}: letters, digits, '.', '_' and '-' only, it names a folder")
    if args.utd <= 0:
        raise UserError(f"--utd is {args.utd}: must be positive")
    seeds = seed_list(args.seed, args.seeds)
    if not args.real:
        raise UserError("--real: name at least one")
    folders = [run_folder(args, real) for real in args.real]
    if twice := [folder for folder in folders if folders.count(folder) > 1]:
        raise UserError(f"--real {' '.join(args.real)}: two of them would share the folder {twice[0]}; name it once")
    method = get_method(args.method)
    check_options(method, args.options)
    return method, seeds


def check_prior(args: FinetuneArgs, method: Method, card: dict[str, Any]) -> None:
    """Raises UserError for a prior of another algorithm than the method needs."""
    if checkpoint.algorithm_of(card) != method.prior:
        raise UserError(
            f"--method {method.name} needs a prior of {method.prior}, not of {checkpoint.algorithm_of(card)}; "
            f"make one with: python -m experiments.pretrain --task {args.task} --preset {_preset(method)}"
        )
