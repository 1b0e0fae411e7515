"""`dualdepth evaluate` from outside: numbers, JSON, what cannot be measured, and one line for every mistake."""

import json
import os
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from dualdepth.cli import main
from dualdepth.data.depth_maps import save_ground_truth
from dualdepth.data.odometry import read_trajectory, write_trajectory
from dualdepth.evaluation.depth import METRICS, evaluate, summary
from dualdepth.evaluation.odometry import ALIGNMENTS, snippet_errors, snippets, trajectory_errors

NAMES = ["t_err", "r_err", "ate", "rpe_t", "rpe_r", "snippet_ate_mean", "snippet_ate_std", "n"]


def arc(count, turn, step):
    """Poses on a circle: `turn` radians and `step` metres a frame."""
    c, s = np.cos(turn), np.sin(turn)
    move = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, step], [0, 0, 0, 1]])
    return np.stack([np.linalg.matrix_power(move, frame) for frame in range(count)])


@pytest.fixture(autouse=True)
def files(tmp_path, monkeypatch):
    """In the working directory P.npy and G.npz with three images of two sizes, pred.txt and gt.txt of 300 frames, about 300 m."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    maps = [np.where(rng.random(s) < 0.3, rng.uniform(1, 90, s), 0).astype(np.float32) for s in ((40, 60), (40, 60), (38, 64))]
    predictions = rng.uniform(0.02, 2, (3, 10, 16)).astype(np.float32)
    np.save("P.npy", predictions)
    save_ground_truth("G.npz", maps)
    prediction = arc(300, 0.0105, 0.3)
    prediction[:, :3, 3] *= 1 + 0.1 * np.sin(np.arange(300))[:, None]
    write_trajectory("pred.txt", prediction)
    write_trajectory("gt.txt", arc(300, 0.01, 1.0))
    return predictions, maps


def depth(*arguments):
    return main(["evaluate", "depth", "--pred", "P.npy", "--gt", "G.npz", *arguments])


def write_numbered(path, poses, frames):
    """A pose file whose lines begin with the frame's number."""
    write_trajectory(path, poses)
    lines = Path(path).read_text().splitlines()
    Path(path).write_text("".join(f"{frame} {line}\n" for frame, line in zip(frames, lines, strict=True)))


def odometry(*arguments, pred="pred.txt", gt="gt.txt"):
    return main(["evaluate", "odometry", "--pred", pred, "--gt", gt, *arguments])


@pytest.fixture
def values_of(capsys):
    """Numbers that a command prints as JSON, and what it says on stderr."""

    def call(command, *arguments, **files):
        assert command("--json", "-", *arguments, **files) == 0
        captured = capsys.readouterr()
        return json.loads(captured.out), captured.err

    return call


@pytest.mark.parametrize(
    "arguments, settings",
    [
        ([], {}),
        (["--kind", "disparity", "--resize", "disparity"], {"kind": "disparity", "resize": "disparity"}),
        (["--kind", "disparity"], {"kind": "disparity", "resize": "depth"}),
        (["--crop", "eigen"], {"crop": "eigen"}),
        (["--crop", "none", "--valid", "positive"], {"crop": "none", "valid": "positive"}),
        (["--min-depth", "5", "--max-depth", "50"], {"min_depth": 5, "max_depth": 50}),
        (["--no-median-scaling"], {"median_scaling": False}),
    ],
)
def test_depth_is_flat_and_every_option_reaches_the_protocol(files, values_of, arguments, settings):
    values, _ = values_of(depth, *arguments)
    assert values == summary(evaluate(*files, **settings))
    assert (values != summary(evaluate(*files))) == bool(settings)
    assert {*METRICS, "n"} <= set(values) and values["n"] == 3 and all(isinstance(v, int | float) for v in values.values())


def test_a_table_is_printed_and_the_json_file_written_beside_it(capsys):
    depth("--json", "out/result.json")
    lines = dict(line.split() for line in capsys.readouterr().out.splitlines())
    written = json.loads(Path("out/result.json").read_text())
    assert float(lines["abs_rel"]) == pytest.approx(written["abs_rel"], abs=1e-4) and lines["n"] == "3"
    assert [p.name for p in Path("out").iterdir()] == ["result.json"]


