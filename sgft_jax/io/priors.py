"""Impure: several priors that are used together."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sgft_jax.io import checkpoint
from sgft_jax.io.config import differences
from sgft_jax.types import PyTree, UserError


def load_priors(folders: Sequence[Path], env: Any) -> tuple[list[PyTree], dict[str, Any]]:
    """The priors in these folders and the card of the first; raises UserError where they do not fit together.

    env: what has the `name`, `obs_dim` and `act_dim` that they must have.
    """
    sizes = {"task": env.name, "obs_dim": env.obs_dim, "act_dim": env.act_dim}
    priors, cards = zip(*(checkpoint.load_prior(folder, **sizes) for folder in folders), strict=True)
    for folder, card in zip(folders, cards, strict=True):
        odd = [key for key in ("network", "gamma", "ensemble_size") if differences(cards[0][key], card[key])]
        odd += ["plan"] if card.get("plan") != cards[0].get("plan") else []
        if checkpoint.algorithm_of(card) != checkpoint.algorithm_of(cards[0]):
            odd.append("algorithm")
        if odd:
            raise UserError(f"{folder}: differs from {folders[0]} in {', '.join(odd)}; choose one with --prior")
    return list(priors), cards[0]
