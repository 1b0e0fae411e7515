"""A film is cut where it stands still, jumps or misses frames, gets a stride that fits, and is refused if nothing can be learned of it."""

import numpy as np
import pytest
from own_film import frame, turning, write_frames
from small_kitti import wall

from data_scripts.own.checks import Drive, Motion, Neighbours, checks, cut_at_breaks, examine, hold_out, motion, small_copy
from dualdepth.data.frames import Footage

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


def test_flow_is_the_share_of_the_width_that_the_picture_moves():
    wide = wall(300, 600)
    moved = measure(wide[:, 20:532], wide[:, 26:538])
    assert moved.same_place and not moved.static
    assert moved.flow == pytest.approx(6 / 512, rel=0.1)


def test_the_same_frame_again_is_static_even_with_noise():
    noise = np.random.default_rng(0).normal(0, 3, (2, *frame(0).shape))
    assert measure(*(np.clip(frame(0) + n, 0, 255).astype(np.uint8) for n in noise)).static


def test_a_turn_alone_is_told_from_travelling():
    assert measure(turning(0.0), turning(0.015)).travels < 0.1
    assert measure(frame(3), frame(4)).travels > 0.3


def test_a_film_that_moves_is_one_drive_with_stride_one(film_of):
    film = film_of([frame(k) for k in range(32)])
    assert failed(film) == [] and film.stride == 1
    assert film.drives == [Drive(0, tuple(range(32)))]
    assert film.counts == {"read": 32, "used": 32, "standing": 0, "gaps": 0, "cuts": 0, "short": 0}


def test_standing_is_cut_out_and_counted(film_of):
    film = film_of([frame(min(k, 15) + max(0, k - 25)) for k in range(50)])
    assert [(d.numbers[0], d.numbers[-1]) for d in film.drives] == [(0, 15), (25, 49)]
    assert film.counts["standing"] == 9 and failed(film) == []


def test_a_scene_cut_splits_and_no_triplet_spans_it(film_of):
    film = film_of([frame(k, seed=2 * (k >= 20)) for k in range(40)])
    assert [(d.numbers[0], d.numbers[-1]) for d in film.drives] == [(0, 19), (20, 39)]
    assert film.counts["cuts"] == 1 and failed(film) == []


def test_missing_numbers_split(film_of):
    names = [f"{k:06d}" for k in range(40) if k not in (17, 18)]
    film = film_of([frame(int(n)) for n in names], names)
    assert [(d.numbers[0], d.numbers[-1]) for d in film.drives] == [(0, 16), (19, 39)]
    assert film.counts["gaps"] == 1


def test_a_film_of_too_many_frames_a_second_gets_a_stride_that_makes_up_for_it(film_of):
    film = film_of([frame(k, speed=0.34) for k in range(130)])
    assert film.stride in (3, 4) and 0.006 < film.medians["flow"] < 0.02 and failed(film) == []
    assert film.drives[0].numbers[:3] == (0, film.stride, 2 * film.stride)


@pytest.mark.parametrize(
    ("frames", "stride", "check", "mend"),
    [
        (lambda k: frame(5), None, "moves", "film while driving"),
        (lambda k: frame(40 * (k % 2), seed=k % 3), None, "consecutive", "take every frame of the video"),
        (lambda k: turning(0.012 * k), None, "travels", "do not pan"),
        (lambda k: frame(k, speed=0.2), 1, "speed", "leave --stride out"),
    ],
    ids=["standing", "jumping", "turning", "slow"],
)
def test_what_nothing_can_be_learned_of_is_refused_with_what_to_do(film_of, frames, stride, check, mend):
    film = film_of([frames(k) for k in range(32)], stride=stride)
    assert mend in film.checks[check]


def test_a_film_too_fast_is_refused():
    pairs = [Neighbours(0, k, k + 1, Motion(0.04, 0.9, 0.9)) for k in range(40)]
    found = checks(pairs, *cut_at_breaks(pairs), {"flow": 0.04, "agrees": 0.9, "travels": 0.9}, stride=2)
    assert [name for name in found if found[name]] == ["speed"] and "lower --stride 2" in found["speed"]


def test_a_film_too_short_is_refused(film_of):
    assert "frames" in failed(film_of([frame(k) for k in range(10)]))


def test_pieces_of_fewer_than_three_frames_are_left_out_and_counted(film_of):
    film = film_of([frame(k, seed=2 * (k in (20, 21))) for k in range(40)])
    assert len(film.drives) == 2 and film.counts["short"] == 2


def test_the_held_out_frames_are_the_last_and_no_neighbours_of_the_trained_ones():
    train, shown = hold_out([Drive(0, tuple(range(50))), Drive(1, tuple(range(100)))])
    assert shown == Drive(1, tuple(range(85, 100)))
    assert train == [Drive(0, tuple(range(50))), Drive(1, tuple(range(82)))]
    train, shown = hold_out([Drive(0, tuple(range(50))), Drive(0, tuple(range(60, 70)))], count=8)
    assert shown.numbers == tuple(range(42, 50)), "a last drive that is too short is trained on"


def test_nothing_at_all_has_no_drives():
    assert cut_at_breaks([])[0] == []


def test_real_kitti_passes_every_check_and_every_eighth_frame_of_it_does_not(real):
    footage = Footage(real("kitti_odometry/sequences/06/image_0"))
    film = examine([footage], 0.577)
    assert failed(film) == [] and film.stride == 1 and film.counts["used"] == footage.length
    assert "consecutive" in failed(examine([footage], 0.577, stride=8))
