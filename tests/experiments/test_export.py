"""What is copied of runs, and what is not."""

import json
import shutil

import pytest
from runs_by_hand import rising, save

from experiments import cli, export
from experiments.figures import FiguresArgs, figures
from sgft_jax.types import UserError


def finish(folder, *, transitions=None, **config):
    """The rest of a finished run, large files included, with the origin of one that was started with absolute paths."""
    last = json.loads((folder / "eval.jsonl").read_text().splitlines()[-1])["step"]
    final = {"final": {"transitions": transitions or last}} if "finetune" in folder.parts else {}
    (folder / "summary.json").write_text(json.dumps(final))
    (folder / "timing.jsonl").write_text('{"rollouts": 10}\n')
    command = "finetune.py --task 'a b' --out /home/me/project/runs --prior=/scratch/me/priors/good"
    (folder / "provenance.json").write_text(json.dumps({"starts": [{"command": command, "started": "2026-11-22"}]}))
    stored = json.loads((folder / "config.json").read_text())
    stored["config"] |= config
    (folder / "config.json").write_text(json.dumps(stored))
    for heavy in (
        "metrics.jsonl",
        "checkpoints/10/state",
        "real/rollout-000000.npz",
        "policy/seed-0/prior.json",
        ".lock",
    ):
        (folder / heavy).parent.mkdir(parents=True, exist_ok=True)
        (folder / heavy).write_text("heavy")
    return folder


def pretrained(out):
    """A finished run of pretraining."""
    folder = out / "pretrain/toy/fast/seeds-0-1"
    folder.mkdir(parents=True)
    (folder / "eval.jsonl").write_text('{"step": 100, "success": [0.5, 1.0]}\n')
    (folder / "config.json").write_text(json.dumps({"sgft_jax": "0", "kind": "pretrain", "config": {"out": "runs"}}))
    return finish(folder)


def run(out, to, **more):
    return export.export(export.ExportArgs(out=out, to=to, **more))


def files(folder):
    return {str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()}


def test_texts_are_copied_and_nothing_heavy(tmp_path):
    finish(save(tmp_path / "runs", "sac", **rising(50)))
    pretrained(tmp_path / "runs")
    said = run(tmp_path / "runs", tmp_path / "data")
    run_files = ("config.json", "eval.jsonl", "provenance.json", "summary.json", "timing.jsonl")
    assert sorted(files(tmp_path / "data")) == [
        f"{folder}/seeds-0-1/{name}"
        for folder in ("finetune/toy/default/sac", "pretrain/toy/fast")
        for name in run_files
    ]
    assert said[:2] == ["finetune/toy/default/sac/seeds-0-1: new", "pretrain/toy/fast/seeds-0-1: new"]
    assert said[-1] == f"{tmp_path / 'data'}: 2 runs copied, 0 were there already"


def test_tuning_is_copied_with_its_trials(tmp_path):
    out = tmp_path / "runs"
    finish(save(out / "tune", "sac_trial-0", **rising(50)))
    chosen = {"options": {"utd": 2.0}, "trials": [{"folders": [str(tmp_path / "elsewhere/trial-0")]}]}
    (out / "tuned/toy").mkdir(parents=True)
    (out / "tuned/toy/sac.json").write_text(json.dumps(chosen))
    said = run(out, tmp_path / "data")
    assert said[:2] == ["tune/finetune/toy/default/sac_trial-0/seeds-0-1: new", "tuned/toy/sac.json: new"]
    copy = tmp_path / "data/tuned/toy/sac.json"
    assert json.loads(copy.read_text()) == chosen | {"trials": [{"folders": [".../trial-0"]}]}
    before = files(tmp_path / "data")
    assert run(out, tmp_path / "data")[0].startswith("made relative") and files(tmp_path / "data") == before
    (out / "tuned/toy/sac.json").write_text(json.dumps({"options": {"utd": 8.0}}))
    assert run(out, tmp_path / "data")[0] == "tuned/toy/sac.json: replaced another choice"
    assert json.loads(copy.read_text()) == {"options": {"utd": 8.0}}


def test_a_second_time_nothing_happens(tmp_path):
    finish(save(tmp_path / "runs", "sac", **rising(50)), out="/home/me/project/runs")
    run(tmp_path / "runs", tmp_path / "data")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "data").rglob("*")}
    assert run(tmp_path / "runs", tmp_path / "data")[-1].endswith(": 0 runs copied, 1 were there already")
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "data").rglob("*")} == before
    assert run(tmp_path / "data", tmp_path / "data")[-1].endswith(": 0 runs copied, 1 were there already")


