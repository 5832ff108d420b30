"""Fit the prediction of `experiments.diagnose` to finished fine-tuning runs, and measure how well it holds.

Without --check, the gains on every second gap are predicted from the others (docs/diagnose.md).
"""

import json

from experiments.runner import cli
from experiments.studies.calibrate_args import CalibrateArgs, check


def main(args: CalibrateArgs) -> None:
    """Fits, checks and prints. Raises UserError where runs hold too little, or are in both lists."""
    runs, others = check(args)
    from experiments.studies.calibration import calibrate

    summary, lines = calibrate(args, runs, others)
    print(json.dumps(summary) if args.json else "\n".join(lines))


if __name__ == "__main__":
    cli.run_main(main, CalibrateArgs, __doc__ or "")
