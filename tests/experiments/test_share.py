"""Priors to share: rounded numbers, smaller files, and the ones that come with the code."""

from pathlib import Path

import jax
import numpy as np
import pytest
from priors_by_hand import save_prior

from envs.types import UserError
from experiments import share
from experiments.share import ShareArgs, rounded
from sgft_jax.io.priors import load_prior

ROOT = Path(__file__).parents[2]


def test_so_many_bits_stay():
    values = np.float32([1.0, -1.0 / 3.0, 2.0**-30 / 3.0, 1e20, 0.0])
    few = rounded({"x": values, "n": np.int32([3])}, 8)
    np.testing.assert_allclose(few["x"], values, rtol=2.0**-8)
    assert few["x"].dtype == np.float32 and few["n"] == 3
    mantissa, _ = np.frexp(few["x"])
    np.testing.assert_array_equal(mantissa * 2**8, np.rint(mantissa * 2**8))
    np.testing.assert_array_equal(rounded(values, 24), values)


def test_copies_are_loaded_like_their_originals(tmp_path, capsys):
    for seed in (0, 1):
        save_prior(tmp_path / f"run/prior/seed-{seed}", seed)
    share.main(ShareArgs(tmp_path / "run", tmp_path / "copies", count=1, bits=8))
    assert "seed-0: " in capsys.readouterr().out and not (tmp_path / "copies/seed-1").exists()
    old, new = (load_prior(folder) for folder in (tmp_path / "run/prior/seed-0", tmp_path / "copies/seed-0"))
    assert new.card == {**old.card, "significant_bits": 8}
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2.0**-8), old.params, new.params)
    for bad, words in (
        ({"bits": 1}, "--bits is 1: from 2 to 24"),
        ({"count": 3}, "--count is 3: .* holds 2 priors"),
        ({}, "seed-0: exists already"),
    ):
        with pytest.raises(UserError, match=words):
            share.main(ShareArgs(tmp_path / "run", tmp_path / "copies", **bad))


@pytest.mark.heavy
def test_the_priors_that_come_with_the_code_are_small_and_whole():
    folders = sorted((ROOT / "sgft_jax/priors").glob("*/seed-*"))
    found = {folder.parent.name: load_prior(folder, task=folder.parent.name).card["preset"] for folder in folders}
    assert found == {"hammer": "robust", "insert": "robust", "panda-push": "cpu", "push": "robust"}
    assert sum(file.stat().st_size for file in (ROOT / "sgft_jax/priors").rglob("*") if file.is_file()) < 12e6


def test_no_file_of_a_prior_names_a_folder_of_the_machine(tmp_path):
    save_prior(tmp_path / "prior/seed-0", 0)
    for file in [path for path in (tmp_path / "prior").rglob("*") if path.is_file()]:
        assert str(tmp_path).encode() not in file.read_bytes(), file
    assert not list((ROOT / "sgft_jax/priors").rglob("commit_success.txt"))  # Orbax's mark, which does