def test_the_fields_pickled_ground_truth_needs_a_word(files, values_of, refused):
    values = np.empty(3, object)
    values[:] = files[1]
    np.savez_compressed("gt_depths.npz", data=values)
    assert "--allow-pickle" in refused(depth, "--gt", "gt_depths.npz")
    assert values_of(depth, "--gt", "gt_depths.npz", "--allow-pickle")[0] == summary(evaluate(*files))


@pytest.mark.parametrize("listed, first", [(5, 0), (5, 1), (0, 1)])
def test_of_predictions_of_a_list_of_five_frames_those_are_scored_that_have_ground_truth(files, values_of, listed, first):
    predictions, maps = files
    save_ground_truth("G.npz", maps, [f"{first + i:06d}" for i in range(3)], listed)
    assert values_of(depth)[0] == summary(evaluate(*files))
    np.save("P.npy", np.insert(predictions, [0] * first + [3] * (2 - first), 1, axis=0))
    assert values_of(depth)[0] == summary(evaluate(*files))


@pytest.mark.parametrize("kind", ["first", "last", "several sizes"])
def test_predictions_are_taken_in_the_shapes_of_the_fields_scripts(files, values_of, kind):
    predictions, maps = files
    several = np.array([predictions[0][None], predictions[1][..., None], np.ones((7, 9))], object)
    np.save("P.npy", {"first": predictions[:, None], "last": predictions[..., None], "several sizes": several}[kind])
    expected = summary(evaluate([*predictions[:2], predictions[2] if kind != "several sizes" else several[2]], maps))
    assert values_of(depth, *["--allow-pickle"] * (kind == "several sizes"))[0] == expected


FULL = "error: what is printed cannot be written (No"


