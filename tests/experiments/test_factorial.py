"""The factorial of SGFT's parts: its cells, what it refuses, and the report of runs that are there."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
import runs_by_hand

from envs.types import UserError
from experiments import figures
from experiments.runner import cli, grid
from experiments.studies import factorial
from experiments.studies.factorial import FactorialArgs
from sgft_jax.io import checkpoint

ARGS = FactorialArgs(tasks=("push",), reals=("default",), seeds=4, rollouts=4)


def test_every_combination_is_a_cell_of_its_own(tmp_path):
    cells = factorial.cells_of(replace(ARGS, out=tmp_path, anchor=0.1), "push", "default")
    assert len(cells) == 32 == len({cell.args.variant for cell in cells.values()})
    plain, full = (cells[(level,) * 5].args for level in (False, True))
    assert (plain.variant, full.variant) == ("task.reward-infinite-1-kept-none", "shaped-short-4-new-warm")
    first, last = plain.options, full.options
    assert (first.shape, first.shorten, first.horizon, first.reset_critic, first.lr_warmup) == (
        False,
        False,
        1,
        False,
        0,
    )
    assert (last.shape, last.shorten, last.horizon, last.reset_critic, last.lr_warmup) == (True, True, 4, True, None)
    assert first.branches == last.branches and first.anchor == last.anchor == 0.1
    assert {cell.state for cell in cells.values()} == {"missing"}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"methods": ("sac",)}, "--methods: the cells are all of sgft-parts"),
        ({"rollouts": 0}, "^--rollouts is 0: must be at least 1$"),
        ({"minutes": float("nan")}, "^--minutes is nan: must be at least 0$"),
        ({"eval_every": 0}, "^--eval-every is 0: must be at least 1$"),
        ({"horizon": 1}, "--horizon is 1: must be at"),
        ({"reals": ("sim", "push=sim")}, "^--reals names sim twice; name it once$"),
        ({"tasks": ("push", "insert"), "reals": ("insert=sim",)}, "^--reals: names no real system of push$"),
        ({"reals": ("insert=sim",)}, "there is no 'insert=sim'"),
    ],
)
def test_bad_input(changes, words):
    with pytest.raises(UserError, match=words):
        factorial.main(replace(ARGS, **changes))


def test_a_real_system_may_be_of_one_task_alone():
    args = replace(ARGS, tasks=("push", "insert"), reals=("push=mild", "sim", "insert=default"))
    assert factorial.reals_of(args, "push") == ("mild", "sim")
    assert factorial.reals_of(args, "insert") == ("sim", "default")


def leave(args):
    """A finished run in which shaping is worth 20 points at the end, and members differ by more."""
    (real,) = args.real
    end = np.array([0.1, 0.3, 0.5, 0.7]) + 0.2 * args.options.shape
    folder = runs_by_hand.save(
        args.out,
        f"sgft-parts_{args.variant}",
        [[0.1] * 4, end.tolist()],
        rollouts=(0, 4),
        task="push",
        real=real,
        seeds="seeds-0-3",
        variant=args.variant,
    )
    checkpoint.save(folder, 4, {}, meta={})
    (folder / "summary.json").write_text(json.dumps({"final": {"rollouts": 4}}))


@pytest.mark.heavy
def test_the_report_names_what_each_part_does(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(grid, "finetune", leave)
    monkeypatch.setattr(cli, "set_up", lambda: None)
    factorial.main(replace(ARGS, out=tmp_path))
    said = capsys.readouterr().out
    assert "| shape | 10 | 20 | 0 |" in said and "| shorten | 0 | 0 | 0 |" in said
    # From 10 to 60 %: an area of 35, where the cell without shaping ends at 40 % and has 25.
    assert "| shaped-short-4-new-warm | 10 60 | 35 | 0 | 10 |" in said
    assert "push, default, effects on success in per cent" in said
    found = json.loads((tmp_path / "factorial/factorial.json").read_text())
    np.testing.assert_allclose(found["push, default"]["end"]["shape"]["estimate"], 0.2)
    assert all((tmp_path / "factorial" / name).stat().st_size > 10_000 for name in ("factorial.png", "as-printed.png"))


@pytest.mark.heavy
def test_the_report_needs_only_released_tables(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(grid, "finetune", leave)
    monkeypatch.setattr(cli, "set_up", lambda: None)
    factorial.main(replace(ARGS, out=tmp_path / "runs"))
    figures.main(figures.FiguresArgs(export=tmp_path / "data", out=tmp_path / "runs"))
    capsys.readouterr()
    args = replace(ARGS, out=tmp_path, data=tmp_path / "data")
    factorial.main(args)
    said = capsys.readouterr().out
    assert "| shaped-short-4-new-warm | 10 60 | 35 | 0 | 10 |" in said and "| shape | 10 | 20 | 0 |" in said
    with pytest.raises(UserError, match=r"no run of sgft-parts on push, sim, variant task.reward-infinite-1-kept-none"):
        factorial.main(replace(args, reals=("sim",)))


def test_released_tables_with_two_sets_of_priors_are_refused(tmp_path):
    for seeds, priors in (("seeds-0-1", ("a" * 12, "b" * 12)), ("seeds-2-3", ("c" * 12, "d" * 12))):
        runs_by_hand.save(
            tmp_path / "runs",
            "sgft-parts_shaped-short-4-new-warm",
            [[0.1, 0.2]],
            rollouts=(0,),
            task="push",
            seeds=seeds,
            priors=priors,
            variant="shaped-short-4-new-warm",
        )
    figures.main(figures.FiguresArgs(export=tmp_path / "data", out=tmp_path / "runs"))
    with pytest.raises(UserError, match="ran with several sets of priors; keep one"):
        factorial.main(replace(ARGS, out=tmp_path, data=tmp_path / "data"))


# ------------------------------------------------------------ effects by hand

FACTORS = ("a", "b", "c")


def planted(members=12):
    """Scores in which a adds 0.3, b adds 0.2 where c is on, and priors differ by far more."""
    rng = np.random.default_rng(0)
    prior = rng.normal(size=members)
    return {
        (a, b, c): prior + 0.3 * a + 0.2 * (b and c) + rng.normal(scale=0.01, size=members)
        for a, b, c in itertools.product((False, True), repeat=3)
    }


def test_planted_effects_are_found_although_priors_differ():
    found = factorial.effects(planted(), FACTORS)
    assert set(found) == {"a", "b", "c", "a x b", "a x c", "b x c"}
    wanted = {"a": 0.3, "b": 0.1, "c": 0.1, "b x c": 0.1, "a x b": 0.0, "a x c": 0.0}
    for name, effect in wanted.items():
        np.testing.assert_allclose(found[name].estimate, effect, atol=0.01, err_msg=name)
        assert found[name].low <= found[name].estimate <= found[name].high
    assert found["a"].low > 0.25 and found["a x b"].low < 0.01


def test_a_missing_cell_is_named():
    cells = planted()
    del cells[True, False, True]
    with pytest.raises(ValueError, match=r"\(True, False, True\)"):
        factorial.effects(cells, FACTORS)
