"""Gaps from names, files, dicts and overrides."""

import pathlib

import jax
import numpy as np
import pytest
import toy
from compiled import compiled

import envs
from envs import effects, gaps
from envs.base import Entry
from envs.franka import hammer, insert
from envs.gaps import Gap
from envs.mujoco.scene import make_env
from envs.types import UserError

ENV = compiled(toy.make())


@pytest.mark.heavy
def test_a_dict_is_what_a_file_would_hold(tmp_path):
    table = {"params": {"mass": 2.0, "friction": [3, 5]}, "effects": {"latency": [0.02, 0.04], "action_scale": 0.7}}
    gap = gaps.from_dict(ENV, "heavy", table)
    (tmp_path / "heavy.toml").write_text(
        "[params]\nmass = 2.0\nfriction = [3, 5]\n[effects]\nlatency = [0.02, 0.04]\naction_scale = 0.7\n"
    )
    assert gaps.load(ENV, str(tmp_path / "heavy.toml")) == gap
    worlds = gaps.worlds(ENV, gap, jax.random.key(0), n=3)
    np.testing.assert_allclose(worlds.theta.params[:, 0], 2.0)
    starts = jax.vmap(ENV.reset)(worlds, jax.random.split(jax.random.key(1), 3))
    assert len(set(starts.effects.latency.tolist())) == 3
    assert ((starts.effects.latency >= 0.02) & (starts.effects.latency <= 0.04)).all()


def test_ranges_of_vectors(tmp_path):
    gap = gaps.from_dict(
        ENV, "g", {"params": {"mass": 1.0, "friction": 4.0}, "effects": {"action_bias": [[0, 1], [0, 2]]}}
    )
    worlds = gaps.worlds(ENV, gap, jax.random.key(0))
    assert worlds.theta.params.shape == (1, 2)  # no parameter varies: one world will do
    drawn = jax.jit(jax.vmap(lambda key: ENV.reset(jax.tree.map(lambda x: x[0], worlds), key)))(
        jax.random.split(jax.random.key(0), 9)
    )
    assert (drawn.effects.action_bias[:, 0] == 0).all() and len(set(drawn.effects.action_bias[:, 1].tolist())) == 9


def test_parts_of_a_vector_are_named_by_entry():
    """velocity [m/s] of (xy [2], velocity [2]); xy stays as measured."""
    low, high = effects.make_range(
        ENV, {"obs_bias": {"velocity": [[0.1, -0.2], [0.1, 0.3]]}, "action_scale": {"force": 2}}
    )
    np.testing.assert_allclose(low.obs_bias, [0, 0, 0.1, -0.2])
    np.testing.assert_allclose(high.obs_bias, [0, 0, 0.1, 0.3])
    np.testing.assert_allclose(low.action_scale, [2, 2])
    single = ENV._replace(action=(Entry("x", "", 1), Entry("yz", "", 2)))
    low, high = effects.make_range(single, {"action_scale": {"x": [0.5, 0.7]}})
    np.testing.assert_allclose(low.action_scale, [0.5, 1, 1])  # what is not named has no effect
    np.testing.assert_allclose(high.action_scale, [0.7, 1, 1])


def test_the_camera_of_hammer_errs_in_x_alone():
    env = envs.make("hammer", "c")
    bias = effects.make_range(env, gaps.load(env, "camera").effects).low.obs_bias
    np.testing.assert_allclose(bias, np.eye(12)[10] * 0.029)


def test_a_file_holds_one_gap_or_several_by_name(tmp_path):
    one, two = Gap("one", {"mass": 2.0}, {}), Gap("the 2nd", {}, {"latency": 0.0312, "obs_bias": {"xy": [1e-5, -0.2]}})
    two = two._replace(families=("actuation", "sensing"), scene="ice")
    file = tmp_path / "some.toml"
    file.write_text("# words\n\n" + gaps.to_toml([one, two]))
    assert gaps.read_file(file) == {"one": one, "the 2nd": two}
    assert gaps.load(ENV, f"{file}:one") == one and gaps.title(f"{file}:one") == "one"
    assert gaps.load(ENV, f"{file}:the 2nd", ["latency=0.01"]).families == two.families
    (tmp_path / "alone.toml").write_text(gaps.to_toml([one]))
    assert gaps.load(ENV, str(tmp_path / "alone.toml")) == one
    assert gaps.title("a/alone.toml") == "alone" and gaps.title("mild") == "mild"
    named = (f"{file}:one", f"{file}:the 2nd")
    assert gaps.expand(["mild", str(file)]) == ("mild", *named) and gaps.expand(named) == named
    assert gaps.expand([str(tmp_path / "alone.toml")]) == (str(tmp_path / "alone.toml"),)
    with pytest.raises(UserError, match=r"some.toml holds 2 gaps; name one of them, e.g. .*some.toml:one$"):
        gaps.load(ENV, str(file))
    with pytest.raises(UserError, match=r"gap in .*some.toml: there is no 'tow'. Choose from: one, the 2nd"):
        gaps.load(ENV, f"{file}:tow")
    file.write_text("[a.params]\nmass = 2\n[b]\nfamilies = 'dynamics'\n")
    with pytest.raises(UserError, match=r"some.toml \[b\]: 'families' must be a list of names, got 'dynamics'"):
        gaps.read_file(file)


