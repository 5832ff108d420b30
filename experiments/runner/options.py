"""Options that several commands share, what can be wrong with them, and the priors and rollouts that they name.

Imports neither JAX nor MuJoCo.
"""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

import envs
from envs import extend, gaps
from envs.base import COMMANDS, Effects, misnamed
from envs.types import UserError, unknown
from sgft_jax import checks, types
from sgft_jax.files.disk import ASIDE, present
from sgft_jax.io.cards import CARD, SHIPPED, known_task, read_card, resolve_shipped
from sgft_jax.io.real import Played, home_of, played
from sgft_jax.io.runs import CONFIG, check_start, read_config
from sgft_jax.presets import PRESETS, check_card
from sgft_jax.types import Online

if TYPE_CHECKING:
    from envs.base import Env

_MOST_HOSTS, _MOST_SEEDS = 2**16, 2**16  # of one run
LAST_SEED = 2**31 - 1  # larger ones stand for held-out worlds and episodes

Impl = Annotated[
    Literal["auto", "jax", "warp", "c"],
    arg(
        help="Expert: physics engine: MJX's own code, MuJoCo Warp, or MuJoCo's C engine. auto: $SGFT_IMPL, or "
        "else c on a CPU, warp on an NVIDIA GPU where it is installed, jax elsewhere."
    ),
]

Task = Annotated[
    str,
    arg(help="A task by name (the command `tasks` lists them), or a Python file with a task of your own."),
]
Out = Annotated[Path, arg(help="Parent of all run folders.")]
FirstSeed = Annotated[int, arg(help="Expert: first seed.")]

Successors = Annotated[
    types.Successors,
    arg(help="Expert: where the next observations of a D4RL file come from: stored, or shifted (the row below)."),
]


def seed_list(first: int, count: int) -> list[int]:
    """`count` seeds from `first` on; raises UserError for none, and for seeds that do not fit into 32 bits."""
    if count < 1:
        raise UserError(f"--seeds is {count}: must be at least 1")
    if count > _MOST_SEEDS:
        raise UserError(f"--seeds is {count}: must be at most {_MOST_SEEDS}")
    if not 0 <= first <= LAST_SEED - count + 1:
        more = f", and --seeds {count} of them are wanted" if count > 1 else ""
        raise UserError(f"--seed is {first}: seeds go from 0 to {LAST_SEED}{more}")
    return list(range(first, first + count))


def seeds_name(seeds: Sequence[int]) -> str:
    """The folder of a run with these seeds: `seed-3`, or `seeds-0-9`."""
    return f"seed-{seeds[0]}" if len(seeds) == 1 else f"seeds-{seeds[0]}-{seeds[-1]}"


def command(name: str, **given: Any) -> str:
    """A command of ours as a user types it, without options that are None, empty, or --out by default."""
    words = ["python", "-m", f"experiments.{name}"]
    for option, value in given.items():
        if value and (option, value) != ("out", Path("runs")):
            values = () if value is True else value if isinstance(value, tuple) else (value,)
            words += [f"--{option}", *map(str, values)]
    return shlex.join(words)


def without_repeats(option: str, words: Sequence[str]) -> None:
    """Raise UserError for a word that is given twice."""
    if twice := [word for i, word in enumerate(words) if word in words[:i]]:
        raise UserError(f"{option} names {twice[0]} twice; name it once")


def each_once(args: object, *names: str) -> None:
    """Raise UserError for an option that names nothing, or something twice."""
    for name in names:
        if not getattr(args, name):
            raise UserError(f"--{name}: name at least one")
        without_repeats(f"--{name}", getattr(args, name))


def port_of(text: str) -> int | None:
    """The number of a port, None for what is none."""
    return int(text) if text.isdecimal() and len(text) < 9 and 0 < int(text) < 2**16 else None


