"""All tasks in one figure and in two tables, from run folders made by hand."""

import pytest
from runs_by_hand import rising, save

from experiments import overview
from experiments.comparison import colour_order, figure_order, is_sgft, names_of, read_comparison, split
from sgft_jax.methods import METHODS


def read(out):
    return [read_comparison(folder) for folder in sorted(out.glob("finetune/*/*"))]


def part(out):
    found = read(out)
    return overview.overview(found, out, colour_order(names_of(found)))


def sections(out):
    return "\n\n".join(part(out).sections)


def test_which_methods_are_sgft():
    assert {name for name in METHODS if is_sgft(name)} == {
        "sgft", "sgft-sac", "sgft-relabel", "sgft-mpc", "sgft-tdmpc2",
    }  # fmt: skip
    assert is_sgft("sgft-sac_horizon-4") and not is_sgft("sac_tuned") and not is_sgft("sgft-mine")
    assert split("sgft-sac_a_b") == ("sgft-sac", "a_b") and split("my_own") == ("my_own", "")


@pytest.mark.parametrize(
    ("other", "own", "text"),
    [
        ((60, 100), (20, 100), "3.0 [3.0, 3.0]"),  # 1,200 and 400 transitions
        ((None, 100), (30, 100), "> 3.3"),  # at least 2,000 / 600: a lower bound is rounded down
        ((20, 100), (None, 60), "< 0.4"),  # at most 400 / 1,200: an upper bound is rounded up
        ((70, 100), (None, 100), "< 0.7"),  # exactly
        ((None, 100), (None, 60), "-"),
        ((0, 100), (20, 100), "-"),  # nothing was to be learned
    ],
)
def test_how_many_times_fewer(tmp_path, other, own, text):
    for name, (at, to) in (("sac", other), ("sgft-sac", own)):
        save(tmp_path, name, **rising(at, to=to))
    assert overview.times_fewer(*read(tmp_path), "sac", "sgft-sac") == text


def test_the_same_seeds_are_drawn_together(tmp_path):
    """Of either run the first seed gets there three times as early as the second one; SAC takes twice as long."""
    success = [[0, 0], [1, 0], [1, 1]]
    other = save(tmp_path, "sac", success, rollouts=[0, 20, 60]) / "config.json"
    config = save(tmp_path, "sgft-sac", success, rollouts=[0, 10, 30]) / "config.json"
    written = config.read_text()
    assert overview.times_fewer(*read(tmp_path), "sac", "sgft-sac") == "2.0 [2.0, 2.0]"
    config.write_text(written.replace('"seed": 0', '"seed": 2'))
    assert overview.times_fewer(*read(tmp_path), "sac", "sgft-sac") == "2.0 [0.7, 6.0]"
    config.unlink()
    other.unlink()  # of which seeds, nobody knows
    assert overview.times_fewer(*read(tmp_path), "sac", "sgft-sac") == "2.0 [0.7, 6.0]"
    config.write_text(written)
    other.write_text(written)
    save(tmp_path, "pbrs", [[0] * 3, [1] * 3], rollouts=[0, 30], seeds="seeds-0-2")
    assert overview.times_fewer(*read(tmp_path), "pbrs", "sgft-sac") == "1.0 [1.0, 3.0]"


def test_the_best_other_method_got_there_and_those_that_ended_before_are_named(tmp_path):
    """Nobody knows what a run that was ended early would have needed."""
    for name, reached, to in (("sac", 50, 100), ("pbrs", 80, 100), ("sgft-sac", 20, 100), ("my-own", 10, 100)):
        save(tmp_path, name, **rising(reached, to=to))
    save(tmp_path, "rlpd", **rising(None, to=40))
    save(tmp_path, "mbpo", **rising(None, to=60))
    save(tmp_path, "iql", **rising(None, to=0))  # only zero-shot: says nothing
    assert overview.best_other(read(tmp_path)[0].curves) == "sac"
    text = sections(tmp_path)
    assert "| best that is not SGFT | sac: 1,000 [1,000, 1,000]; ended before: rlpd at 800 |" in text
    assert "| sgft-sac | 2.5 [2.5, 2.5] |" in text