def test_in_the_gap_called_sim_nothing_differs(key):
    gap = gaps.load(ENV, "sim")
    assert gap == Gap("sim", {}, {})
    jax.tree.map(np.testing.assert_array_equal, gaps.worlds(ENV, gap, key, 7), envs.sample_worlds(ENV, key, 7))
    assert gaps.load(ENV, "sim", ["latency=0.03"]).effects == {"latency": 0.03}


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["latency=0.01", "latency=0.02"], "'latency=0.02': 'latency' is set twice; set it once"),
        (["latncy=0.01"], r"gap 'own\+latncy=0.01': 'latncy' is neither a parameter nor an effect .* mean 'latency'\?"),
        (["mass"], "'mass' does not set anything"),
        (["latency=[[1],2]"], "effect 'latency' needs one value"),
        (["mass=-2"], "parameter 'mass' must be at least 0.01, got -2"),
        (["latency=0.5"], "must be shorter than the control period of toy, 0.1 s"),
        (["obs_noise=NaN"], "'obs_noise=NaN' does not set anything"),
        (['obs_bias={"yx": 0.1}'], "entry of effect 'obs_bias': there is no 'yx'. Choose from"),
        (['obs_bias={"xy": [1, 2, 3]}'], "effect 'obs_bias.xy' needs 2 values or a range"),
        (['latency={"xy": 0.1}'], "effect 'latency' needs one value or a range"),
        (['mass={"xy": 0.1}'], "parameter 'mass' needs a value or a range"),
    ],
)
def test_bad_overrides_are_one_line(tmp_path, overrides, words):
    (tmp_path / "own.toml").write_text("")
    with pytest.raises(UserError, match=words) as refused:
        gaps.load(ENV, str(tmp_path / "own.toml"), overrides)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"families": [1]}, "gap 'g': 'families' must be a list of names"),
        ({"param": {}}, "gap 'g': unexpected 'param'"),
        ({"params": {"mass": "1"}}, "'mass' must be a number or a list of numbers, got '1'"),
        ({"params": {"mass": True}}, "'mass' must be a number"),
        ({"params": {"latency": 0.01}}, "'latency' is an effect of toy, not one of its parameters"),
        ({"effects": {"mass": 1.0}}, "'mass' is a parameter of toy, not one of its effects"),
        ({"params": [1.0]}, "'params' must be a table of names and numbers"),
    ],
)
def test_bad_tables_are_one_line(table, words):
    with pytest.raises(UserError, match=words):
        gaps.from_dict(ENV, "g", table)


def test_an_unknown_gap_gets_the_closest_match():
    with pytest.raises(
        UserError, match=r"gap of push: there is no 'defalt', did you mean 'default'\? .* or give a .toml"
    ):
        gaps.load(ENV._replace(name="push"), "defalt")


@pytest.mark.parametrize(
    ("scene", "params", "words"),
    [
        (insert, {"hole_radius": 0.011}, "hole_radius 0.011 m is narrower than peg_radius 0.0115 m"),
        (insert, {"hole_radius": [0.011, 0.013]}, "hole_radius 0.011 m is narrower"),
        (insert, {"peg_radius": [0.011, 0.0125]}, "is narrower than peg_radius 0.0125 m"),
        (insert, {"part_friction": -0.1}, "parameter 'part_friction' must be at least 0, got -0.1"),
        (hammer, {"nail_half_height": 0.3}, "nail_z less twice nail_half_height is the board's height, -0.05 m"),
        (hammer, {"hammer_mass": 0.0}, "parameter 'hammer_mass' must be at least 0.001, got 0.0"),
    ],
)
def test_what_cannot_be_built_is_refused_before_it_is(scene, params, words):
    env = make_env(scene.SCENE, "c")
    with pytest.raises(UserError, match=words):
        gaps.from_dict(env, "g", {"params": params})


def test_variants_are_presets_that_can_be_left_out():
    plain, every = gaps.presets("walker2d", variants=False), gaps.presets("walker2d")
    assert [name for name in every if name not in plain] == ["broken-thigh-range-only", "flexible-thigh-range-only"]
    assert gaps.find("walker2d", "broken-thigh-range-only").params == {"thigh_range": 0.5}
    assert gaps.presets("halfcheetah", variants=False) == gaps.presets("halfcheetah")


@pytest.mark.parametrize("task", envs.TASKS)
def test_all_presets_are_possible(task):
    env = envs.make(task, "c")
    for name in gaps.presets(task):
        assert gaps.load(env, name).name == name


def test_a_drift_of_sensors_is_a_table_of_entries(tmp_path):
    gap = gaps.from_dict(ENV, "g", {"drift": {"xy": [0.001, -0.002]}})
    file = tmp_path / "some.toml"
    file.write_text(gaps.to_toml([gap]))
    assert gaps.read_file(file) == {"g": gap} and gap.table["drift"] == gap.drift
    plain = Gap("plain", {}, {})
    np.testing.assert_allclose(gaps.drifts(ENV, [plain, gap]), [[0.0] * 4, [0.001, -0.002, 0.0, 0.0]])
    assert gaps.drifts(ENV, [plain]) is None and "drift" not in plain.table
    for table, words in (
        ({"x": [0, 0]}, "gap 'g': 'drift' is a rate of 'obs_bias': .* there is no 'x'"),
        ({"xy": [[0, 0], [1, 1]]}, "gap 'g': 'drift' needs numbers, not ranges"),
        (3, "gap 'g': 'drift' must be a table of names and numbers, got 3"),
    ):
        with pytest.raises(UserError, match=words):
            gaps.from_dict(ENV, "g", {"drift": table})


GAPS = sorted((pathlib.Path(envs.__file__).parent / "gaps").rglob("*.toml"))


@pytest.mark.parametrize("path", [path for path in GAPS if path.parent.name != "distributions"], ids=lambda p: p.stem)
def test_every_gap_that_comes_with_the_code_can_be_loaded(path):
    env = envs.make(max((task for task in envs.TASKS if path.stem.startswith(task)), key=len), "c")
    for source in gaps.expand([str(path)]):
        gaps.load(env, source)
