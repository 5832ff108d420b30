"""The study of V_sim, as small as it can be."""

import json

import jax
import numpy as np
import pytest
from priors_by_hand import save_prior

from envs.types import UserError
from experiments.runner import cli
from experiments.studies import value
from sgft_jax.io.priors import load_prior, variant

pytestmark = pytest.mark.usefixtures("toy_task")


@pytest.mark.heavy
def test_a_prior_is_saved_with_a_value_of_success_alone(tmp_path, capsys):
    save_prior(tmp_path / "prior/seed-0", 0)
    sizes = "--episodes 64 --updates 40 --held 32 --states 4 --sparse --save"
    cli.run_main(
        value.main,
        value.ValueArgs,
        "",
        argv=["--priors", str(tmp_path / "prior/seed-0"), *sizes.split(), "--out", str(tmp_path / "out")],
    )
    (line,) = json.loads((tmp_path / "out/value/summary.json").read_text())["lines"]
    assert all(np.isfinite(x) for name, x in line.items() if name.startswith("value/"))
    *_, last = capsys.readouterr().out.splitlines()
    assert last == f"prior: {tmp_path / 'out/value/toy/seed-0'}"
    before, after = load_prior(tmp_path / "prior/seed-0"), load_prior(last.removeprefix("prior: "))
    assert not before.card.get("sparse")
    assert variant(after.card) == {**variant(before.card), "sparse": True}
    assert "value_system" in after.card
    assert jax.tree.all(jax.tree.map(np.array_equal, before.params.critic, after.params.critic))


def test_priors_that_would_replace_each_other_are_refused(tmp_path):
    for run in ("a", "b"):
        save_prior(tmp_path / run / "seed-0", 0)
    args = value.ValueArgs(
        save=True, priors=tuple(str(tmp_path / run / "seed-0") for run in ("a", "b")), out=tmp_path / "out"
    )
    with pytest.raises(UserError, match="--save"):
        value.main(args)
    assert not (tmp_path / "out").exists()
