import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from envs.types import UserError
from sgft_jax.files.disk import jsonable
from sgft_jax.io import runs
from sgft_jax.io.runs import Lock, opened, plain_path, provenance


@dataclasses.dataclass(frozen=True)
class Inner:
    lr: float = 1e-3
    layers: tuple[int, ...] = (2, 3)


@dataclasses.dataclass(frozen=True)
class Config:
    task: str = "hammer"
    inner: Inner = dataclasses.field(default_factory=Inner)
    resume: bool = False


def open_run(folder, config=None, *, kind="pretrain", say=lambda _: None, **options):
    return opened({folder: jsonable(config or Config())}, kind=kind, say=say, **options)


def start(folder, config=None, **options):
    with open_run(folder, config, **options) as (home,):
        return home


def starts_of(folder):
    return json.loads((folder / "provenance.json").read_text())["starts"]


def test_a_new_run_says_where_it_is_and_records_itself(tmp_path):
    heard = []
    folder = start(tmp_path / "runs" / "x", say=heard.append)
    assert heard == [f"run folder: {tmp_path / 'runs' / 'x'}"]
    assert folder == tmp_path / "runs" / "x"
    stored = json.loads((folder / "config.json").read_text())
    assert stored["kind"] == "pretrain" and stored["config"]["inner"] == {"lr": 0.001, "layers": [2, 3]}
    (first,) = starts_of(folder)
    assert first["versions"]["jax"] and first["device"]["platform"] == "cpu" and first["python"].startswith("3.")


def leave_a_checkpoint(folder):
    (folder / "checkpoints" / "10").mkdir(parents=True)


def test_an_existing_run_needs_a_decision(tmp_path):
    start(tmp_path / "x")
    leave_a_checkpoint(tmp_path / "x")
    with pytest.raises(UserError, match=r"x: exists already; continue it with --resume or replace it with --overwrite"):
        start(tmp_path / "x")
    with pytest.raises(UserError, match="exclude each other"):
        start(tmp_path / "x", resume=True, overwrite=True)


