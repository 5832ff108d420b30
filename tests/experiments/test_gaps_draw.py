"""Drawn gaps end to end: a hand that commands move by a matrix, and a policy that goes straight to the goal."""

import json
import os
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_steps
from priors_by_hand import save_prior

import envs
from envs import gap_distribution, gaps
from envs.files import read_json
from envs.gaps import Gap
from envs.types import UserError
from experiments.runner import cli
from experiments.studies import gaps_draw as command
from experiments.studies import gaps_drawn
from sgft_jax.algorithms import make_policy
from sgft_jax.models.distortion import interface

TEXT = """
[actuation]
action_rotation = [1.2, 1.4]
[contact]
slip = [0.0, 0.1]
"""
OPTIONS = """--task toy_steps --preset cpu --seed 5 --episodes 200 --config.n-envs 16 --config.worlds 4
    --config.env-steps 320 --config.random-transitions 320 --config.replay-capacity 640 --config.batch-size 16
    --config.chunk-steps 20 --config.updates-per-step 1 --config.network.hidden 8 --config.eval-every 1
    --config.eval-episodes 8"""


def blindly(network, task):
    """Identification that finds nothing."""
    return exactly(network, task)._replace(refit=lambda known, seen: known)


def straight(params, carry, obs, key, *, explore):
    noise = jnp.where(explore, 0.5, 0.0) * jax.random.normal(key, (2,))
    action = jnp.clip(2.0 * (obs[:2] - obs[2:4]) + noise, -1.0, 1.0)
    return action if params.distortion is None else params.distortion.command(action), carry


def exactly(network, task):
    """Identification through a model that is right."""

    def model(params, obs, action):
        return jnp.concatenate([jnp.zeros(2), 0.1 * action])

    return interface(model, lambda params: (), task)


@pytest.fixture
def home(tmp_path, monkeypatch):
    """Two priors, whose policies go straight to the goal, and a distribution."""
    monkeypatch.setitem(envs.TASKS, "toy_steps", "toy_steps")
    monkeypatch.setattr(os, "environ", os.environ.copy())
    monkeypatch.setattr(cli, "set_up", lambda: None)

    def by_hand(card, env):
        return make_policy(card, env)._replace(act=straight)

    monkeypatch.setattr(gaps_drawn, "make_policy", by_hand)
    monkeypatch.setattr(gaps_drawn, "command_interface", exactly)
    for seed in (0, 1):
        save_prior(tmp_path / f"pretrain/toy_steps/cpu/seeds-0-1/prior/seed-{seed}", seed, task="toy_steps")
    (tmp_path / "families.toml").write_text(TEXT)
    return tmp_path


def call(home, *more):
    command.main([*OPTIONS.split(), "--out", str(home), "--distribution", str(home / "families.toml"), *more])
    return json.loads((home / "gaps/toy_steps/seed-5.json").read_text())


