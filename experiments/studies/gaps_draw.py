"""Draw gaps from a distribution, write them to a file, measure and sort them, and choose a frozen set of them.

Solved by the simulator's policy (80 % and more), partial, or failed (below 20 %); trivial where identifying commands
(scale, rotation, bias) and constant errors of sensors from one rollout suffices (90 %). What the table beside the file
holds already is not measured again.
"""

from collections.abc import Sequence
from typing import Any

import tyro

from experiments.runner import cli
from experiments.runner.gaps_args import PLAIN
from experiments.studies.gaps_draw_args import DrawArgs, check
from sgft_jax.presets import PRESETS


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    cli.run_main(draw, DrawArgs, __doc__ or "", argv=argv, default=_defaults)


def _defaults(argv: Sequence[str]) -> DrawArgs:
    """The defaults of the preset; `draw` refuses a preset that does not exist."""
    judge_preset = cli.preview(argv, judge_preset=PLAIN).judge_preset
    return DrawArgs(count=tyro.MISSING, judge_preset=judge_preset, config=PRESETS.get(judge_preset, PRESETS[PLAIN]))


def draw(args: DrawArgs) -> dict[str, Any]:
    """Draws, measures, prints a table, writes and returns it. Raises UserError for what is wrong with the options."""
    seeds, folders = check(args)
    from experiments.studies.gaps_drawn import run

    return run(args, seeds, folders)


if __name__ == "__main__":
    main()