@pytest.mark.parametrize("result", ["checkpoints/10/manifest.json", "real/rollout-000000.npz", "summary.json"])
def test_a_start_that_failed_before_it_left_a_result_blocks_nobody(tmp_path, result):
    folder = start(tmp_path / "x")
    for name in ("random/checkpoints/0/manifest.json", "metrics.jsonl", "checkpoints/.tmp-10/manifest.json"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    start(folder, Config(task="push"))
    assert sorted(p.name for p in folder.iterdir()) == [".lock", "config.json", "provenance.json"]
    assert json.loads((folder / "config.json").read_text())["config"]["task"] == "push"
    (folder / result).parent.mkdir(parents=True, exist_ok=True)
    (folder / result).touch()
    with pytest.raises(UserError, match="exists already"):
        start(folder)


def test_a_folder_that_cannot_be_made_is_named_before_anything_is(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UserError, match=r"cannot be made, .*/file is a file; choose another --out"):
        start(tmp_path / "file" / "a" / "b")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    for name in ("loop", "dangling"):
        for folder in (tmp_path / name, tmp_path / name / "a" / "b"):
            with pytest.raises(UserError, match=f"cannot be made, .*/{name} is a link that leads nowhere"):
                start(folder)
    (tmp_path / "sound").symlink_to(tmp_path)
    runs.check_folder(tmp_path / "sound" / "a" / "b")
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write anywhere
    with pytest.raises(UserError, match="you may not write to"):
        start(tmp_path / "a" / "b")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["dangling", "file", "loop", "sound"]


def test_a_run_of_an_earlier_format_is_not_continued_but_may_be_replaced(tmp_path):
    folder = start(tmp_path / "x")
    stored = json.loads((folder / "config.json").read_text())
    del stored["format"]  # the first format did not say
    (folder / "config.json").write_text(json.dumps(stored | {"sgft_jax": "0.1.0"}))
    with pytest.raises(UserError, match=r"x: is a run of sgft_jax 0\.1\.0 in format 1; this version"):
        start(folder, resume=True)
    start(folder, overwrite=True)


def test_resume_keeps_everything_and_adds_a_start(tmp_path):
    start(tmp_path / "x")
    (tmp_path / "x" / "metrics.jsonl").write_text("{}\n")
    start(tmp_path / "x", Config(resume=True), resume=True)
    assert (tmp_path / "x" / "metrics.jsonl").read_text() == "{}\n"
    assert len(starts_of(tmp_path / "x")) == 2


def test_resume_names_every_field_that_differs(tmp_path):
    start(tmp_path / "x")
    other = Config(task="push", inner=Inner(layers=(2, 4)))
    with pytest.raises(UserError, match=r"task was 'hammer', now 'push'; inner.layers was \[2, 3\], now \[2, 4\]"):
        start(tmp_path / "x", other, resume=True)
    start(tmp_path / "x", other, resume=True, volatile=("task", "inner.layers"))
    with pytest.raises(UserError, match="is a pretrain run, not a finetune run"):
        start(tmp_path / "x", kind="finetune", resume=True)


def test_of_several_runs_all_open_or_none(tmp_path, monkeypatch):
    old, new = tmp_path / "old", tmp_path / "new"
    start(old)
    leave_a_checkpoint(old)
    both = {folder: {"task": folder.name} for folder in (new, old)}
    for options, words in (({}, "old: exists already"), ({"resume": True}, "new: nothing to resume there")):
        with pytest.raises(UserError, match=words), opened(both, kind="pretrain", say=lambda _: None, **options):
            pass
        assert not new.exists()
    held = Lock(old)
    for begun in (False, True):  # the other process takes the folder before it is looked at, or right afterwards
        assert not new.exists()
        if begun:
            monkeypatch.setattr(runs, "in_use", lambda folder: False)
        together = opened(both, kind="pretrain", overwrite=True, say=lambda _: None)
        with pytest.raises(UserError, match="old: another process is writing to it"), together:
            pass
    held.release()
    assert [path.name for path in new.iterdir()] == [".lock"]  # not begun, and not locked any more
    with opened(both, kind="pretrain", overwrite=True, say=lambda _: None) as folders:
        assert folders == [new, old]
    assert json.loads((new / "config.json").read_text())["config"] == {"task": "new"}
    assert len(starts_of(new)) == len(starts_of(old)) == 1


@pytest.mark.parametrize(("begun", "words"), [("y", "nothing is saved yet"), ("xy", "with --resume continues")])
def test_who_ends_a_run_hears_whether_it_can_go_on(tmp_path, begun, words):
    """Of several runs all have to."""
    together = opened({tmp_path / name: {} for name in "xy"}, kind="pretrain", say=lambda _: None)
    assert runs.outlook() == []
    with pytest.raises(KeyboardInterrupt), together:
        for name in begun:
            leave_a_checkpoint(tmp_path / name)
        raise KeyboardInterrupt
    assert words in runs.outlook()[0]
    with opened({tmp_path / "x": {}}, kind="pretrain", resume=len(begun) > 1, say=lambda _: None):
        pass  # as it was said
    assert runs.outlook() == []


def test_a_run_goes_on_with_the_inputs_that_it_began_with(tmp_path):
    given = {tmp_path / "x": {"task": "hammer"}}

    def begin(**more):
        with opened(given, kind="finetune", say=lambda _: None, **more):
            pass

    begin(inputs={"priors": ["ab"]})
    begin(resume=True, inputs={"priors": ["ab"], "maps": 3})  # the first start did not tell of maps
    with pytest.raises(UserError, match=r"other priors: they were \['ab'\], now \['cd'\]"):
        begin(resume=True, inputs={"priors": ["cd"]})
    with pytest.raises(UserError, match="other maps: they were 3, now 4"):
        begin(resume=True, inputs={"priors": ["ab"], "maps": 4})
    starts = json.loads((tmp_path / "x/provenance.json").read_text())["starts"]
    assert [start.get("maps") for start in starts] == [None, 3]
    (tmp_path / "x/provenance.json").write_text("{}")
    with pytest.raises(UserError, match=r"provenance.json: lacks starts; put back the file that the run has written"):
        begin(resume=True)
    begin(overwrite=True, inputs={"priors": ["cd"]})


def test_resume_of_nothing(tmp_path):
    with pytest.raises(UserError, match="nothing to resume there"):
        start(tmp_path / "x", resume=True)
    assert not (tmp_path / "x").exists()


def test_resume_of_a_run_killed_while_it_was_made_starts_it(tmp_path):
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / ".lock").touch()
    (tmp_path / "x" / ".tmp-config.json").write_text('{"sg')
    assert len(starts_of(start(tmp_path / "x", resume=True))) == 1


