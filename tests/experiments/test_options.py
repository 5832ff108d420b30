"""What commands share: seeds, where priors are, trees over seeds, and whether a run fits into memory."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from priors_by_hand import save_prior

from envs.types import UserError
from experiments.runner import machines, options
from experiments.runner.machines import reserve
from experiments.runner.options import check_task, command, prior_folders, seed_list, seeds_name
from sgft_jax.io.cards import resolve_shipped


def test_names_of_seeds():
    assert seeds_name(seed_list(3, 1)) == "seed-3"
    assert seeds_name(seed_list(3, 4)) == "seeds-3-6"
    assert seed_list(options.LAST_SEED, 1) == [2**31 - 1]


@pytest.mark.parametrize(
    ("first", "count", "words"),
    [
        (0, 0, "--seeds is 0: must be at least 1"),
        (-1, 1, "--seed is -1: seeds go from 0 to 2147483647$"),
        (2**31 - 1, 2, "--seed is 2147483647: seeds go from 0 to 2147483647, and --seeds 2"),
    ],
)
def test_seeds_out_of_range_are_named(first, count, words):
    with pytest.raises(UserError, match=words):
        seed_list(first, count)


@pytest.mark.parametrize(("text", "number"), [("1", 1), ("65535", 65535), ("0", None), ("65536", None), ("-1", None)])
def test_ports(text, number):
    assert options.port_of(text) == number


def test_small_checks_name_option_and_value(monkeypatch, tmp_path):
    options.at_least_one(SimpleNamespace(eval_every=1), "eval_every")
    with pytest.raises(UserError, match="--eval-every is 0: must be at least 1"):
        options.at_least_one(SimpleNamespace(eval_every=0), "eval_every")
    options.without_repeats("--methods", ["sac", "sgft-sac"])
    with pytest.raises(UserError, match="--methods names sac twice; name it once"):
        options.without_repeats("--methods", ["sac", "sgft-sac", "sac"])


def test_tasks_and_real_systems_are_checked_by_name(tmp_path):
    (tmp_path / "g.toml").touch()
    options.check_task("hammer", ["default", str(tmp_path / "g.toml")])
    for task, reals, words in (
        ("hamer", [], "did you mean 'hammer'"),
        ("hammer", ["mild", "hrad"], "gap of hammer: there is no 'hrad', did you mean 'hard'"),
        ("hammer", [str(tmp_path / "h.toml")], "h.toml: no such file"),
    ):
        with pytest.raises(UserError, match=words):
            options.check_task(task, reals)


def test_priors_are_found_in_order(tmp_path):
    home = tmp_path / "pretrain/toy/fast"
    for run, n in (("a", 10), ("a", 9), ("b", 2)):
        save_prior(home / run / "prior" / f"seed-{n}", n)

    def find(prior):
        return prior_folders(prior, out=tmp_path, task="toy", preset="fast")

    assert [folder.name for folder in find(None)] == ["seed-2", "seed-9", "seed-10"]
    assert [len(find(home / p)) for p in ("", "a", "a/prior", "a/prior/seed-9")] == [3, 2, 2, 1]


def test_shipped_priors_have_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (folder,) = prior_folders(Path("shipped:push"), out=tmp_path, task="push", preset="robust")
    assert folder == resolve_shipped("shipped:push/seed-0") and (folder / "prior.json").is_file()
    assert resolve_shipped("push") == Path("push")
    with pytest.raises(UserError, match="shipped prior: there is no 'psh', did you mean 'push'"):
        resolve_shipped("shipped:psh")
    with pytest.raises(UserError, match=r"shipped prior: there is no '\.\./x'"):
        resolve_shipped("shipped:../x")


def test_advice_where_there_is_no_prior_fits_what_was_asked(tmp_path):
    """Of a task that is a file it repeats the file; where the user names a folder it proposes no task."""
    with pytest.raises(UserError, match=r"toy/cpu: holds no prior; make one with: .*--task my/toy.py --preset cpu"):
        prior_folders(None, out=tmp_path, task="my/toy.py", preset="cpu")
    with pytest.raises(UserError, match=r"--task push --preset robust, or take --prior shipped:push, which"):
        prior_folders(None, out=tmp_path, task="push", preset="robust")
    with pytest.raises(UserError, match=r"--preset: there is no 'cpus', did you mean 'cpu'"):
        prior_folders(None, out=tmp_path, task="toy", preset="cpus")
    with pytest.raises(UserError, match=r"--prior .*nowhere: no such folder$"):
        prior_folders(tmp_path / "nowhere", out=tmp_path, task="toy", preset="cpu")
    with pytest.raises(UserError, match=r"--prior .*: holds no prior$"):
        prior_folders(tmp_path, out=tmp_path, task="toy", preset="cpu")


def test_a_command_is_what_a_user_types():
    given = {"task": "my task.py", "best": True, "set": ("mass=1", "scale=[1,2]"), "real": None, "out": Path("runs")}
    wanted = "python -m experiments.evaluate --task 'my task.py' --best --set mass=1 'scale=[1,2]'"
    assert command("evaluate", **given) == wanted and command("figures", out="else").endswith(" --out else")


def test_what_no_real_system_has_is_found_before_anything_is_compiled(tmp_path):
    check_task("push", ["default"], ["latency=0.05", "object_mass=0.1"])
    (tmp_path / "odd.toml").write_text("[params]\nobject_mas = 0.1\n")
    for reals, changes, words in (
        ([], ["latencyy=0.05"], "did you mean 'latency'"),
        ([f"{tmp_path}/odd.toml"], [], "did you mean 'object_mass'"),
        (["runs/nothing"], [], "runs/nothing: no such folder"),
        ([str(tmp_path)], [], "is a folder; name a gap"),
    ):
        with pytest.raises(UserError, match=words):
            check_task("push", reals, changes)


def test_a_budget_that_does_not_fit_names_the_largest_part(monkeypatch, capsys):
    parts = {"random_transitions": 2**30, "replay_capacity": 3 * 2**30}
    monkeypatch.setattr(machines, "free_memory", lambda: 5 * 2**30)
    reserve(parts, copies=2, devices=2)  # 4 GiB each
    assert capsys.readouterr().out == (
        "memory: 4.00 GiB needed on each device, 5.00 GiB free "
        "(random_transitions 1.00 GiB, replay_capacity 3.00 GiB)\n"
    )
    with pytest.raises(UserError, match=r"8\.00 GiB on each device, 5\.00 GiB free: lower --config\.replay-capacity"):
        reserve(parts, copies=2)
    with pytest.raises(UserError, match=r"7\.00 GiB on each device, 5\.00 GiB free: lower --schedule\.buffer"):
        reserve({"buffer": 2**31}, copies=3, shared=2**30, settings="schedule")  # what is shared counts once
    assert "(buffer 6.00 GiB, data 1.00 GiB)" in capsys.readouterr().out
    monkeypatch.setattr(machines, "free_memory", lambda: None)
    reserve(parts, copies=2)  # nobody knows: the run may try
