"""Say from a few real rollouts what kind of gap this is, whether fine-tuning will help, and how soon.

Draws four panels, writes the numbers as JSON, and prints a verdict in words (docs/diagnose.md).
"""

import json

from experiments.runner import cli
from experiments.runner.diagnose_args import DiagnoseArgs, check


def main(args: DiagnoseArgs) -> None:
    """Diagnoses and prints."""
    checked = check(args)
    from experiments.runner.diagnose_run import diagnose

    summary, lines = diagnose(args, *checked)
    print(json.dumps(summary) if args.json else "\n".join(lines))


if __name__ == "__main__":
    cli.run_main(main, DiagnoseArgs, __doc__ or "")
