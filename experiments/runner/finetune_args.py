"""Fine-tuning from its options: what can be wrong with them, the folders that follow, and the start.

What is wrong is said before JAX is imported.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

from envs import extend, gaps
from envs.types import UserError
from experiments.runner import options
from experiments.runner.options import FirstSeed, Impl, Out, Successors, Task
from experiments.runner.real_systems import REMOTE, by_scene, is_robot, title
from experiments.runner.real_systems import check as check_real
from sgft_jax.files.disk import jsonable
from sgft_jax.methods import DEFAULT, get_method
from sgft_jax.presets import DEFAULT_PRESET, preset_of
from sgft_jax.train.options import loop_of
from sgft_jax.types import Online

NO_PRIOR = Path("none")
_EVALUATION_EPISODES = 50


@dataclass(frozen=True)
class FinetuneArgs:
    """Fine-tuning of several seeds on one or more real systems at once, all in one compiled program."""

    # May differ when a run goes on; what is in the data may not.
    volatile: ClassVar = (
        *("resume", "overwrite", "rollouts", "devices", "video", "sync_every"),
        *("out", "tuned", "real_data", "successors"),
    )

    task: Task = "push"
    method: str = DEFAULT
    """A method from the table at the top, or a Python file with a method of your own (docs/extending.md)."""
    real: tuple[str, ...] = ("default",)
    """The real system: a gap by name, a .toml/.json file of one gap (tables `params` and `effects`) or of several, then
    all of them, file.toml:name for one of several, or sim for no gap. Several are played together in one program,
    which takes little longer; each has a run folder of its own. Or gymnasium:NAME, an environment for each seed
    (docs/gymnasium.md). Or remote[:HOST[:PORT]], a robot that connects there (docs/real-robot.md)."""
    set: tuple[str, ...] = ()
    """Changes to the real systems, e.g. --set latency=0.05 action_scale=[1,0.5]; of a Gymnasium environment keyword
    arguments of gymnasium.make, e.g. --set frame_skip=5."""
    seeds: int = 10
    """Number of seeds; seed i starts from prior i modulo the number of priors."""
    rollouts: int = 100
    """Real rollouts per seed, the initial ones included; may grow with --resume."""
    prior: Path | None = None
    """Folder of a prior, of several (prior/seed-*) or of runs; `none` starts from nothing where the method can.
    Default: <out>/pretrain/<task>/<preset>."""
    out: Out = Path("runs")
    real_data: tuple[Path, ...] = ()
    """Logs of the real system to begin with: data sets of D4RL, Minari or LeRobot, or run folders with rollouts in
    real/ (docs/data.md). Every seed keeps their episodes and learns from them before it plays."""
    resume: bool = False
    """Continue from the last checkpoint. Real rollouts that came after it are learned from, not repeated."""
    overwrite: bool = False
    """Replace an earlier run of the same name."""
    options: Any = None  # the `Config` of the method, see `arguments`
    """Options of the method that --method names:"""
    preset: str = DEFAULT_PRESET
    """Expert: pretraining preset whose priors to start from."""
    seed: FirstSeed = 0
    eval_every: int = 5
    """Expert: rollouts between evaluations."""
    eval_at: tuple[int, ...] = ()
    """Expert: evaluate after these numbers of rollouts instead, e.g. 0 1 2 4 8 16."""
    eval_episodes: int | None = None
    """Expert: episodes per seed and evaluation, always the same ones; 0: no evaluation. They cost no real transitions,
    except on robots and Gymnasium environments, where they are counted and kept. Default: 50, on a robot 0."""
    checkpoint_every: int = 10
    """Expert: rollouts between checkpoints."""
    real_updates: int | None = None
    """Expert: updates on --real-data before the first rollout; default: as many as rollouts of so many transitions
    allow."""
    successors: Successors = "stored"
    tuned: bool = False
    """Expert: begin with what `experiments.studies.tune` chose for this task and method, as the variant `tuned`."""
    variant: str = ""
    """Expert: a word for these options. The run gets a folder of its own beside the method's, and a curve."""
    impl: Impl = "auto"
    devices: int | None = None
    """Expert: devices that share the seeds of all real systems; 0: all there are; default: one."""
    hand_over: Literal["rollouts", "steps"] = "rollouts"
    """Expert: when a robot gets a new policy. A process learns from a rollout while the robot is brought to the next
    start. `rollouts`: the robot waits there until that is done. `steps`: it begins with the policy before, and the new
    one takes over as soon as it is there; not for methods with a guard, which judges rollouts by one policy."""
    sync_every: int = 1
    """Expert: steps of a robot between two flushes to disk. A killed process loses none; a power cut may lose up to
    this number minus one."""
    video: bool = True
    """Expert: render an episode before and after fine-tuning side by side, where MuJoCo can render."""


