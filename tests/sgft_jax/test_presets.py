"""Which preset of rebrac a data set gets by its name, and that no other method looks at names."""

import pytest

from sgft_jax.methods import FIXED_NAMES, get_method
from sgft_jax.presets import preset_for, say_preset

REBRAC = get_method("rebrac", "fixed")


@pytest.mark.parametrize(
    ("data", "preset"),
    [
        ("halfcheetah-medium-replay", "halfcheetah-medium-replay"),
        ("halfcheetah-medium-replay-regenerated-seed-0", "halfcheetah-medium-replay"),
        ("halfcheetah-medium-regenerated-seed-0", "halfcheetah-medium"),
        ("halfcheetah_medium_replay-v2", "halfcheetah-medium-replay"),
        ("walker2d_medium-v2", "walker2d-medium"),
        ("Walker2d-Medium-v2", "walker2d-medium"),
        ("d4rl.walker2d-medium-replay-v2", "walker2d-medium-replay"),
        ("walker2d-medium-expert-v2", ""),  # D4RL has that set too, with other penalties
        ("halfcheetah-medium2", ""),
        ("myhalfcheetah-medium", ""),
        ("halfcheetah-gravity-medium-regenerated-seed-0", ""),  # of another real system
        ("medium", ""),
        ("halfcheetah-full-replay", ""),
    ],
)
def test_the_preset_whose_data_set_the_name_contains(data, preset):
    assert preset_for(REBRAC, data) == preset


def test_methods_whose_presets_are_no_data_sets_ignore_names():
    assert [name for name in FIXED_NAMES if get_method(name, "fixed").by_data] == ["rebrac"]
    assert preset_for(get_method("h2oplus", "fixed"), "sql-released") == ""


def test_what_is_used_is_said():
    assert say_preset(REBRAC, "walker2d-medium", "walker2d_medium-v2") == "preset walker2d-medium"
    assert say_preset(REBRAC, "", "mine") == "preset halfcheetah-medium-replay, as none is called after mine"
