"""Learn one policy from a fixed set of real data and an imperfect simulator. The real system is only evaluated in."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from envs import gaps
from experiments import cli
from experiments.hybrid_args import DEFAULT, HybridArgs, check
from sgft_jax.hybrid.methods import NAMES, get_method


def main(argv: Sequence[str] | None = None) -> None:
    """The command line. The method is looked up first: the other options and their defaults are its own."""
    cli.run_main(hybrid, HybridArgs, f"{__doc__}\n\n{_table()}", argv=argv, default=_defaults)


def _defaults(argv: Sequence[str]) -> HybridArgs:
    """Those of the chosen method and of its preset."""
    chosen = cli.preview(argv, method=DEFAULT, preset="")
    return arguments(chosen.method, preset=chosen.preset)


def arguments(method: str, *, preset: str = "", **changes: Any) -> HybridArgs:
    """The arguments with which a method runs unless the user says otherwise, and any changes to these."""
    presets = dict(get_method(method).presets)
    options = cli.choose("--preset", preset or next(iter(presets)), presets)
    return HybridArgs(**{"method": method, "preset": preset, "options": options, **changes})


def _table() -> str:
    """The methods, a line each."""
    found = [get_method(name) for name in NAMES]
    rows = [("", m.name, m.kind, f"{m.description} ({m.source}); presets: {', '.join(m.presets)}") for m in found]
    return "\n".join(["methods:", *cli.columns(rows)])


def hybrid(args: HybridArgs) -> list[dict[str, Any]]:
    """Runs from (or back) to disk, one for each simulator; returns their summaries in the order of `gap`."""
    args = replace(args, gap=gaps.each(args.gap))
    method, seeds = check(args)
    from experiments.hybrid_run import run  # JAX starts here

    return run(args, method, seeds)


if __name__ == "__main__":
    main()