def hosts_of(hosts: str) -> tuple[str, int, int]:
    """The address of the first host, how many there are, and which one this is; UserError for anything else."""
    address, *numbers = hosts.split(",")
    if ":" not in address or len(numbers) != 2 or not all(n.isdecimal() for n in numbers):
        raise UserError(f"--hosts {hosts}: must be 'auto' or ADDRESS:PORT,COUNT,INDEX")
    if port_of(address.rpartition(":")[2]) is None:
        raise UserError(f"--hosts {hosts}: the port of {address} must be from 1 to 65535")
    count, index = (int(n) if len(n) < 9 else _MOST_HOSTS + 1 for n in numbers)
    if count > _MOST_HOSTS:
        raise UserError(f"--hosts {hosts}: at most {_MOST_HOSTS} of them")
    if index >= count:
        raise UserError(f"--hosts {hosts}: index {index} of {count} hosts; they are counted from 0")
    return address, count, index


def check_variant(variant: str) -> None:
    """Raise UserError for a word that cannot be a part of a folder's name."""
    if variant:
        extend.folder_name("--variant", variant)


def check_data(option: str, path: Path) -> None:
    """Raises UserError where there are no recorded data."""
    if not (path.is_file() or path.is_dir()):
        raise UserError(f"{option} {path}: {'is no plain file' if path.exists() else 'no such file or folder'}")


def check_folders(option: str, words: Sequence[str], folders: Sequence[Path], args: Any) -> None:
    """Raise UserError where a run cannot begin in its folder, or where two would share one.

    words: the values of `option`, of which each has a run. args: with `resume` and `overwrite`.
    """
    if twice := [folder for folder in folders if folders.count(folder) > 1]:
        raise UserError(f"{option} {' '.join(words)}: two of them would share the folder {twice[0]}; name it once")
    for folder in folders:
        check_start(folder, resume=args.resume, overwrite=args.overwrite)


def check_task(task: str, reals: Sequence[str] = (), changes: Sequence[str] = ()) -> None:
    """Raise UserError where there is no such task, or no such real system of it, or for changes that set nothing.

    Only names that are no effects take the import of the task to check.
    """
    name = envs.name_of(task)
    chosen, known = [gaps.find(name, real) for real in reals], gaps.presets(name)
    named = {x for gap in chosen if known.get(gap.name) != gap for x in (*gap.params, *gap.effects)}
    if odd := [x for x in (*gaps.changes(changes), *sorted(named)) if x not in {*Effects._fields, *COMMANDS}]:
        scene = envs.scene(name)
        if scene and (strange := [x for x in odd if x not in [p.name for p in scene.parameters]]):
            raise misnamed(scene, strange[0])


def at_least_one(args: object, *names: str) -> None:
    """Raise UserError for an option that is less than 1, or of several numbers has one that is, or has none."""
    for name in names:
        value = getattr(args, name)
        several = value if isinstance(value, tuple) else (value,)
        if (least := min(several, default=0)) < 1:
            raise UserError(f"--{name.replace('_', '-')} is {least}: must be at least 1")
        _not_too_many(name, max(several))


def not_negative(args: object, *names: str) -> None:
    """Raise UserError for an option that is less than 0 or nan; one that is None was left out."""
    for name in names:
        value = getattr(args, name)
        if value is not None and not value >= 0:
            raise UserError(f"--{name.replace('_', '-')} is {value}: must be at least 0")
        if isinstance(value, int):
            _not_too_many(name, value)


def _not_too_many(name: str, value: int) -> None:
    if value > checks.MOST:
        raise UserError(f"--{name.replace('_', '-')} is {value}: must be at most {checks.MOST}")


def prior_home(out: Path, task: str, preset: str) -> Path:
    """Where the runs of pretraining are that leave the priors of a task."""
    return out / "pretrain" / task / preset


