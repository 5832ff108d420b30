"""Write priors small enough to share: the same numbers, rounded to fewer digits, which compress better.

`experiments.evaluate` tells whether that matters. The priors in sgft_jax/priors were written by this command.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from envs.types import PyTree, UserError
from experiments.runner import cli
from experiments.runner.options import prior_folders
from sgft_jax.io.cards import read_card
from sgft_jax.io.runs import check_folder
from sgft_jax.types import Prior

_FLOAT32 = 24  # significant bits


@dataclass(frozen=True)
class ShareArgs:
    """One copy of each prior."""

    prior: Path
    """Folder of a prior, or of several (prior/seed-*)."""
    to: Path
    """Folder for the copies; each goes into one called like its own, such as seed-0."""
    count: int = 1
    """How many of the priors, the first ones by seed."""
    bits: int = 11
    """Significant bits of each number that stay; 11 are what half precision has, 24 are all."""


def main(args: ShareArgs) -> None:
    """Writes the copies and says how large they are."""
    if not 2 <= args.bits <= _FLOAT32:
        raise UserError(f"--bits is {args.bits}: from 2 to {_FLOAT32}")
    folders = prior_folders(args.prior, out=Path(), task="", preset="")
    if not 1 <= args.count <= len(folders):
        raise UserError(f"--count is {args.count}: {args.prior} holds {len(folders)} priors")
    check_folder(args.to, "--to")
    chosen = folders[: args.count]
    for folder in chosen:
        read_card(folder)
        if os.path.lexists(copy := args.to / folder.name):
            raise UserError(f"{copy}: exists already; choose another --to, or remove it")
    from sgft_jax.io.priors import load_prior, save_prior

    for folder in chosen:
        copy = args.to / folder.name
        prior = load_prior(folder)
        card = {**prior.card, "significant_bits": args.bits}
        save_prior(copy, Prior(rounded(prior.params, args.bits), card))
        size = sum(file.stat().st_size for file in copy.rglob("*") if file.is_file())
        print(f"{copy}: {size / 2**20:.2f} MiB")


def rounded(tree: PyTree, bits: int) -> PyTree:
    """The same arrays with so many significant bits in each float, as NumPy arrays; integers stay as they are."""
    import jax

    def rounded_array(x: Any) -> np.ndarray:
        values = np.asarray(x)
        if not np.issubdtype(values.dtype, np.floating):
            return values
        mantissa, exponent = np.frexp(values)
        return np.ldexp(np.rint(np.ldexp(mantissa, bits)), exponent - bits).astype(values.dtype)

    return jax.tree.map(rounded_array, tree)


if __name__ == "__main__":
    cli.run_main(main, ShareArgs, __doc__ or "")
