"""A film is cut where it stands still, jumps or misses frames, gets a stride that fits, and is refused if nothing can be learned of it."""

import numpy as np
import pandas as pd
import pytest
from own_film import frame, turning, write_frames
from small_kitti import wall

from data_scripts.own.checks import Drive, checks, cut_at_breaks, examine, hold_out, motion, small_copy
from data_scripts.own.footage import Footage

FOCAL = 0.8


@pytest.fixture
def film_of(tmp_path):
    """Examines a film of these frames, named by their numbers."""

    def examined(frames, names=None, stride=None):
        return examine([Footage(write_frames(tmp_path / "film", frames, names))], FOCAL, stride)

    return examined


def failed(film):
    return [name for name, said in film.checks.items() if said]


def measure(before, after):
    return motion(small_copy(before), small_copy(after), FOCAL)


def test_flow_is_the_share_of_the_width_and_a_turn_is_told_from_travelling():
    wide = wall(300, 600)
    moved = measure(wide[:, 20:532], wide[:, 26:538])
    assert moved.link == "moves" and moved.flow == pytest.approx(6 / 512, rel=0.1)
    assert measure(turning(0.0), turning(0.015)).travels < 0.1 and measure(frame(3), frame(4)).travels > 0.3
    noise = np.random.default_rng(0).normal(0, 3, (2, *frame(0).shape))
    assert measure(*(np.clip(frame(0) + n, 0, 255).astype(np.uint8) for n in noise)).link == "still"


def test_a_film_that_moves_is_one_drive_with_stride_one(film_of):
    film = film_of([frame(k) for k in range(32)])
    assert failed(film) == [] and film.stride == 1 and film.drives == [Drive(0, tuple(range(32)))]
    assert film.counts == {"read": 32, "used": 32, "standing": 0, "short": 0, "moving": 31, "still": 0, "cuts": 0, "gaps": 0}


MISSING = [k for k in range(40) if k not in (17, 18)]


@pytest.mark.parametrize(
    ("places", "names", "expected", "counts"),
    [
        ([{"place": min(k, 15) + max(0, k - 25)} for k in range(50)], None, [(0, 15), (25, 49)], {"standing": 9}),
        ([{"place": k, "seed": 2 * (k >= 20)} for k in range(40)], None, [(0, 19), (20, 39)], {"cuts": 1}),
        ([{"place": k} for k in MISSING], [f"{k:06d}" for k in MISSING], [(0, 16), (19, 39)], {"gaps": 1}),
        ([{"place": k, "seed": 2 * (k in (20, 21))} for k in range(40)], None, [(0, 19), (22, 39)], {"short": 2}),
    ],
    ids=["standing", "a cut of the scene", "missing numbers", "pieces of fewer than three frames"],
)
def test_a_film_is_cut_at_its_breaks_and_what_is_left_out_is_counted(film_of, places, names, expected, counts):
    film = film_of([frame(**place) for place in places], names)
    spans = [(drive.numbers[0], drive.numbers[-1]) for drive in film.drives]
    assert spans == expected and failed(film) == [] and counts.items() <= film.counts.items()


def test_a_film_of_too_many_frames_a_second_gets_a_stride_that_makes_up_for_it(film_of):
    film = film_of([frame(k, speed=0.34) for k in range(130)])
    assert film.stride in (3, 4) and 0.006 < film.medians["flow"] < 0.02 and failed(film) == []
    assert film.drives[0].numbers[:3] == (0, film.stride, 2 * film.stride)


@pytest.mark.parametrize(
    ("frames", "count", "stride", "check", "mend"),
    [
        (lambda k: frame(5), 32, None, "moves", "film while driving"),
        (lambda k: frame(40 * (k % 2), seed=k % 3), 32, None, "consecutive", "take every frame of the video"),
        (lambda k: turning(0.012 * k), 32, None, "travels", "do not pan"),
        (lambda k: frame(k, speed=0.2), 32, 1, "speed", "leave --stride out"),
        (lambda k: frame(k, speed=0.2), 40, None, "frames", "needed: film longer"),  # a stride that nobody gave is not to be lowered
        (frame, 10, None, "frames", "film longer"),
    ],
    ids=["standing", "jumping", "turning", "slow", "slow, no stride given", "short"],
)
def test_what_nothing_can_be_learned_of_is_refused_with_what_to_do(film_of, frames, count, stride, check, mend):
    assert mend in film_of([frames(k) for k in range(count)], stride=stride).checks[check]


def test_a_film_too_fast_is_refused_and_nothing_at_all_has_no_drives():
    table = pd.DataFrame({"footage": 0, "number": range(40), "link": ["first"] + 39 * ["moves"]})
    found = checks(cut_at_breaks(table)[1], {"flow": 0.04, "agrees": 0.9, "travels": 0.9}, stride=2, given=True)
    assert [name for name in found if found[name]] == ["speed"] and "lower --stride 2" in found["speed"]
    assert cut_at_breaks(table[:0])[0] == []


def test_the_held_out_frames_are_the_last_and_no_neighbours_of_the_trained_ones():
    train, shown = hold_out([Drive(0, tuple(range(50))), Drive(1, tuple(range(100)))])
    assert shown == Drive(1, tuple(range(85, 100)))
    assert train == [Drive(0, tuple(range(50))), Drive(1, tuple(range(82)))]
    train, shown = hold_out([Drive(0, tuple(range(50))), Drive(0, tuple(range(60, 70)))], count=8)
    assert shown.numbers == tuple(range(42, 50)), "a last drive that is too short is trained on"
