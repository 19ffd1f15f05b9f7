"""The order of files: by the times that they state, else by their names; what differs is said."""

from datetime import datetime, timedelta, timezone

import pytest

from emmc_rig.drivers.capture_order import capture_order

NOON = datetime(2026, 11, 27, 12)
ROLL = ["IMG_0001.dng", "IMG_0002.dng", "IMG_9998.dng", "IMG_9999.dng"]
IN_TIME = ["IMG_9998.dng", "IMG_9999.dng", "IMG_0001.dng", "IMG_0002.dng"]


def ordered(names, seconds, start=NOON):
    """Return names in the order found, and the notes; seconds: after the start, None not stated."""
    times = [None if second is None else start + timedelta(seconds=second) for second in seconds]
    order = capture_order(names, times)
    return [names[place] for place in order.places], order.notes


def test_a_counter_that_began_again_is_followed_by_the_times_stated_and_said():
    names, (note,) = ordered(ROLL, [4, 6, 0, 2])
    assert names == IN_TIME
    assert note.startswith("IMG_0001.dng follows IMG_9999.dng")
    assert "ordered by time, not by name" in note


@pytest.mark.parametrize("seconds", [[0, 0, 0, 0], [None] * 4])
def test_without_times_that_differ_a_counter_that_began_again_is_followed(seconds):
    names, (note,) = ordered(ROLL, seconds)
    assert names == IN_TIME
    assert "began again" in note


def test_names_that_disagree_with_times_lose_and_are_named():
    names, (note,) = ordered(["a.dng", "b.dng", "c.dng"], [20, 0, 10])
    assert names == ["b.dng", "c.dng", "a.dng"]
    assert note.startswith("b.dng states a time before a.dng")


def test_equal_times_keep_the_order_of_names_with_numbers_as_numbers():
    assert ordered(["s10.dng", "s9.dng", "s2.dng"], [1, 0, 0]) == (
        ["s2.dng", "s9.dng", "s10.dng"],
        (),
    )


def test_where_a_file_states_no_time_names_decide_and_what_disagrees_is_named():
    names, (note,) = ordered(["a.dng", "b.dng", "c.dng"], [20, None, 10])
    assert names == ["a.dng", "b.dng", "c.dng"]
    assert "c.dng states a time before a.dng" in note
    assert "b.dng states none: ordered by name" in note
    assert ordered(["a.dng", "b.dng", "c.dng"], [10, None, 20])[1] == ()


def test_times_with_their_zones_need_no_guess_at_the_end_of_summer_time():
    summer, winter = (timezone(timedelta(hours=hours)) for hours in (2, 1))
    times = [
        datetime(2026, 10, 25, 2, 59, tzinfo=summer),
        datetime(2026, 10, 25, 2, 1, tzinfo=winter),
    ]
    order = capture_order(["b.dng", "a.dng"], times)
    assert order.places == (0, 1)
    assert capture_order(["a.dng", "b.dng"], times).notes == ()


def test_a_whole_roll_without_a_gap_begins_at_its_first_number():
    names = [f"IMG_{n:04}.dng" for n in range(1, 10_000, 2)]
    assert ordered(names, [None] * len(names)) == (names, ())
    assert ordered([], []) == ([], ())
    assert ordered(["only.dng"], [0]) == (["only.dng"], ())
