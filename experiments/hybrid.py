"""Learn one policy from a fixed set of real data and an imperfect simulator. The real system is only evaluated in."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from envs import gaps
from experiments.runner import cli
from experiments.runner.hybrid_args import DEFAULT, HybridArgs, check, data_name
from sgft_jax.hybrid.presets import preset_for, say_preset
from sgft_jax.methods import FIXED_NAMES, get_method
from sgft_jax.train.schedule import FLEET, SCHEDULES, describe
from sgft_jax.types import Fixed


def main(argv: Sequence[str] | None = None) -> None:
    """The command line. The method is looked up first: the other options and their defaults are its own."""
    cli.run_main(hybrid, HybridArgs, f"{__doc__}\n\n{_table()}", argv=argv, default=_defaults)


def _defaults(argv: Sequence[str]) -> HybridArgs:
    """Those of the chosen method, of its preset and of the schedule."""
    chosen = cli.preview(argv, method=DEFAULT, preset="", data="", schedule_preset=FLEET)
    schedule = cli.choose("--schedule-preset", chosen.schedule_preset, SCHEDULES)
    return arguments(
        chosen.method, preset=chosen.preset, data=Path(chosen.data) if chosen.data else None,
        schedule_preset=chosen.schedule_preset, schedule=schedule,
    )  # fmt: skip


def arguments(method: str, *, preset: str = "", data: Path | None = None, **changes: Any) -> HybridArgs:
    """The arguments with which a method runs unless the user says otherwise, and any changes to these.

    preset: "" for the one that suits the data, if the method has presets by data set, else the first.
    """
    found = get_method(method, "fixed")
    preset = preset or ("" if data is None else preset_for(found, data_name(data)))
    options = cli.choose("--preset", preset or next(iter(found.presets)), dict(found.presets))
    return HybridArgs(**{"method": method, "preset": preset, "options": options, "data": data, **changes})


def _table() -> str:
    """The methods, a line each."""
    found = [get_method(name, "fixed") for name in FIXED_NAMES]
    rows = [("", m.name, m.kind, f"{m.description} ({m.source}); presets: {', '.join(m.presets)}") for m in found]
    return "\n".join(["methods:", *cli.columns(rows)])


def _choices(args: HybridArgs, method: Fixed) -> list[str]:
    """What was chosen by name or by data, in words."""
    preset = say_preset(method, args.preset, data_name(args.data)) if method.by_data and args.data else ""
    schedule = "" if method.kind == "offline" else describe(args.schedule)
    return [f"{method.name}: {words}" for words in (preset, schedule) if words]


def hybrid(args: HybridArgs) -> list[dict[str, Any]]:
    """Runs from (or back) to disk, one for each simulator; returns their summaries in the order of `gap`."""
    args = replace(args, gap=gaps.each(args.gap))
    method, seeds = check(args)
    for line in _choices(args, method):
        print(line)
    from experiments.runner.hybrid_run import run  # JAX starts here

    return run(args, method, seeds)


if __name__ == "__main__":
    main()
