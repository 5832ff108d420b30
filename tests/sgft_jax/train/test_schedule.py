"""Schedules by name and in words."""

from dataclasses import replace

from sgft_jax.train.schedule import FLEET, SCHEDULES, Schedule, describe, name_of


def test_schedules_have_the_rhythm_that_their_names_say():
    fleet, released = SCHEDULES[FLEET], SCHEDULES["released"]
    assert list(SCHEDULES) == ["fleet", "released"] and fleet == Schedule()
    assert (fleet.simulators, fleet.steps_per_round, fleet.updates_per_round) == (25, 1, 25)
    assert (released.simulators, released.steps_per_round, released.updates_per_round) == (1, 1000, 1000)


def test_a_schedule_keeps_its_name_with_other_numbers_of_updates():
    for name, own in SCHEDULES.items():
        assert name_of(own) == name == name_of(replace(own, updates=200_000, buffer=50_000, chunk_updates=1_000))
        for other in ({"simulators": 7}, {"steps_per_round": 9}, {"updates_per_step": 0.5}):
            assert name_of(replace(own, **other)) == "custom"


def test_words_name_schedule_and_updates():
    released = replace(SCHEDULES["released"], updates=200_000)
    assert describe(released) == (
        "200,000 updates, schedule released (simulators: 1; steps of each per round: 1,000; updates per round: 1,000)"
    )
    uneven = Schedule(updates=21, simulators=4, chunk_updates=4)  # the last chunk is whole
    assert describe(uneven).startswith("24 updates, schedule custom (simulators: 4; ")


def test_a_chunk_is_no_longer_than_the_run():
    assert Schedule(updates=2_000).updates_in_all == 2_000  # of 5,000 to a chunk
    assert Schedule(updates=7_000).updates_in_all == 10_000
