"""The study of posteriors, as small as it can be."""

import json

import numpy as np
import pytest

import envs
from experiments.studies import posterior
from sgft_jax.io.priors import load_prior, save_prior
from sgft_jax.posterior import decision, interface
from sgft_jax.posterior.estimator import shaped
from sgft_jax.types import Prior


@pytest.mark.slow
def test_all_parts_on_push(tmp_path, monkeypatch, capsys):
    for module in (posterior, decision, interface):
        for name, value in {"CANDIDATES": 2, "JUDGES": 2}.items():
            monkeypatch.setattr(module, name, value)
    sizes = {"_PLAYED": 2, "_POINTS": 8, "_DECIDED": 1, "_GAPS": 2, "_LOOKED": 2, "_EVALUATED": 2, "_RUNS": 1}
    for name, value in sizes.items():
        monkeypatch.setattr(posterior, name, value)
    env, prior = envs.make("push", "c"), load_prior("shipped:push/seed-0")
    entry = interface.entry_of(env)
    unlearned = shaped(entry["steps"], entry["measured"], env.act_dim, len(entry["unknowns"]))
    known = Prior(prior.params._replace(estimator=unlearned), {**prior.card, "estimator": entry})
    save_prior(tmp_path / "priors/push/seed-0", known)
    args = posterior.PosteriorArgs(
        tasks=("push",),
        systems=2,
        rollouts=(1,),
        gaps=("envs/gaps/push.toml",),
        priors=tmp_path / "priors",
        beliefs=("posterior", "another", "single", "truth"),
        impl="c",
        json=True,
        out=tmp_path,
    )
    posterior.main(args)
    summary = json.loads((tmp_path / "posterior/summary.json").read_text())
    assert json.loads(capsys.readouterr().out) == summary
    for lines, beliefs in ((summary["calibrate"], 1), (summary["deploy"], 4)):
        assert [line["rollouts"] for line in lines] == [0] * beliefs + [1] * beliefs
        numbers = [value for line in lines for value in line.values() if isinstance(value, float)]
        assert np.isfinite(numbers).all()
    assert len(summary["calibrate"][0]["by unknown"]) == 12 and len(summary["deploy"][0]["gaps"]) == 2


def test_bad_numbers_are_one_line_and_leave_nothing(tmp_path, capsys):
    from experiments.runner import cli

    with pytest.raises(SystemExit) as stopped:
        cli.run_main(
            posterior.main,
            posterior.PosteriorArgs,
            "",
            argv=["--rollouts", "2", "0", "--out", str(tmp_path / "out")],
        )
    assert stopped.value.code == 2 and "--rollouts is 0" in capsys.readouterr().err and not any(tmp_path.iterdir())
