"""Choosing a frozen set from a made-up table."""

import pytest

from envs import gaps
from envs.gaps import Gap
from envs.types import UserError
from experiments.studies import gaps_draw


def line(stratum, *families, admitted=None):
    return {"stratum": stratum, "gap": {"families": list(families)}, "admitted": admitted}


def table(**numbers):
    """So many gaps of each stratum, of one family, called a0, a1, ... by the first letter's."""
    return {f"{s[0]}{i}": line(s, "one") for s, n in numbers.items() for i in range(n)}


def test_strata_take_turns_and_the_lowest_index_wins():
    lines = {"sim": line("solved"), **table(solved=6, partial=4, failed=3)}
    assert gaps_draw.choose(lines, 8) == ["s0", "s1", "s2", "p0", "p1", "p2", "f0", "f1"]
    assert gaps_draw.choose(lines, 1) == ["s0"]
    assert gaps_draw.choose(dict(reversed(lines.items())), 2) == ["p3", "s5"]  # in the order of the table


def test_a_stratum_with_too_few_gaps_passes_its_turn_on_and_says_so():
    lines = table(solved=6, partial=5, failed=1)
    chosen = gaps_draw.choose(lines, 8)
    assert chosen == ["s0", "s1", "s2", "s3", "p0", "p1", "p2", "f0"]
    assert gaps_draw.remarks(lines, chosen)[0] == "too few gaps: failed has 1 of 2; other strata give the rest"
    lines = table(solved=1, failed=6)
    assert gaps_draw.choose(lines, 4) == ["s0", "f0", "f1", "f2"]
    assert "solved has 1 of 2, partial has 0 of 1;" in gaps_draw.remarks(lines, ["s0", "f0", "f1", "f2"])[0]
    with pytest.raises(UserError, match="--choose 8: only 7 of the gaps may be chosen; draw more with --count"):
        gaps_draw.choose(lines, 8)


def test_families_are_covered_as_evenly_as_the_strata_allow():
    lines = {
        "a": line("solved", "x"),
        "b": line("solved", "x"),
        "c": line("solved", "y", "z"),
        "d": line("partial", "x"),
        "e": line("partial", "y"),
        "f": line("failed", "x", "y"),
        "g": line("failed", "z"),
    }
    assert gaps_draw.choose(lines, 3) == ["a", "e", "g"]  # "d" would be a second x, "f" a second x and y, before a z
    assert gaps_draw.choose(lines, 4) == ["a", "b", "e", "g"]  # 2, 1, 1 is as even as 1, 2, 2 with "c"
    assert gaps_draw.choose({**lines, "b": line("solved", "x", "y", "z")}, 4) == ["a", "b", "e", "g"]
    lines["f"] = line("partial", "z")
    assert gaps_draw.choose({**lines, "a": line("solved", "y")}, 3) == ["a", "d", "g"]


def test_of_gaps_with_one_family_each_as_many_of_every_family_three_quarters_open_where_there_are():
    strata = {"s": "solved", "p": "partial", "f": "failed"}

    def family(name, letters, admitted=None):
        return {f"{name}{i}": line(strata[x], name, admitted=admitted) for i, x in enumerate(letters)}

    lines = family("a", "ssfppp") | family("b", "sssps") | family("c", "fffff") | family("c", "f", admitted=False)
    assert " ".join(gaps_draw.choose_alone(lines, 12)) == "a0 a2 a3 a4 b0 b1 b2 b3 c1 c2 c3 c4"
    with pytest.raises(UserError, match="--choose 15: c has 4 gaps of 5"):
        gaps_draw.choose_alone(lines, 15)


def test_gaps_that_nobody_mastered_or_measured_and_sim_are_never_chosen():
    lines = {
        "sim": line("solved", admitted=True),
        "beyond": line("solved", admitted=False),
        "fine": line("solved", admitted=True),
        "unmeasured": line(None),
        "open": line("failed"),
    }
    assert gaps_draw.choose(lines, 2) == ["fine", "open"]
    with pytest.raises(UserError, match="only 2"):
        gaps_draw.choose(lines, 3)
    said = gaps_draw.remarks(lines, ["fine", "open"])
    assert said[-1] == "nobody checked that these gaps can be mastered, --judge does: open"
    assert gaps_draw.remarks(table(solved=1) | {"s0": line("solved", admitted=True)}, ["s0"]) == []


def test_the_file_says_what_it_holds_and_is_not_replaced_by_another(tmp_path):
    path, chosen = tmp_path / "test/push.toml", [Gap("a", {}, {"latency": 0.1}), Gap("b", {"mass": 2.0}, {})]
    gaps_draw.write(path, chosen, ["solved, 90 %", "failed, 0 %, trivial"], "this")
    assert list(gaps.read_file(path).values()) == chosen
    assert path.read_text().startswith("# Chosen by this\n\n# solved, 90 %\n[a]\n")
    gaps_draw.write(path, chosen, ["solved, 91 %", "failed, 0 %"], "this")  # measured again
    assert "91 %" in path.read_text()
    for other in (chosen[:1], chosen[::-1]):
        with pytest.raises(UserError, match=r"push.toml: holds other gaps; a frozen set is never replaced"):
            gaps_draw.write(path, other, ["x"] * len(other), "this")