def test_overwrite_empties_a_run_and_nothing_else(tmp_path):
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "data").write_text("keep")
    folder = start(tmp_path / "x")
    (folder / "checkpoints" / "10").mkdir(parents=True)
    (folder / "link").symlink_to(precious)
    start(tmp_path / "x", Config(task="push"), overwrite=True)
    assert sorted(p.name for p in folder.iterdir()) == [".lock", "config.json", "provenance.json"]
    assert json.loads((folder / "config.json").read_text())["config"]["task"] == "push"
    assert len(starts_of(folder)) == 1
    assert (precious / "data").read_text() == "keep"


@pytest.mark.parametrize("content", [None, "{}", '{"config": {"task": "hammer"}}'])
def test_a_folder_that_is_no_run_is_left_alone(tmp_path, content):
    folder = tmp_path / "x"
    folder.mkdir()
    (folder / "thesis.tex").write_text("years")
    if content is not None:
        (folder / "config.json").write_text(content)
    for option in ({"overwrite": True}, {"resume": True}):
        with pytest.raises(UserError, match=r"is not a run folder|was not written by this project"):
            start(folder, **option)
    assert (folder / "thesis.tex").read_text() == "years"


HOLDER = """
import pathlib, sys, time
from sgft_jax.io.runs import opened
with opened({pathlib.Path(sys.argv[1]): {"task": "hammer"}}, kind="pretrain", say=lambda _: None):
    print("open", flush=True)
    time.sleep(60)
"""


def test_two_processes_never_share_a_folder_and_a_kill_frees_it(tmp_path):
    command = [sys.executable, "-c", HOLDER, str(tmp_path / "x")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=dict(os.environ)) as holder:
        assert holder.stdout.readline() == "open\n"
        with pytest.raises(UserError, match=r"x: another process is writing to it"):
            start(tmp_path / "x", overwrite=True)
        with pytest.raises(UserError, match=r"x: another process is writing to it"):
            runs.check_start(tmp_path / "x", resume=False, overwrite=False)  # what a command asks before anything slow
        holder.kill()
    start(tmp_path / "x", overwrite=True)


def test_a_forgotten_run_frees_its_folder(tmp_path):
    run = open_run(tmp_path / "x")
    run.__enter__()
    with pytest.raises(UserError, match="another process"):
        start(tmp_path / "x", resume=True)
    del run
    start(tmp_path / "x", resume=True)


def test_the_root_is_that_of_the_repository():
    assert (runs.ROOT / "pyproject.toml").exists()


def test_provenance_names_no_host_and_no_folder(monkeypatch):
    monkeypatch.setattr(runs, "ROOT", Path("/home/someone/project"))
    argv = ["/home/someone/project/experiments/pretrain.py", "--task", "a b", "--out=/home/someone/project/runs"]
    monkeypatch.setattr(sys, "argv", [*argv, "--prior", "/scratch/someone/a/prior"])
    monkeypatch.setattr(Path, "cwd", lambda: Path("/home/someone/project/docs"))
    record = provenance()
    assert record["command"] == "pretrain.py --task 'a b' --out=runs --prior .../prior"
    assert os.uname().nodename not in json.dumps(record) and "someone" not in json.dumps(record)
    if record["git"] is not None:
        assert len(record["git"]["commit"]) == 40 and record["git"]["dirty"] == bool(record["git"]["changed"])


@pytest.mark.parametrize(
    ("word", "plain"),
    [
        ("/home/me/project/runs/a", "runs/a"),
        ("/home/me/project", "."),
        ("--out=/home/me/runs", "--out=.../runs"),
        ("table=/data/x/my table.toml", "table=.../my table.toml"),
        ("~/runs", ".../runs"),
        ("/home/me/projects/runs", ".../runs"),  # begins alike, lies elsewhere
        ("runs/a", "runs/a"),
        ("action_scale=[1,0.5]", "action_scale=[1,0.5]"),
        ("1/2", "1/2"),
    ],
)
def test_paths_lose_the_folders_of_their_machine(word, plain):
    assert plain_path(word, [Path("/home/me/project")]) == plain
