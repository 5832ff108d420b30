"""Draw learning curves and print tables, from the fine-tuning runs on disk or from released tables."""

from dataclasses import dataclass
from pathlib import Path

from envs import extend
from envs.types import UserError
from experiments.runner import cli
from sgft_jax.io.runs import check_folder


@dataclass(frozen=True)
class FiguresArgs:
    """A figure and tables for each task and gap, and of all tasks for each gap."""

    task: str | None = None
    """Only this task; default: all that have runs."""
    gaps: tuple[str, ...] = ()
    """Only these real systems, such as default; default: all that have runs."""
    methods: tuple[str, ...] = ()
    """Only these methods; default: all that have runs."""
    priors: tuple[str, ...] = ()
    """Only runs from these sets of priors, as the tables name them; default: all."""
    variants: bool = True
    """Also show variants (runs with other options), in panels beside their methods; --no-variants leaves them out."""
    reference: str | None = None
    """Compare the others with METHOD or METHOD:VARIANT; default: with the best of each table."""
    out: Path = Path("runs")
    """Parent of all run folders; the figures and tables.md go to <out>/figures."""
    data: Path | None = None
    """Folder of released tables to read instead of runs, such as docs/data."""
    export: Path | None = None
    """Instead of drawing, write what the runs say into this folder as CSV tables, which --data reads back."""


def main(args: FiguresArgs) -> None:
    """Draws, prints the tables, and says where they are; or exports."""
    if args.export is not None:
        check_folder(args.export, "--export")
        from sgft_jax.analysis.release import export

        print("\n".join(f"written: {path}" for path in export(args.out, args.export)))
        return
    path = figures(args)
    print(path.read_text())
    print(f"written: {path} and the figures beside it")


def figures(args: FiguresArgs) -> Path:
    """The figures and tables.md, whose path is returned; raises UserError if there is no run to draw."""
    check_folder(args.out / "figures")
    from sgft_jax.analysis.release import read

    runs = read(args.out, args.data)
    if not runs.curves:
        raise UserError(_nothing(args, runs.notes))
    from sgft_jax.analysis.results import select, write_results  # brings Matplotlib

    task = (extend.name_of(args.task),) if args.task else ()
    chosen = select(runs, variants=args.variants, task=task, gap=args.gaps, method=args.methods, priors=args.priors)
    return write_results(chosen, args.out / "figures", reference=args.reference)


def _nothing(args: FiguresArgs, notes: list[str]) -> str:
    """Why there is nothing to draw. notes: a line for each run that was left out."""
    if args.data:
        command = f"python -m experiments.figures --export {args.data}"
        return f"{args.data}: its curves-*.csv hold no run; write some with: {command}"
    message = f"{args.out / 'finetune'}: holds no evaluated run to draw"
    if notes:
        return f"{message}: {notes[0]}" + (f"; and {len(notes) - 1} more" if len(notes) > 1 else "")
    return f"{message}; make one with: python -m experiments.finetune --task {args.task or 'push'}"


if __name__ == "__main__":
    cli.run_main(main, FiguresArgs, __doc__ or "")
