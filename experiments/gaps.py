"""Measure what gaps do: success of the simulator's policies on each real system, and of a policy trained right there.

A gap is worth studying only if pretraining alone does not bridge it and a policy that does exists: it is admissible if
zero-shot success is at most 40 % and training on the real system itself reaches 95 %.
"""

from collections.abc import Sequence
from typing import Any

from experiments.runner import cli
from experiments.runner.gaps_args import PLAIN, GapsArgs, check
from sgft_jax.presets import PRESETS


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    cli.run_main(measure, GapsArgs, __doc__ or "", argv=argv, default=_defaults)


def _defaults(argv: Sequence[str]) -> GapsArgs:
    """The defaults of the preset; `measure` refuses a preset that does not exist."""
    preset = cli.preview(argv, preset=PLAIN).preset
    return GapsArgs(preset=preset, config=PRESETS.get(preset, PRESETS[PLAIN]))


def measure(args: GapsArgs) -> dict[str, Any]:
    """Measures, prints a table, writes and returns the summary. Raises UserError for what is wrong with the options."""
    checked = check(args)
    from experiments.runner.gaps_run import run

    return run(*checked)


if __name__ == "__main__":
    main()
