"""H2O+ with EDAC's critic: many that must not agree on how to leave the real data (Niu et al. 2023, An et al. 2021)."""

from dataclasses import dataclass

from sgft_jax.methods import h2oplus
from sgft_jax.methods.options import EnsembleOptions
from sgft_jax.types import Fixed, Method


@dataclass(frozen=True)
class Config(EnsembleOptions, h2oplus.Config):
    """Options of `h2oplus-edac`; with 2 critics and diversity 0 it is `h2oplus`."""


_ABOUT = "H2O+ with ten critics that must not agree on how to leave the data"
_SOURCE = "Niu et al. 2023, An et al. 2021"
METHOD = Method("h2oplus-edac", fixed=Fixed("hybrid", _ABOUT, _SOURCE, {"default": Config()}, h2oplus.build))
