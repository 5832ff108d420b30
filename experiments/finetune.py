"""Fine-tune a pretrained policy on "real" systems and draw its learning curve on each."""

from collections.abc import Sequence
from dataclasses import replace

from experiments.runner import cli
from experiments.runner.finetune_args import FinetuneArgs, arguments, finetune
from sgft_jax.methods import DEFAULT, all_methods


def main(argv: Sequence[str] | None = None) -> None:
    """The command line. The method is looked up first: the other options and their defaults are its own."""
    cli.run_main(finetune, FinetuneArgs, f"{__doc__}\n\n{_table()}", argv=argv, default=_defaults)


def _defaults(argv: Sequence[str]) -> FinetuneArgs:
    """Those of the chosen method, with the options that tuning chose for the task if `--tuned` asks for them."""
    from experiments.runner import tuned

    chosen = cli.preview(argv, method=DEFAULT, tuned=False, task=FinetuneArgs.task, out=FinetuneArgs.out)
    default = arguments(chosen.method)
    return tuned.apply(replace(default, task=chosen.task, out=chosen.out)) if chosen.tuned else default


def _table() -> str:
    """The methods, a line each."""
    rows = [("", m.name, f"{m.description} ({m.source}); prior: {m.prior}") for m in all_methods().values()]
    return "\n".join(["methods:", *cli.columns(rows)])


if __name__ == "__main__":
    main()
