"""The runs of a comparison on disk: all methods on one real system, which run of each counts, and what is missing."""

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.results import Curve, read_curve
from sgft_jax.io.jsonfile import read_json
from sgft_jax.io.log import EVAL
from sgft_jax.io.runs import CONFIG
from sgft_jax.methods import METHODS, finetune_config
from sgft_jax.types import UserError

ORDER = tuple(reversed(METHODS))  # SGFT first
DEFAULT = "default"  # the real system on which tasks and ablations are compared


class Comparison(NamedTuple):
    """All methods on one real system. curves: by method, in the order of `ORDER`, each followed by its variants.
    configs: by the same names, the arguments that the run was started with ({} where it has no config.json). notes:
    what is missing or odd.
    """

    task: str
    real: str
    curves: dict[str, Curve]
    configs: dict[str, dict[str, Any]]
    notes: list[str]


class Part(NamedTuple):
    """Sections of the results, and a line for each thing that lacks runs."""

    sections: list[str]
    missing: list[str]


def read_comparison(folder: Path) -> Comparison:
    """What the runs of <out>/finetune/<task>/<real>/<method>[_<variant>]/<seeds>/ say."""
    curves: dict[str, Curve] = {}
    configs = {}
    notes = []
    runs = {name: sorted(folder.glob(f"{name}/*/{EVAL}")) for name in _names(folder)}
    if absent := [method for method in ORDER if not runs[method]]:
        notes.append(f"no run of {', '.join(absent)}")
    for name in [name for name in runs if runs[name]]:
        chosen, more = _choose(name, [run.parent for run in runs[name]])
        notes += more
        if chosen is not None:
            curves[name], configs[name] = chosen
    return Comparison(folder.parent.name, folder.name, curves, configs, notes)


def on_default(comparisons: Iterable[Comparison]) -> dict[str, Comparison]:
    """By task, those on the default real system."""
    return {c.task: c for c in comparisons if c.real == DEFAULT and c.curves}


def names_of(comparisons: Iterable[Comparison]) -> list[str]:
    """Every method and variant that any of them has, each once, in the order of a single one."""
    return _sorted({name for comparison in comparisons for name in comparison.curves})


def colour_order(names: Iterable[str]) -> list[str]:
    """The order in which names get colours: the methods first, which keep theirs whatever variants there are."""
    return sorted(names, key=lambda name: split(name)[1] != "")


def figure_order(order: Sequence[str], names: Iterable[str]) -> list[str]:
    """The order of colours in a figure of these names, of those that all figures have in `order`.

    A method keeps its colour, and so does one of which a single variant is there instead; other variants come after.
    """
    names = list(names)
    count = Counter(split(name)[0] for name in names)
    alone = {split(name)[0]: name for name in names if count[split(name)[0]] == 1}
    places = [alone.get(name, name) for name in order if not split(name)[1]]
    return [*places, *(name for name in names if name not in places)]


def split(name: str) -> tuple[str, str]:
    """Method and variant that a folder's name stands for; one's own method may have any name, and keeps it whole."""
    method, _, variant = name.partition("_")
    return (method, variant) if method in METHODS else (name, "")


def beside_its_method(name: str, names: Iterable[str]) -> bool:
    """Whether a name is a variant whose method is among the names itself; any other stands for its method."""
    method, variant = split(name)
    return bool(variant) and method in names


def shared_variants(names: Iterable[str]) -> list[str]:
    """Variants that several methods have, such as `tuned`, in order."""
    count = Counter(split(name)[1] for name in set(names))
    return sorted(variant for variant, n in count.items() if variant and n > 1)


def same_seeds(comparison: Comparison, one: str, other: str) -> bool:
    """Whether two runs are known to have the same seeds: equally many, from the same first one on.

    They may have begun with different priors. Then only the real starts are the same, and to draw seeds in pairs leaves
    an interval as wide as that of independent draws.
    """
    first, second = (
        (comparison.configs[name].get("seed"), comparison.curves[name].success.shape[0]) for name in (one, other)
    )
    return first == second and first[0] is not None


def is_sgft(name: str) -> bool:
    """Whether a method with or without variant is SGFT: it shapes rewards and shortens the horizon, or it plans H steps
    that end in a frozen V_sim, which is both at once.
    """
    method = METHODS.get(split(name)[0])
    if method is None:
        return False
    plans = method.agent == "tdmpc2" and not finetune_config(method).train_critic
    return plans or method.agent == "mpc" or (method.uses_value and method.finite_horizon)


def _names(folder: Path) -> list[str]:
    """All methods, each with the variants of it that have a folder; then the folders of people's own methods."""
    return _sorted({*ORDER, *(path.name for path in folder.iterdir() if path.is_dir())})


def _sorted(names: Iterable[str]) -> list[str]:
    rank = {method: i for i, method in enumerate(ORDER)}
    return sorted(names, key=lambda name: (rank.get(split(name)[0], len(rank)), name))


def _choose(method: str, folders: list[Path]) -> tuple[tuple[Curve, dict[str, Any]] | None, list[str]]:
    """Of several runs of a method the one with the most seeds, then rollouts; runs that share seeds are not pooled."""
    found: list[tuple[int, int, Path, Curve]] = []
    notes = []
    for folder in folders:
        try:
            curve = read_curve(folder)
        except UserError as error:
            notes.append(f"{method}: {error}")
            continue
        found.append((curve.success.shape[0], int(curve.rollouts[-1]), folder, curve))
    if not found:
        return None, notes
    found.sort(key=lambda run: run[:2])
    *others, (_, rollouts, folder, curve) = found
    notes += [f"{method}: {other.name} left out, {folder.name} has more seeds or rollouts" for *_, other, _ in others]
    config = _config(folder)
    if (wanted := config.get("rollouts")) and rollouts < wanted:
        notes.append(f"{method}: unfinished, {rollouts} of {wanted} rollouts")
    return (curve, config), notes


def _config(folder: Path) -> dict[str, Any]:
    return read_json(folder / CONFIG).get("config", {}) if (folder / CONFIG).exists() else {}