@pytest.mark.slow
def test_drawn_gaps_are_written_measured_and_sorted(home, capsys, monkeypatch):
    found = call(home, "--count", "6")["gaps"]
    file = home / "gaps/toy_steps/seed-5.toml"
    env = envs.make("toy_steps")
    drawn = gap_distribution.draw(env, gap_distribution.load(env, home / "families.toml"), 5, 6)
    assert list(gaps.read_file(file).values()) == drawn and list(found) == ["sim", *(gap.name for gap in drawn)]
    assert found["sim"]["stratum"] == "solved" and found["sim"]["zero_shot"]["success"] > 0.95
    for gap in drawn:
        line = found[gap.name]
        assert gaps_drawn.jsonable(gap.table) == line["gap"] and len(line["zero_shot"]["policies"]) == 2
        turned = "actuation" in gap.families  # the hand comes half the way in the time there is
        assert line["stratum"] == ("failed" if turned else "solved")
        assert line["fit"]["success"] > 0.9 and line["trivial"] is True
        assert line["admitted"] is True and line["mastered_by"] == ("fit" if turned else "zero_shot")
    assert {line["stratum"] for line in found.values()} == {"failed", "solved"}
    head, *rows = capsys.readouterr().out.splitlines()
    assert (
        head.startswith("gap")
        and rows[0].split()[:2] == ["sim", "none"]
        and rows[-1] == f"table: {file.with_suffix('.json')}"
    )

    measured, whole = [], gaps_drawn._zero_shot

    def noted(env, missing, *given):
        measured.append([gap.name for gap in missing])
        return whole(env, missing, *given)

    monkeypatch.setattr(gaps_drawn, "_zero_shot", noted)
    frozen = home / "frozen.toml"
    to = ["--choose", "4", "--to", str(frozen)]
    assert call(home, "--count", "4")["gaps"] == call(home, "--count", "6", *to)["gaps"] == found and measured == []
    chosen = gaps.read_file(frozen)
    assert list(chosen.values()) == [
        gap._replace(stratum=found[gap.name]["stratum"]) for gap in drawn if gap.name in chosen
    ]
    head, *text = frozen.read_text().splitlines()
    assert head.startswith(
        "# Chosen by python -m experiments.studies.gaps_draw --task toy_steps --count 6 --seed 5 --distribution "
    )
    comments = [line for line in text if line.startswith("# ")]
    assert len(comments) == 4 and re.fullmatch(r"# zero-shot \d+ %, trivial, mastered after fit", comments[0])
    few, last = capsys.readouterr().out.splitlines()[-2:]
    assert few.startswith("too few gaps: ") and "partial has 0 of 1;" in few and last == f"chosen: {frozen}"
    with pytest.raises(SystemExit):
        call(home, "--count", "6", "--choose", "3", "--to", str(frozen))
    assert "frozen.toml: holds other gaps; a frozen set is never replaced" in capsys.readouterr().err
    more = call(home, "--count", "7")["gaps"]
    assert measured == [["toy_steps-5-06"]] and len(gaps.read_file(file)) == 7
    assert {name: more[name] for name in found} == found

    save_prior(home / "other/seed-3", 3, task="toy_steps")
    with pytest.raises(SystemExit):
        call(home, "--count", "4", "--prior", str(home / "other"))
    assert "seed-5.json: zero-shot was measured with other priors, see its 'about'; --over" in capsys.readouterr().err
    (home / "families.toml").write_text(TEXT.replace("1.4", "1.5").replace("0.1", "0.2"))
    with pytest.raises(SystemExit):
        call(home, "--count", "4")
    assert "toy_steps-5-00 is not what is drawn now" in capsys.readouterr().err
    file.unlink()
    with pytest.raises(SystemExit):
        call(home, "--count", "4")
    assert "seed-5.json: its toy_steps-5-00 is another gap; choose another --out" in capsys.readouterr().err


def test_gaps_are_measured_scene_by_scene_and_halfway_through_a_drift():
    env = toy_steps.make()
    plain, other = Gap("plain", {}, {}), Gap("other", {}, {}, scene="else")
    off = Gap("off", {}, {"obs_bias": {"goal": [1.0, 0.0]}}, drift={"goal": [0.0, 0.01]})
    groups = gaps_drawn._together(env, [plain, other, off])
    assert [[gap.name for gap in group] for group in groups] == [["plain", "off"], ["other"]]
    assert groups[0][0] is plain and not groups[0][1].drift
    np.testing.assert_allclose(groups[0][1].effects["obs_bias"], [[1, 0.1, 0, 0]] * 2, atol=1e-6)