def test_absolute_paths_become_relative_and_are_named(tmp_path):
    """To the parent of the runs, wherever those were; of what lies elsewhere the last name is left."""
    folder = save(tmp_path / "runs", "sac", **rising(50))
    finish(
        folder, out="/home/me/project/runs", prior="/home/me/project/runs/pretrain/push/fast", real="/data/me/gap.toml"
    )
    said = run(tmp_path / "runs", tmp_path / "data")
    copy = tmp_path / "data/finetune/toy/default/sac/seeds-0-1"
    config = json.loads((copy / "config.json").read_text())["config"]
    assert (config["out"], config["prior"], config["real"]) == ("runs", "runs/pretrain/push/fast", ".../gap.toml")
    (start,) = json.loads((copy / "provenance.json").read_text())["starts"]
    assert start["command"] == "finetune.py --task 'a b' --out runs --prior=.../good"
    assert "me/" not in "".join(files(tmp_path / "data").values())
    assert [line for line in said if line.startswith("made relative")] == [
        "made relative: --prior=/scratch/me/priors/good -> --prior=.../good",
        "made relative: /data/me/gap.toml -> .../gap.toml",
        "made relative: /home/me/project/runs -> runs",
        "made relative: /home/me/project/runs/pretrain/push/fast -> runs/pretrain/push/fast",
    ]


def test_a_longer_copy_is_kept_unless_told_otherwise(tmp_path):
    finish(save(tmp_path / "long", "sac", **rising(50)))
    shorter = finish(save(tmp_path / "short", "sac", **rising(20, to=40)))
    (shorter / "timing.jsonl").unlink()
    run(tmp_path / "long", tmp_path / "data")
    before = files(tmp_path / "data")
    kept = "sac/seeds-0-1: kept the one of 2,000 steps, this one has 800 (--overwrite replaces it)"
    assert run(tmp_path / "short", tmp_path / "data")[0].endswith(kept)
    assert files(tmp_path / "data") == before
    replaced = "sac/seeds-0-1: replaced one of 2,000 steps"
    assert run(tmp_path / "short", tmp_path / "data", overwrite=True)[0].endswith(replaced)
    after = files(tmp_path / "data")
    assert len(after) == 4 and len(before) == 5  # no file of the other run stays
    assert run(tmp_path / "long", tmp_path / "data")[0].endswith("replaced one of 800 steps")
    assert files(tmp_path / "data") == before


def test_unfinished_runs_are_left_out_unless_asked_for(tmp_path):
    out = tmp_path / "runs"
    finish(save(out, "sac", **rising(50)), transitions=1000)  # went on after its summary, and was killed
    (finish(save(out, "iql", **rising(50))) / "summary.json").unlink()
    with open(out / "finetune/toy/default/iql/seeds-0-1/eval.jsonl", "a") as log:
        log.write('{"step": 20')  # torn
    finish(save(out, "rlpd", **rising(50, to=0)))  # zero-shot alone
    said = run(out, tmp_path / "data")
    assert [line.partition(": ")[2][:28] for line in said[:3]] == [
        "left out, it is unfinished (", "left out, it has not learned", "left out, it is unfinished (",
    ]  # fmt: skip
    assert not (tmp_path / "data").exists()
    assert run(out, tmp_path / "data", unfinished=True)[-1].endswith(": 2 runs copied, 0 were there already")
    assert (tmp_path / "data/finetune/toy/default/iql/seeds-0-1/eval.jsonl").read_text().endswith("}\n")


def test_the_copy_gives_the_same_figures(tmp_path, monkeypatch):
    for name, reached in (("sac", 50), ("sgft-sac", 20)):
        finish(save(tmp_path / "runs", name, **rising(reached)), out=str(tmp_path / "runs"))
    run(tmp_path / "runs", tmp_path / "data")
    original = figures(FiguresArgs(out=tmp_path / "runs")).read_text()
    shutil.rmtree(tmp_path / "runs")
    assert figures(FiguresArgs(out=tmp_path / "data")).read_text() == original
    assert (tmp_path / "data/figures/overview.png").stat().st_size > 10_000


def test_a_folder_without_runs_is_an_error(tmp_path, monkeypatch, capsys):
    with pytest.raises(UserError, match="holds no run; --out names the parent"):
        run(tmp_path, tmp_path / "data")
    monkeypatch.setattr(cli, "set_up", lambda: None)
    with pytest.raises(SystemExit) as stopped:
        cli.run_main(export.main, export.ExportArgs, "Copy.", argv=["--out", str(tmp_path)])
    assert stopped.value.code == 2 and "holds no run" in capsys.readouterr().err