def test_where_no_other_method_got_there_the_one_that_ended_highest_bounds_the_ratio(tmp_path):
    """Not the one that ended first: a run ended early, which had learned nothing, would make any ratio small."""
    save(tmp_path, "sgft-sac", **rising(20))
    save(tmp_path, "iql", [[0, 0], [0.1, 0.2]], rollouts=[0, 14])
    save(tmp_path, "rlpd", [[0, 0], [0.6, 0.8]], rollouts=[0, 40])
    save(tmp_path, "sac", [[0, 0], [0.6, 0.8]], rollouts=[0, 80])
    text = sections(tmp_path)
    assert "| best that is not SGFT | rlpd: > 800; ended before: iql at 280 |" in text
    assert "| sgft-sac | > 2.0 |" in text


def test_tasks_are_columns_and_seeds_left_behind_are_counted(tmp_path):
    save(tmp_path, "sgft-sac", task="push", **rising(20))
    save(tmp_path, "sac", task="push", **rising(40))
    save(tmp_path, "sgft-sac", task="insert", rollouts=[0, 50, 100], success=[[0, 0], [1.0, 0.8], [1.0, 0.89]])
    save(tmp_path, "sac", task="hammer", real="hard", **rising(40))
    text = sections(tmp_path)
    assert "| method | insert | push |" in text  # hammer was not run on the default real system
    assert "| sgft-sac | 1,000 [1,000, > 2,000] (1 of 2) | 400 [400, 400] |" in text
    assert "| sac | - | 800 [800, 800] |" in text
    assert "| best that is not SGFT | - | sac: 800 [800, 800] |" in text and "| sgft-sac | - | 2.0 [2.0, 2.0] |" in text


def test_what_is_drawn_in_the_overview(tmp_path, monkeypatch):
    """Methods on the default real systems; variants in an overview of their own, if several methods have them."""
    drawn = {}
    monkeypatch.setattr(
        overview.plot, "curve_panels", lambda path, panels, **more: drawn.update({path: panels}) or path
    )
    for name in ("sac", "sgft-sac", "sgft-sac_horizon-4", "sac_tuned", "sgft-sac_tuned"):
        save(tmp_path, name, task="push", **rising(20))
    save(tmp_path, "sac", task="insert", **rising(20))
    save(tmp_path, "sac", task="insert", real="hard", **rising(20))
    text = sections(tmp_path)
    assert {path.name: {task: list(curves) for task, curves in panels.items()} for path, panels in drawn.items()} == {
        "overview.png": {"insert": ["sac"], "push": ["sgft-sac", "sac"]},
        "overview_tuned.png": {"push": ["sgft-sac_tuned", "sac_tuned"]},
    }
    assert "(overview.png)" in text and "(overview_tuned.png)" in text
    assert colour_order(names_of(read(tmp_path)))[:2] == ["sgft-sac", "sac"]  # before any variant


def test_a_variant_has_its_methods_colour_where_the_method_is_not_shown():
    order = ["sgft-sac", "sac", "mine", "sgft-sac_horizon-4", "sac_tuned"]
    methods = ["sgft-sac", "sac", "mine"]
    assert figure_order(order, methods[1:]) == methods
    assert figure_order(order, ["sgft-sac_tuned", "sac_tuned"]) == ["sgft-sac_tuned", "sac_tuned", "mine"]
    assert figure_order(order, ["sac", "sac_tuned", "sac_slow"]) == [*methods, "sac_tuned", "sac_slow"]
    assert figure_order(order, ["sac_tuned", "sac_slow"]) == [*methods, "sac_tuned", "sac_slow"]
    assert figure_order(order, ["rlpd_tuned", "sac"]) == [*methods, "rlpd_tuned"]


def test_no_overview_without_runs_on_the_default_real_systems(tmp_path):
    save(tmp_path, "sac", real="hard", **rising(20))
    assert part(tmp_path) == ([], ["all tasks: no run on a real system default"])


def test_no_ratio_without_both_sides(tmp_path):
    save(tmp_path, "sgft-sac", **rising(20))
    texts, missing = part(tmp_path)
    assert "times as many" not in "".join(texts) and "takes default runs of SGFT and of another" in missing[0]