@pytest.mark.slow
def test_policies_are_trained_where_nothing_else_masters_the_gap(home, monkeypatch, capsys):
    monkeypatch.setattr(gaps_drawn, "command_interface", blindly)
    trained = []

    def judge(env, args, found, seeds, folder):
        trained.append([gap.name for gap in found])
        reached = zip(trained[-1], [0.95, *[0.5] * (len(found) - 1)], strict=True)
        return {n: {"judge": {"success": s, "interval": [s, s], "policies": [{"success": s}]}} for n, s in reached}

    monkeypatch.setattr(gaps_drawn, "_judge", judge)
    (home / "families.toml").write_text(TEXT.replace("1.2", "0.0"))  # some are turned too little to matter
    found = call(home, "--count", "6", "--judge")["gaps"]
    del found["sim"]
    hard = [name for name, line in found.items() if line["zero_shot"]["success"] < 0.9]
    assert trained == [hard] and 1 < len(hard) < 6
    shown = {name: line["mastered_by"] for name, line in found.items()}
    assert shown == {name: None if name in hard else "zero_shot" for name in found} | {hard[0]: "judge"}
    assert all(found[name]["admitted"] is False for name in hard[1:])
    rows = [row.rpartition("  ")[2] for row in capsys.readouterr().out.splitlines()[2:8]]
    assert {*rows} >= {"mastered after training", "not mastered"} and "judge" not in found[
        (set(found) - set(hard)).pop()
    ]
    call(home, "--count", "6", "--judge")
    assert len(trained) == 1


@pytest.mark.slow
def test_the_plan_and_the_judge_are_measured_where_they_are_missing(home, monkeypatch, capsys):
    seen, train = [], gaps_drawn.train

    def noted(env, config, found, *given, **more):
        seen.append((more["seen"].obs_dim, config.batch_size, [gap.name for gap in found]))
        return train(env, config, found, *given, **more)

    monkeypatch.setattr(gaps_drawn, "train", noted)
    monkeypatch.setattr(gaps_drawn, "command_interface", blindly)
    call(home, "--count", "1")
    found = call(home, "--count", "2", "--plan", "--judge", "--judge-preset", "cpu", "--seeds", "2")["gaps"]
    assert seen == [(8, 16, ["toy_steps-5-00", "toy_steps-5-01"])]
    assert all(0 <= line["plan"]["success"] <= 1 for line in found.values()) and "judge" not in found["sim"]
    for name in seen[0][2]:
        assert (
            len(found[name]["judge"]["policies"]) == 2 and found[name]["admitted"] is False
        )  # one update teaches nothing
    same = ["--count", "2", "--plan", "--judge", "--judge-preset", "cpu", "--seeds"]
    assert call(home, *same, "2")["gaps"] == found and len(seen) == 1
    with pytest.raises(SystemExit):
        call(home, *same, "1")
    assert "judge was measured with other seeds" in capsys.readouterr().err
    again = call(home, *same, "1", "--overwrite")
    assert len(seen) == 2 and again["about"]["judge"]["seeds"] == [5]
    for name in seen[0][2]:
        assert again["gaps"][name]["zero_shot"] == found[name]["zero_shot"]
        assert len(again["gaps"][name]["judge"]["policies"]) == 1


@pytest.mark.parametrize(
    ("success", "stratum"), [(1.0, "solved"), (0.8, "solved"), (0.79, "partial"), (0.2, "partial"), (0.19, "failed")]
)
def test_strata(success, stratum):
    assert gaps_drawn.labels({"zero_shot": rate(success)})["stratum"] == stratum


def test_labels_say_what_is_known():
    some, most = rate(0.8, 0.88), rate(0.8, 0.9)
    assert gaps_drawn.labels({}) == {"stratum": None, "trivial": None, "admitted": None, "mastered_by": None}
    known = gaps_drawn.labels({"zero_shot": some, "fit": some})
    assert known == {"stratum": "solved", "trivial": False, "admitted": None, "mastered_by": None}
    judged = gaps_drawn.labels({"zero_shot": some, "fit": some, "judge": most})
    assert judged == {**known, "admitted": True, "mastered_by": "judge"}  # the best policy counts


@pytest.mark.parametrize("what", ["zero_shot", "fit", "plan"])
def test_any_measurement_may_show_that_a_gap_can_be_mastered(what):
    line = {"judge": rate(0.5), "zero_shot": rate(0.1), "fit": rate(0.0, 0.89)}
    assert gaps_drawn.labels(line)["admitted"] is False and gaps_drawn.labels(line)["mastered_by"] is None
    found = gaps_drawn.labels({**line, what: rate(0.2, 0.9)})
    assert found["admitted"] is True and found["mastered_by"] == what


