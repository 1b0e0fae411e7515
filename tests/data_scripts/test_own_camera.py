"""From a film to a data set that the chain trains on: whole or not there, kept while its inputs are, and refused with what to do."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from own_film import SIZE, chessboards, frame, write_frames, write_video

from data_scripts import own_camera, prepare_data
from data_scripts.own import dataset
from dualdepth.data.kitti import intrinsics, read_frame_list, read_image
from dualdepth.data.triplets import load_triplets
from dualdepth.errors import InputError
from dualdepth.run import Run
from dualdepth.tables.scores import Scored

GIVEN = {"intrinsics": "205,205,127.5,107.5"}
TRAIN, SHOWN = dataset.drive_name(1), dataset.drive_name(2)


@pytest.fixture
def folder(tmp_path):
    """A film of 40 frames."""
    return write_frames(tmp_path / "film", [frame(k) for k in range(40)])


def images(root, drive):
    return sorted((root / drive / "image_02/data").iterdir())


def test_a_folder_becomes_a_data_set_whose_frames_are_the_very_files(folder, tmp_path):
    made = own_camera.make([folder], tmp_path / "out", **GIVEN)
    files = images(made.root, TRAIN)
    assert [f.name for f in files] == [f"{k:010d}.png" for k in range(33)]  # 4 are held out, 3 lie between
    assert files[7].read_bytes() == (folder / "000007.png").read_bytes()
    assert images(made.root, SHOWN)[0].read_bytes() == (folder / "000036.png").read_bytes()
    assert np.allclose(intrinsics(made.root, dataset.DATE), [[205, 0, 127.5], [0, 205, 107.5], [0, 0, 1]])
    assert [f.index for f in read_frame_list(made.root / "lists/test_files.txt")] == [0, 1, 2, 3]
    record = json.loads((made.root / "own.json").read_text())
    assert record["triplets"] == 31 and record["camera"]["origin"] == "given as numbers" and set(record["checks"].values()) == {"passed"}
    assert "FAILED" not in own_camera.summary(made) and f"PROFILE={made.profile} KITTI_ROOT={made.root}" in own_camera.summary(made)


def test_the_chain_reads_it_as_it_reads_kitti_but_has_no_truth(folder, tmp_path, checkout):
    (tmp_path / "own.yaml").write_text("about: a test\ndata: {source: own, hr_size: [192, 192]}\n")  # of the film's size
    run, made = Run(str(tmp_path / "own.yaml"), checkout), own_camera.make([folder], tmp_path / "out", **GIVEN)
    sources = prepare_data.find_data(run, str(made.root))
    assert prepare_data.prepare(run) == (31, 4, 4, 0, 0)
    assert all(path.is_file() for t in load_triplets(run.prepared / "triplets.csv", sources.kitti_root) for path in t.paths)
    assert {frame_.drive for frame_ in Scored(run).frames} == {SHOWN}
    assert [depth.shape for depth in Scored(run).truth] == [SIZE] * 4 and not any(depth.any() for depth in Scored(run).truth)
    (tmp_path / "flat.yaml").write_text("about: a test\ndata: {source: own}\n")
    with pytest.raises(InputError, match=rf"384x1248 squeezes frames of 256×216; give PROFILE={made.root}/own\.yaml"):
        prepare_data.find_data(Run(str(tmp_path / "flat.yaml"), run.root), str(made.root))
    for root in ("", str(folder)):
        with pytest.raises(InputError, match=rf"KITTI_ROOT '{root}' is no data set .*own_camera\.py VIDEO --out DIR makes one"):
            prepare_data.find_data(run, root)


@pytest.mark.parametrize("words", ["'205 205 127 107'", "205 205 127 107", "205, 205, 127, 107", "410 410 254.5 214.5 512 432"])
def test_intrinsics_are_numbers_with_commas_or_blanks_and_an_input_may_be_called_as_a_number(folder, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    Path("1").symlink_to(folder)
    own_camera.main(["--out", "out", "--intrinsics", *shlex.split(words), "1"])
    assert np.allclose(intrinsics(tmp_path / "out", dataset.DATE), [[205, 0, 127], [0, 205, 107], [0, 0, 1]])


def test_help_ends_with_an_example(capsys):
    with pytest.raises(SystemExit, match="0"):
        own_camera.main(["--help"])
    assert "examples:\n  python data_scripts/own_camera.py drive.mp4 --out" in capsys.readouterr().out


def test_a_video_becomes_jpeg_frames_with_an_estimate_that_is_said_to_be_one(tmp_path, capsys):
    video = write_video(tmp_path / "film.mp4", [frame(k) for k in range(40)])
    own_camera.main([str(video), "--out", str(tmp_path / "out"), "--fov", "64", "--held-out", "6"])
    said = capsys.readouterr().out
    assert "ESTIMATED from a horizontal field of view of 64 degrees" in said and "6 frames held out" in said
    files = images(tmp_path / "out", TRAIN)
    assert len(files) == 31 and files[0].suffix == ".jpg"
    assert np.abs(read_image(files[5]).astype(float) - frame(5)).mean() < 8


def test_a_chessboard_straightens_the_frames_and_says_so(tmp_path, folder):
    matrix = np.array([[205.0, 0, 127.5], [0, 205, 107.5], [0, 0, 1]])
    board = write_frames(tmp_path / "board", chessboards(matrix, (-0.25, 0.05, 0, 0, 0), SIZE, corners=(7, 5)))
    made = own_camera.make([folder], tmp_path / "out", chessboard=board, squares="7x5")
    camera = made.record["camera"]
    assert camera["fx"] == pytest.approx(205, abs=4) and camera["distortion"][0] == pytest.approx(-0.25, abs=0.06)
    assert "frames undistorted" in made.record["undistorted_to"]["origin"]
    straight = read_image(images(made.root, TRAIN)[4]).astype(float)
    assert np.abs(straight - frame(4)).mean() > 3, "the frames are written as they were filmed"
    assert intrinsics(made.root, dataset.DATE)[0, 0] == pytest.approx(made.record["undistorted_to"]["fx"], abs=1e-3)
    assert own_camera.make([folder], tmp_path / "out", chessboard=board.rename(tmp_path / "moved"), squares="7x5").kept


def test_the_same_again_is_kept_and_what_is_something_else_is_left_alone(folder, tmp_path):
    first = own_camera.make([folder], tmp_path / "out", **GIVEN)
    (first.root / "own.yaml").write_text("about: mine\n")
    again = own_camera.make([folder], tmp_path / "out", **GIVEN)
    assert again.kept and (first.root / "own.yaml").read_text() == "about: mine\n"
    with pytest.raises(InputError, match="holds a data set made of other footage or options; remove it"):
        own_camera.make([folder], tmp_path / "out", fov=64)
    with pytest.raises(InputError, match="holds something else"):
        own_camera.make([folder], folder, **GIVEN)
    assert len(list(folder.iterdir())) == 40


def test_nothing_is_left_of_a_run_that_fails_or_was_killed(folder, tmp_path, monkeypatch):
    (tmp_path / ".out.part/2000_01_01").mkdir(parents=True)
    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr(dataset, "write_texts", lambda *_: 1 / 0)
        own_camera.make([folder], tmp_path / "out", **GIVEN)
    assert {path.name for path in tmp_path.iterdir()} == {"film", ".out.lock"}


def test_a_failed_check_is_one_line_and_anyway_makes_it_all_the_same(tmp_path, capsys, refused):
    film = write_frames(tmp_path / "film", [frame(k, speed=0.2) for k in range(34)])
    call = [str(film), "--out", str(tmp_path / "out"), "--fov", "64", "--stride", "1"]
    said = refused(own_camera.main, call)
    assert "speed: the picture moves by" in said and "--anyway" in said
    assert not (tmp_path / "out").exists()
    own_camera.main([*call, "--anyway"])
    assert "warning: speed: FAILED" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, "give one of --intrinsics .* --chessboard .* or --fov"),
        ({"fov": 64, "intrinsics": "205,205,127,107"}, "give one of"),
        ({"fov": 64, "squares": "9x6"}, "give one of"),
        ({"intrinsics": "no.txt"}, r"no\.txt: no such file"),
        ({"fov": 64, "stride": 0}, "--stride 0"),
        *(({"fov": degrees}, f"--fov {degrees}: give .* degrees, 20 to 150") for degrees in (0, 0.5, 151, float("nan"))),
        ({"fov": 0, **GIVEN}, "give one of"),
        ({"chessboard": "film/000000.png", "squares": "9x6"}, "film/000000.png: this is one photo; give a film"),
        ({"chessboard": "film", "squares": "nine"}, "--squares 'nine'"),
        ({"fov": 64, "name": "a/b"}, "--name 'a/b'"),
    ],
)
def test_options_that_do_not_fit_are_refused_with_what_to_do(folder, tmp_path, monkeypatch, options, said):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=said):
        own_camera.make([folder], "out", **options)
    assert not (tmp_path / "out").exists()


def test_of_too_many_held_out_frames_half_of_the_film_is_and_films_of_two_sizes_are_refused(folder, tmp_path):
    assert own_camera.make([folder], tmp_path / "out", fov=64, held_out=400, stride=1).record["drives"][-1]["frames"] == 18
    other = write_frames(tmp_path / "other", [frame(k, size=(432, 512)) for k in range(3)])
    with pytest.raises(InputError, match=r"other: has 512×432 pixels, .*film 256×216"):
        own_camera.make([folder, other], tmp_path / "both", **GIVEN)


def test_sequence_06_of_real_kitti_becomes_a_data_set_and_every_eighth_frame_of_it_does_not(real, tmp_path):
    sequence = real("kitti_odometry/sequences/06")
    made = own_camera.make([sequence / "image_0"], tmp_path / "out", intrinsics=str(sequence / "calib_p0_p1.txt"))
    there = len(list((sequence / "image_0").iterdir()))
    assert made.record["frames"]["used"] == there and made.record["triplets"] == there - made.record["drives"][-1]["frames"] - 3 - 2
    assert images(made.root, TRAIN)[3].read_bytes() == (sequence / "image_0/000003.png").read_bytes()
    assert intrinsics(made.root, dataset.DATE)[0, 0] == pytest.approx(707.0912) and made.record["hr_size"] == [384, 1248]
    with pytest.raises(InputError, match="consecutive: "):
        own_camera.make([sequence / "image_0"], tmp_path / "eighths", intrinsics=str(sequence / "calib_p0_p1.txt"), stride=8)