def finetune(args: FinetuneArgs) -> list[dict[str, Any]]:
    """Fine-tuning runs from (or back) to disk, one per real system; returns their summaries in the order of `real`."""
    args = replace(args, real=gaps.expand(args.real))
    method, seeds = check(args)
    args = resolved(args)
    priors = priors_of(args)
    from experiments.runner.finetune_run import run  # JAX starts here

    summaries: dict[str, dict[str, Any]] = {}
    for reals in by_scene(extend.name_of(args.task), args.real):
        # Every folder is that of a run on its real system alone: either kind of run continues the other.
        # A robot may come back at another address.
        named = [REMOTE if is_robot(name) else name for name in reals]
        homes = {run_folder(args, name): jsonable(args) | {"real": name} for name in named}
        summaries |= zip(reals, run(replace(args, real=reals), method, seeds, priors, homes), strict=True)
    return [summaries[name] for name in args.real]


def arguments(method: str, **changes: Any) -> FinetuneArgs:
    """The arguments with which a method runs unless the user says otherwise, and any changes to these."""
    chosen = get_method(method)
    return FinetuneArgs(**{"method": method, "options": chosen.config(), "preset": preset_of(chosen), **changes})


def with_settings(args: FinetuneArgs, settings: Mapping[str, Any]) -> FinetuneArgs:
    """The arguments with other values for some of the method's options."""
    return replace(args, options=replace(args.options, **settings))


def run_folder(args: FinetuneArgs, real: str) -> Path:
    """Where the run on that real system lives; the seeds of one call share a folder."""
    system = "_".join([title(real), *args.set]).replace("/", "")
    extend.folder_name("--set", system)
    seeds = options.seeds_name(options.seed_list(args.seed, args.seeds))
    return args.out / "finetune" / extend.name_of(args.task) / system / label(args) / seeds


def label(args: FinetuneArgs) -> str:
    """The method with its variant, as folders and figures name it."""
    return extend.folder_name("--variant", "_".join(filter(None, [get_method(args.method).name, args.variant])))


def check(args: FinetuneArgs) -> tuple[Online, list[int]]:
    """The method and the seeds; raises UserError for what is wrong in the arguments and with the run folders."""
    options.at_least_one(args, "rollouts", "eval_every", "checkpoint_every", "sync_every")
    options.not_negative(args, "eval_episodes", "devices")
    method, seeds = get_method(args.method), options.seed_list(args.seed, args.seeds)
    if not isinstance(args.options, method.config):
        raise UserError(f"--method {method.name}: the options are those of another method")
    if (initial := args.options.initial_rollouts) > args.rollouts:
        raise UserError(f"--options.initial-rollouts {initial} is more than --rollouts {args.rollouts}")
    if args.prior == NO_PRIOR and method.needs_prior:
        raise UserError(f"--prior none: {method.name} needs a prior of {method.prior}")
    options.check_variant(args.variant)
    for path in args.real_data:
        options.check_data("--real-data", path)
    if args.real_updates is not None and (args.real_updates < 0 or not args.real_data):
        raise UserError(f"--real-updates {args.real_updates}: 0 or more, and of --real-data, which must be named")
    if args.successors != "stored" and not args.real_data:
        raise UserError(f"--successors {args.successors}: is for --real-data, which must be named")
    options.each_once(args, "real")
    check_real(args.task, args.real, args.set)
    _check_robot(args)
    if args.eval_at:
        _check_eval_at(args)
    options.check_folders("--real", args.real, [run_folder(args, real) for real in args.real], args)
    return method, seeds


def _check_eval_at(args: FinetuneArgs) -> None:
    """Raises UserError for evaluations that would never be made."""
    option = f"--eval-at {' '.join(map(str, args.eval_at))}"
    if min(args.eval_at) < 0:
        raise UserError(f"{option}: numbers of rollouts, from 0 on")
    if min(args.eval_at) > args.rollouts:  # single ones may, for a run that --resume makes longer
        raise UserError(f"{option}: no evaluation within --rollouts {args.rollouts}; name smaller numbers")
    if not resolved(args).eval_episodes:
        raise UserError(f"{option}: evaluations have no episodes; say how many with --eval-episodes")


def _check_robot(args: FinetuneArgs) -> None:
    """Raises UserError for what a robot cannot do, or only a robot can."""
    robot = is_robot(args.real[0])
    if robot and args.seeds != 1:
        raise UserError(f"--seeds {args.seeds}: one robot plays one seed; give --seeds 1")
    if args.hand_over == "steps" and not robot:
        raise UserError("--hand-over steps: only a robot plays while something learns; name it with --real remote")
    if args.hand_over == "steps" and loop_of(args.options).guard:
        raise UserError(
            "--hand-over steps: a guard judges rollouts by one policy; add --options.no-guard or leave it out"
        )


def resolved(args: FinetuneArgs) -> FinetuneArgs:
    """With every option that was left open, as the run folder has it. Evaluations cost a robot nothing by default."""
    if args.eval_episodes is not None:
        return args
    return replace(args, eval_episodes=0 if is_robot(args.real[0]) else _EVALUATION_EPISODES)


def priors_of(args: FinetuneArgs) -> list[Path]:
    """The folders of the priors to start from, none where the user says so; raises UserError where there is none."""
    if args.prior == NO_PRIOR:
        return []
    folders = options.prior_folders(args.prior, out=args.out, task=args.task, preset=args.preset)
    for folder in folders:
        options.check_prior(folder, get_method(args.method), extend.name_of(args.task))
    return folders