@pytest.mark.heavy_after_first
@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--count", "0"], "--count is 0: must be at least 1"),
        (["--judge"], "--count is missing"),
        (["--count", "2", "--choose", "3", "--to", "f.toml"], "--choose is 3: must be from 1 to the 2 of --count"),
        (["--count", "2", "--choose", "1"], "--choose N and --to FILE.toml: give both"),
        (["--count", "2", "--choose", "1", "--to", "f.json"], "--to f.json: must end in .toml"),
        (["--count", "2", "--judge-preset", "fats"], "--judge-preset: there is no 'fats', did you mean 'fast'?"),
        (["--count", "2"], "toy_steps comes with no distribution of gaps; name a file of one"),
    ],
)
def test_a_bad_command_is_one_line_and_code_2(home, more, words, capsys):
    task = ["--task", "toy_steps", "--preset", "cpu", "--out", str(home)]
    with pytest.raises(SystemExit) as stopped:
        command.main([*task, *more])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and words in error and error.count("\n") == 1


def test_the_settings_of_the_training_are_those_of_the_preset_that_trains(monkeypatch):
    seen = []
    monkeypatch.setattr(command, "draw", seen.append)
    command.main(["--count", "2", "--preset", "cpu", "--judge-preset", "paper"])
    assert [args.config.n_envs for args in seen] == [64]


GAPS = [gaps.Gap(name, {}, {}) for name in ("a", "b")]


def rate(*successes):
    """What was measured with policies of these successes."""
    return {"success": sum(successes) / len(successes), "policies": [{"success": each} for each in successes]}


def begun(path):
    """A table of two gaps, judged and not."""
    table = gaps_drawn.Table(path, {"task": "toy"}, GAPS)
    table.settle("zero_shot", {"episodes": 200}, again=False)
    table.settle("judge", {"config": {"rate": 0.1}, "seeds": [0]}, again=False)
    some, most = rate(0.85), rate(0.95)
    table.add({"a": {"zero_shot": some, "fit": some, "judge": most}, "b": {"zero_shot": some}})
    return table


def test_a_table_is_only_continued_as_it_was_begun(tmp_path):
    path = tmp_path / "t.json"
    begun(path)
    assert read_json(path)["gaps"]["a"]["mastered_by"] == "judge"
    table = gaps_drawn.Table(path, {"task": "toy"}, GAPS)
    table.settle("zero_shot", {"episodes": 200}, again=False)
    with pytest.raises(UserError, match=r"t.json: judge was measured with other config.rate, see its 'about'; --over"):
        table.settle("judge", {"config": {"rate": 0.2}, "seeds": [0]}, again=False)
    with pytest.raises(UserError, match="is a table of another task"):
        gaps_drawn.Table(path, {"task": "push"}, GAPS)
    with pytest.raises(UserError, match="its b is another gap"):
        gaps_drawn.Table(path, {"task": "toy"}, [GAPS[0], GAPS[1]._replace(effects={"latency": 0.1})])
    (tmp_path / "old.json").write_text('{"task": "toy", "gaps": {}}')
    with pytest.raises(UserError, match=r"old.json: does not say how it was measured"):
        gaps_drawn.Table(tmp_path / "old.json", {"task": "toy"}, GAPS)


def test_other_settings_of_the_judge_forget_what_it_said_and_nothing_else(tmp_path):
    table = begun(tmp_path / "t.json")
    assert [gap.name for gap in table.to_judge(GAPS)] == ["b"]
    table.settle("judge", {"config": {"rate": 0.2}, "seeds": [0]}, again=True)
    assert table.to_judge(GAPS) == GAPS and table.without("zero_shot", GAPS) == []
    line = table.known["a"]
    assert line["admitted"] is None and line["stratum"] == "solved" and line["trivial"] is False
    table.add({"b": {"fit": rate(0.9)}})
    assert [gap.name for gap in table.to_judge(GAPS)] == ["a"]
