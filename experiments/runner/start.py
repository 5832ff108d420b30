"""Runs from their options: checked first, so that what is wrong is said before JAX starts."""

from dataclasses import replace
from typing import Any

from envs import gaps
from experiments.runner import finetune_args, hybrid_args
from experiments.runner.finetune_args import FinetuneArgs
from experiments.runner.hybrid_args import HybridArgs


def finetune(args: FinetuneArgs) -> list[dict[str, Any]]:
    """Fine-tuning runs from (or back) to disk, one per real system; returns their summaries in the order of `real`."""
    args = replace(args, real=gaps.each(args.real))
    method, seeds = finetune_args.check(args)
    args = finetune_args.resolved(args)
    priors = finetune_args.priors_of(args)
    from experiments.runner.finetune_run import run  # JAX starts here

    return run(args, method, seeds, priors)


def hybrid(args: HybridArgs) -> list[dict[str, Any]]:
    """Runs from (or back) to disk, one for each simulator; returns their summaries in the order of `gap`."""
    args = replace(args, gap=gaps.each(args.gap))
    method, seeds = hybrid_args.check(args)
    for line in hybrid_args.choices(args, method):
        print(line)
    from experiments.runner.hybrid_run import run  # JAX starts here

    return run(args, method, seeds)
