"""Learn one policy from a fixed set of real data and an imperfect simulator. The real system is only evaluated in."""

from collections.abc import Sequence
from pathlib import Path

from experiments.runner import cli
from experiments.runner.hybrid_args import DEFAULT, HybridArgs, arguments, hybrid
from sgft_jax.methods import FIXED_NAMES, get_method
from sgft_jax.train.schedule import FLEET, SCHEDULES


def main(argv: Sequence[str] | None = None) -> None:
    """The command line. The method is looked up first: the other options and their defaults are its own."""
    cli.run_main(hybrid, HybridArgs, f"{__doc__}\n\n{_table()}", argv=argv, default=_defaults)


def _defaults(argv: Sequence[str]) -> HybridArgs:
    """Those of the chosen method, of its preset and of the schedule."""
    chosen = cli.preview(argv, method=DEFAULT, preset="", data="", schedule_preset=FLEET)
    schedule = cli.choose("--schedule-preset", chosen.schedule_preset, SCHEDULES)
    data = Path(chosen.data) if chosen.data else None
    presets = {"preset": chosen.preset, "schedule_preset": chosen.schedule_preset}
    return arguments(chosen.method, data=data, schedule=schedule, **presets)


def _table() -> str:
    """The methods, a line each."""
    methods = [get_method(name, "fixed") for name in FIXED_NAMES]
    rows = [("", m.name, m.kind, f"{m.description} ({m.source}); presets: {', '.join(m.presets)}") for m in methods]
    return "\n".join(["methods:", *cli.columns(rows)])


if __name__ == "__main__":
    main()