@pytest.mark.slow
@pytest.mark.parametrize("words, code, said", [("gt.txt | true", 141, ""), ("gt.txt > /dev/full", 1, FULL), ("ü", 2, "error: \\xfc:")])
def test_what_cannot_be_printed_is_no_traceback(words, code, said):
    command = f"{sys.executable} -c 'import sys, dualdepth.cli as cli; input(); cli.main(sys.argv[1:])'"
    script = f"(sleep 1; echo) | {command} evaluate odometry --gt gt.txt --pred {words}; exit ${{PIPESTATUS[1]}}"
    environment = os.environ | {"LC_ALL": "C", "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(["bash", "-c", script], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == code and done.stderr.startswith(said) and done.stderr.count("\n") == bool(said), done.stderr


GOOD = np.ones((3, 10, 16), np.float32)
BAD = {
    "objects": (np.array([{}, {}, {}], object), ""),
    "archive": (GOOD, "archive"),
    "two_channels": (GOOD[:, None].repeat(2, 1), "(3, 2, 10, 16)"),
    "integers": (GOOD.astype(np.uint16), "uint16"),
    "no_pixels": (GOOD[:, :0], "(3, 0, 16)"),
    "short": (GOOD[:2], "holds 2 predictions but there are 3"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_predictions_are_one_line_with_the_file(refused, case):
    content, says = BAD[case]
    with open(f"{case}.npy", "wb") as file:
        (np.savez if case == "archive" else np.save)(file, content)
    message = refused(depth, "--pred", f"{case}.npy", "--json", "out.json")
    assert f"{case}.npy: " in message and says in message and not Path("out.json").exists()
    assert "absent.npy: no such file" in refused(depth, "--pred", "absent.npy")


@pytest.mark.parametrize("length", [3, 5])
@pytest.mark.parametrize("align", ALIGNMENTS)
def test_odometry_is_flat_and_equals_the_library(values_of, length, align):
    values, notes = values_of(odometry, "--snippet", str(length), "--align", align)
    prediction, truth = read_trajectory("pred.txt"), read_trajectory("gt.txt")
    expected = trajectory_errors(truth, prediction, align)
    assert expected.pop("segments") > 0 and notes == ""
    ate = snippet_errors(snippets(truth.poses, length), snippets(prediction.poses, length))["ate"].to_numpy()
    assert list(values) == NAMES
    assert values == expected | {"snippet_ate_mean": ate.mean(), "snippet_ate_std": pytest.approx(np.std(ate)), "n": 301 - length}
    assert ((values, "") == values_of(odometry)) == ((length, align) == (3, "7dof"))  # the defaults


def test_frame_numbers_pair_the_poses_and_no_snippet_crosses_a_gap(values_of):
    frames = np.array([2, 3, 4, 5, 8, 9, 10, 200])
    write_numbered("part.txt", read_trajectory("gt.txt").poses[frames], frames)
    values, _ = values_of(odometry, "--align", "none", pred="part.txt")
    assert values.pop("n") == 3
    assert [v for v in values.values() if v is not None] == pytest.approx([0] * 5, abs=1e-5)  # the truth scores zero
    assert values_of(odometry, "--snippet", "5", pred="part.txt")[0]["n"] == 0


def test_what_cannot_be_measured_is_null_and_said_in_words(values_of, capsys):
    write_trajectory("short.txt", arc(50, 0.01, 1.0))
    values, notes = values_of(odometry, pred="short.txt", gt="short.txt")
    assert values["t_err"] is None and values["r_err"] is None and values["n"] == 48 and values["ate"] < 1e-9
    assert notes == "note: t_err, r_err: none, since no segment of more than 100 m of the true path has both ends predicted\n"
    odometry(pred="short.txt", gt="short.txt")
    assert "t_err             none\n" in capsys.readouterr().out
    frames, truth = np.arange(0, 300, 10), arc(300, 0.01, 1.005)  # 100 frames exceed 100 m, so both ends are there
    write_trajectory("gt.txt", truth)
    write_numbered("sparse.txt", truth[frames], frames)
    values, notes = values_of(odometry, pred="sparse.txt")
    assert [name for name in NAMES if values[name] is None] == ["rpe_t", "rpe_r", "snippet_ate_mean", "snippet_ate_std"]
    assert values["n"] == 0 and "note: rpe_t, rpe_r: " in notes and "note: snippet_ate: " in notes


def test_trajectories_that_do_not_fit_are_named(refused):
    write_trajectory("short.txt", arc(50, 0.01, 1.0))
    assert "short.txt has 50 poses but gt.txt has 300" in refused(odometry, pred="short.txt")
    write_numbered("later.txt", arc(5, 0.01, 1.0), np.arange(300, 305))
    assert "later.txt has frames 300 to 304 and gt.txt 0 to 299" in refused(odometry, pred="later.txt")
    write_numbered("one.txt", arc(2, 0.01, 1.0), np.array([299, 300]))
    assert "one.txt and gt.txt have only frame 299" in refused(odometry, pred="one.txt")


@pytest.mark.parametrize(
    "command, option, value, says",
    [
        (depth, "--crop", "grag", "--crop"),
        (depth, "--max-depth", "deep", "--max-depth"),
        (depth, "--min-depth", "90", "min_depth 90"),
        (depth, "--json", "G.npz/out.json", "G.npz/out.json: "),
        (odometry, "--snippet", "4", "--snippet"),
        (odometry, "--align", "sim3", "--align"),
        (odometry, "--json", "gt.txt/out.json", "gt.txt/out.json: "),
    ],
)
def test_bad_options_are_one_line(refused, command, option, value, says):
    assert says in refused(command, option, value)


def test_scores_need_no_torch():
    script = (
        "import sys, dualdepth.cli as cli\n"
        "cli.main(['evaluate', 'odometry', '--pred', 'pred.txt', '--gt', 'gt.txt'])\n"
        "cli.main(['evaluate', 'depth', '--pred', 'P.npy', '--gt', 'G.npz'])\n"
        "assert 'torch' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stderr == "", done.stderr


@pytest.mark.parametrize(("kept", "said"), [(["checkpoint"], "goes on where it was"), ([], "begins again")])
def test_ctrl_c_is_one_line_that_says_how_to_go_on(monkeypatch, capsys, kept, said):
    monkeypatch.setattr("dualdepth.cli.Run", Mock())
    monkeypatch.setattr("dualdepth.training.variants.train_variant", Mock(side_effect=KeyboardInterrupt))
    monkeypatch.setattr("dualdepth.training.checkpoints.checkpoint_paths", lambda _: kept)
    with pytest.raises(SystemExit, match="130"):
        main(["train"])
    why = "" if kept else "no checkpoint is written yet, so "
    assert capsys.readouterr().err == f"stopped; {why}the same command {said}\n"
