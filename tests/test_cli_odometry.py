"""`dualdepth evaluate odometry` from outside: numbers, JSON, what cannot be measured, and one line for every mistake."""

import json
from pathlib import Path

import numpy as np
import pytest

from dualdepth.cli import main
from dualdepth.data.odometry import read_trajectory, write_trajectory
from dualdepth.evaluation.odometry import ALIGNMENTS, snippet_errors, snippets, trajectory_errors

NAMES = ["t_err", "r_err", "ate", "rpe_t", "rpe_r", "snippet_ate_mean", "snippet_ate_std", "n"]


def arc(count, turn, step):
    """Poses on a circle: `turn` radians and `step` metres a frame."""
    c, s = np.cos(turn), np.sin(turn)
    move = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, step], [0, 0, 0, 1]])
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ move)
    return np.stack(poses)


@pytest.fixture
def files(tmp_path, monkeypatch):
    """pred.txt and gt.txt of 300 frames, about 300 m, in the working directory."""
    monkeypatch.chdir(tmp_path)
    wobble = 1 + 0.1 * np.sin(np.arange(300))[:, None]
    prediction = arc(300, 0.0105, 0.3)
    prediction[:, :3, 3] *= wobble
    write_trajectory("pred.txt", prediction)
    write_trajectory("gt.txt", arc(300, 0.01, 1.0))


def run(*arguments, pred="pred.txt", gt="gt.txt"):
    return main(["evaluate", "odometry", "--pred", pred, "--gt", gt, *arguments])


def values_of(capsys, *arguments, **files):
    assert run("--json", "-", *arguments, **files) == 0
    captured = capsys.readouterr()
    return json.loads(captured.out), captured.err


@pytest.mark.parametrize("length", [3, 5])
@pytest.mark.parametrize("align", ALIGNMENTS)
def test_json_is_flat_and_equals_the_library(files, capsys, length, align):
    values, notes = values_of(capsys, "--snippet", str(length), "--align", align)
    prediction, truth = read_trajectory("pred.txt"), read_trajectory("gt.txt")
    expected = trajectory_errors(truth, prediction, align)
    assert expected.pop("segments") > 0 and notes == ""
    ate = snippet_errors(snippets(truth.poses, length), snippets(prediction.poses, length))["ate"].to_numpy()
    assert list(values) == NAMES
    assert values == expected | {"snippet_ate_mean": ate.mean(), "snippet_ate_std": pytest.approx(np.std(ate)), "n": 301 - length}


def test_defaults_are_the_first_choices(files, capsys):
    assert values_of(capsys) == values_of(capsys, "--snippet", "3", "--align", "7dof")
    assert values_of(capsys) != values_of(capsys, "--snippet", "5") and values_of(capsys) != values_of(capsys, "--align", "6dof")


def write_numbered(path, poses, frames):
    """A pose file whose lines begin with the frame's number."""
    write_trajectory(path, poses)
    lines = Path(path).read_text().splitlines()
    Path(path).write_text("".join(f"{frame} {line}\n" for frame, line in zip(frames, lines, strict=True)))


def test_frame_numbers_pair_the_poses_and_no_snippet_crosses_a_gap(files, capsys):
    frames = np.array([2, 3, 4, 5, 8, 9, 10, 200])
    write_numbered("part.txt", read_trajectory("gt.txt").poses[frames], frames)
    values, _ = values_of(capsys, "--align", "none", pred="part.txt")
    assert values.pop("n") == 3
    assert [v for v in values.values() if v is not None] == pytest.approx([0] * 5, abs=1e-5)  # the truth scores zero
    assert values_of(capsys, "--snippet", "5", pred="part.txt")[0]["n"] == 0


def test_what_cannot_be_measured_is_null_and_said_in_words(files, capsys):
    write_trajectory("short.txt", arc(50, 0.01, 1.0))
    values, notes = values_of(capsys, pred="short.txt", gt="short.txt")
    assert values["t_err"] is None and values["r_err"] is None and values["n"] == 48 and values["ate"] < 1e-9
    assert notes == "note: t_err, r_err: none, since no segment of more than 100 m of the true path has both ends predicted\n"
    run(pred="short.txt", gt="short.txt")
    assert "t_err             none\n" in capsys.readouterr().out


def test_frames_without_neighbours_have_no_steps_and_no_snippets(files, capsys):
    frames, truth = np.arange(0, 300, 10), arc(300, 0.01, 1.005)  # 100 frames exceed 100 m, so both ends are there
    write_trajectory("gt.txt", truth)
    write_numbered("sparse.txt", truth[frames], frames)
    values, notes = values_of(capsys, pred="sparse.txt")
    assert [name for name in NAMES if values[name] is None] == ["rpe_t", "rpe_r", "snippet_ate_mean", "snippet_ate_std"]
    assert values["n"] == 0
    assert "note: rpe_t, rpe_r: none, since no two frames have consecutive numbers\n" in notes
    assert "note: snippet_ate: none, since no 3 frames have consecutive numbers\n" in notes


def test_files_that_do_not_fit_are_named(files, refused):
    write_trajectory("short.txt", arc(50, 0.01, 1.0))
    assert "short.txt has 50 poses but gt.txt has 300" in refused(run, pred="short.txt")
    write_numbered("later.txt", arc(5, 0.01, 1.0), range(300, 305))
    assert "later.txt has frames 300 to 304 and gt.txt 0 to 299: none in common" in refused(run, pred="later.txt")
    write_numbered("one.txt", arc(2, 0.01, 1.0), [299, 300])
    assert "one.txt and gt.txt have only frame 299 in common" in refused(run, pred="one.txt")


@pytest.mark.parametrize(
    "arguments, says",
    [(["--snippet", "4"], "--snippet"), (["--align", "sim3"], "--align"), (["--json", "gt.txt/out.json"], "cannot write")],
)
def test_bad_options_are_one_line(files, refused, arguments, says):
    assert says in refused(run, *arguments)
