"""Record data sets of a real system in the layouts of D4RL and Minari.

SAC learns in the system itself until its exploring policy returns --level on average. Its whole experience becomes
`medium-replay`, episodes of the final policy become `medium`, as in D4RL. With --policy, episodes of an existing policy
are recorded instead. With --operator, a noisy controller keeps a wheel-legged robot upright; its log is a text file.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from experiments.runner import cli
from experiments.runner.collect_args import CollectArgs, check
from sgft_jax.io.cards import resolve_shipped


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    cli.run_main(collect, CollectArgs, __doc__ or "", argv=argv)


def collect(args: CollectArgs) -> list[dict[str, Any]]:
    """Records and writes; returns what each file holds."""
    args = replace(args, policy=args.policy and resolve_shipped(args.policy))
    level = check(args)
    if args.operator:
        from experiments.runner.collect_operator import operate  # JAX starts here

        return operate(args)
    from experiments.runner.collect_run import record, teach  # JAX starts here

    return teach(args, level) if args.policy is None else record(args)


if __name__ == "__main__":
    main()
