"""Pretrain in randomised simulation (or on a "real" system): leaves one prior per seed.

The prior of a seed is the agent at the best of its late evaluations (success, then return) on held-out worlds; the
numbers in its card and in summary.json come from fresh episodes in other held-out worlds, so the choice does not
flatter them.
"""

from collections.abc import Sequence
from typing import Any

from experiments.runner import cli
from experiments.runner.pretrain_args import PretrainArgs, check
from sgft_jax.presets import DEFAULT_PRESET, PRESETS


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    cli.run_main(pretrain, PretrainArgs, __doc__ or "", argv=argv, default=_defaults)


def _defaults(argv: Sequence[str]) -> PretrainArgs:
    """The defaults of the preset; `pretrain` refuses a preset that does not exist."""
    preset = cli.preview(argv, preset=DEFAULT_PRESET).preset
    return PretrainArgs(preset=preset, config=PRESETS.get(preset, PRESETS[DEFAULT_PRESET]))


def pretrain(args: PretrainArgs) -> dict[str, Any]:
    """One run from (or back) to disk; returns its summary."""
    seeds = check(args)
    from experiments.runner.pretrain_run import run  # JAX starts here

    return run(args, seeds)


if __name__ == "__main__":
    main()
