"""The demo from a prior to the table, on a point mass."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from priors_by_hand import save_prior
from runs_by_hand import save

import envs
from envs.types import UserError
from experiments import demo
from sgft_jax.analysis.reading import read_runs


class Beside:
    """A process that does its work when it is waited for; a real one would not know the point mass."""

    exitcode = 0

    def __init__(self, target, args, daemon):
        assert daemon  # it must not outlive the demo
        self.work = lambda: target(*args)

    def start(self):
        pass

    def join(self):
        self.work()

    def kill(self):
        pass


class Failed(Beside):
    exitcode = 1

    def join(self):
        pass


def beside(monkeypatch, process):
    monkeypatch.setattr(demo.multiprocessing, "get_context", lambda method: SimpleNamespace(Process=process))


@pytest.mark.slow
def test_demo_compares_its_methods_from_one_prior(tmp_path, monkeypatch, capsys):
    beside(monkeypatch, Beside)
    monkeypatch.setitem(envs.TASKS, "toy", "toy")
    gap = tmp_path / "turned.toml"
    gap.write_text("[params]\nmass = 2.0\n[effects]\naction_rotation = 0.52\n")
    out, prior = tmp_path / "demo", tmp_path / "prior"
    save_prior(prior, 0)
    demo.main(demo.DemoArgs(task="toy", prior=prior, real=str(gap), seeds=2, rollouts=3, video=False, out=out))
    printed = capsys.readouterr().out
    table = [line for line in printed.splitlines() if line.startswith("|")]
    assert set(demo.METHODS) <= {line.split("|")[1].strip() for line in table}
    for method in demo.METHODS:
        run = out / "finetune" / "toy" / "turned" / method / "seeds-0-1"
        assert (run / "summary.json").exists() and len(list((run / "real").glob("*.npz"))) == 3
    assert "rollouts" in (out / "beside.log").read_text()
    assert "Those that did best in the real rollouts: sgft-mpc " in printed


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"seeds": 0}, "--seeds is 0: must be at least 1"),
        ({"rollouts": 0}, "--rollouts is 0: must be at least 1"),
        ({"task": "insrt"}, "there is no 'insrt', did you mean 'insert'"),
        ({"real": "hrd"}, "gap of insert: there is no 'hrd', did you mean 'hard'"),
        ({"prior": Path("nowhere")}, "--prior nowhere: no such folder"),
    ],
)
def test_mistakes_are_found_before_anything_is_trained(tmp_path, monkeypatch, options, words):
    monkeypatch.setattr(demo, "finetune", lambda args: pytest.fail("trains"))
    with pytest.raises(UserError, match=words):
        demo.main(demo.DemoArgs(out=tmp_path, **options))
    assert not list(tmp_path.iterdir())


def test_the_outcome_is_said_in_a_few_lines(tmp_path):
    for method, end in (("sgft-sac", 0.9), ("sac", 0.2)):
        save(tmp_path, method, [[0.0, 0.0], [end, end]], rollouts=[0, 5])
    save(tmp_path, "sgft-mpc", [[0.0, 0.0], [0.5, 0.5], [1.0, 1.0]], rollouts=[0, 1, 5])  # learns from the first on
    best = {"sgft-mpc": {"best": {"score": [0.75, 1.0]}}}
    said = demo.outcome(read_runs(tmp_path).curves, best).splitlines()
    assert said[2:7] == [
        "| method | zero-shot | 1 rollout | 5 rollouts |",
        "| --- | --- | --- | --- |",
        "| sac | 0 | - | 20 |",
        "| sgft-mpc | 0 | 50 | 100 |",
        "| sgft-sac | 0 | - | 90 |",
    ]
    assert "did best in the real rollouts: sgft-mpc 88" in said[8]  # (75 + 100) / 2


def test_a_failure_beside_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "finetune", lambda args: None)
    beside(monkeypatch, Failed)
    runs = [demo.FinetuneArgs(method=method, out=tmp_path) for method in demo.METHODS]
    with pytest.raises(UserError, match=r"fine-tuning with sgft-sac or sac failed, see .*beside\.log"):
        demo._finetune_all(*runs)