def prior_folders(prior: Path | None, *, out: Path, task: str, preset: str, option: str = "--prior") -> list[Path]:
    """Where priors are, in the order of their seeds; raises UserError if there is none.

    prior: a folder that is one, or that holds some as `seed-*`, `prior/seed-*`, `policy/seed-*` (what fine-tuning
    leaves, in the same form) or `*/prior/seed-*`, or `shipped:TASK`; None looks in `prior_home`. task: as the user has
    typed it. option: the one that names `prior`.
    """
    home = resolve_shipped(prior) if prior else prior_home(out, extend.name_of(task), preset)
    if (present(home) / CARD).exists():
        return [home]
    cards = [
        card
        for sub in ("", "prior/", "policy/", "*/prior/")
        for name in ("seed-*", f"{ASIDE}seed-*")  # the latter where a writer was killed
        for card in home.glob(f"{sub}{name}/{CARD}")
    ]
    folders = {card.parent.with_name(card.parent.name.removeprefix(ASIDE)) for card in cards}
    if not folders and prior:
        raise UserError(f"{option} {prior}: {'holds no prior' if prior.is_dir() else 'no such folder'}")
    if not folders and preset not in PRESETS:
        raise UserError(unknown("--preset", preset, PRESETS))
    if not folders:
        shipped = (SHIPPED / extend.name_of(task)).is_dir()
        other = f", or take --prior shipped:{extend.name_of(task)}, which comes with the code" if shipped else ""
        command = f"python -m experiments.pretrain --task {task} --preset {preset}"
        raise UserError(f"{home}: holds no prior; make one with: {command}{other}")
    return sorted(folders, key=_seed_number)


def check_prior(folder: Path, method: Online, task: str) -> None:
    """Raises UserError for a prior of another algorithm or task than the method needs, before anything is loaded."""
    try:
        check_card(read_card(folder), method, task)
    except UserError as error:
        raise UserError(f"--prior {folder}: {error}") from error


def task_of_priors(folders: Sequence[Path], task: str | None) -> str:
    """The task that the user says, by name or file, or else the one that the cards of the priors name.

    Raises UserError where a card names another, or, unless the user says it, none of ours.
    """
    named = {folder: read_card(folder)["task"] for folder in folders}
    chosen = task or known_task(folders[0] / CARD, named[folders[0]])
    check_task(chosen)
    for folder, other in named.items():
        if other != extend.name_of(chosen):
            raise UserError(f"{folder}: is a prior of the task {other!r}, not of {extend.name_of(chosen)!r}")
    return chosen


def _seed_number(folder: Path) -> tuple[int, str]:
    number = folder.name.removeprefix("seed-")
    return (int(number) if number.isdigit() else 0, str(folder))


# --- the rollouts that a run has stored in real/ ----------------------------------------------------------------------


def home_of_rollouts(option: str, folder: Path) -> Path:
    """The folder that holds real/ with rollouts, that itself or its parent; raises UserError where there is none."""
    home = home_of(folder)
    if home is None:
        raise UserError(f"{option} {folder}: holds no recorded rollouts (real/rollout-*.npz)")
    return home


def task_of_rollouts(home: Path, task: str | None) -> str:
    """The task that was played: what the user says, or what the run says; raises UserError where nobody does.

    A run names no code: one of a task of the user's own is of that task again where the user says so.
    """
    if task is None:
        if (named := read_config(home).get("task")) is None:
            raise UserError(f"{home}: does not say of which task it is; name it with --task")
        return known_task(home / CONFIG, named)
    check_task(task)
    return task


def episodes_of(home: Path, seed: int | None) -> list[Played]:
    """The episodes of one seed of a run, or those of all; raises UserError for a seed that it does not have."""
    rollouts, first = played(home), read_config(home).get("seed", 0)
    seeds = sorted({first + rollout.seed for rollout in rollouts})
    if seed is not None and seed not in seeds:
        raise UserError(f"--seed {seed}: {home} has the seeds {', '.join(map(str, seeds))}")
    return [rollout._replace(seed=first + rollout.seed) for rollout in rollouts if seed in (None, first + rollout.seed)]


def check_sizes(home: Path, episodes: Sequence[Played], env: "Env") -> None:
    """Raises UserError for episodes of a task with other observations or actions."""
    seen, commanded = (x.shape[1] for x in episodes[0].rows[:2])
    if seen < env.measured_dim or commanded != env.act_dim:
        raise UserError(
            f"{home}: has {seen} observations and {commanded} actions, {env.name} has {env.measured_dim} and "
            f"{env.act_dim}; name its task with --task"
        )
