"""`dualdepth evaluate depth` from outside: numbers, JSON, and one line for every mistake."""

import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dualdepth.cli import main
from dualdepth.data.depth_maps import save_ground_truth
from dualdepth.data.odometry import write_trajectory
from dualdepth.evaluation.depth import METRICS, evaluate, summary


@pytest.fixture
def files(tmp_path, monkeypatch):
    """P.npy and G.npz with three images of two sizes in the working directory."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    maps = [np.where(rng.random(s) < 0.3, rng.uniform(1, 90, s), 0).astype(np.float32) for s in ((40, 60), (40, 60), (38, 64))]
    predictions = rng.uniform(0.02, 2, (3, 10, 16)).astype(np.float32)
    np.save("P.npy", predictions)
    save_ground_truth("G.npz", maps)
    return predictions, maps


def run(*arguments):
    return main(["evaluate", "depth", "--pred", "P.npy", "--gt", "G.npz", *arguments])


def test_json_is_flat_and_equals_the_library(files, capsys):
    assert run("--json", "-") == 0
    values = json.loads(capsys.readouterr().out)
    assert values == summary(evaluate(*files))
    assert {*METRICS, "n"} <= set(values) and values["n"] == 3
    assert all(isinstance(v, int | float) for v in values.values())


@pytest.mark.parametrize(
    "arguments, settings",
    [
        (["--kind", "disparity", "--resize", "disparity"], {"kind": "disparity", "resize": "disparity"}),
        (["--kind", "disparity"], {"kind": "disparity", "resize": "depth"}),
        (["--crop", "eigen"], {"crop": "eigen"}),
        (["--crop", "none", "--valid", "positive"], {"crop": "none", "valid": "positive"}),
        (["--min-depth", "5", "--max-depth", "50"], {"min_depth": 5, "max_depth": 50}),
        (["--no-median-scaling"], {"median_scaling": False}),
    ],
)
def test_every_option_reaches_the_protocol(files, capsys, arguments, settings):
    run("--json", "-", *arguments)
    values = json.loads(capsys.readouterr().out)
    assert values == summary(evaluate(*files, **settings))
    assert values != summary(evaluate(*files))


def test_a_table_is_printed_and_the_json_file_written_beside_it(files, capsys):
    run("--json", "out/result.json")
    lines = dict(line.split() for line in capsys.readouterr().out.splitlines())
    written = json.loads(Path("out/result.json").read_text())
    assert float(lines["abs_rel"]) == pytest.approx(written["abs_rel"], abs=1e-4) and lines["n"] == "3"
    assert [p.name for p in Path("out").iterdir()] == ["result.json"]


def test_the_fields_pickled_ground_truth_needs_a_word(files, capsys, refused):
    values = np.empty(3, object)
    values[:] = files[1]
    np.savez_compressed("gt_depths.npz", data=values)
    assert "--allow-pickle" in refused(run, "--gt", "gt_depths.npz")
    run("--gt", "gt_depths.npz", "--allow-pickle", "--json", "-")
    assert json.loads(capsys.readouterr().out) == summary(evaluate(*files))


def bad_predictions():
    good = np.ones((3, 10, 16), np.float32)
    buffer, archive = io.BytesIO(), io.BytesIO()
    np.save(buffer, good)
    np.savez(archive, good)
    return {
        "absent": (None, "no such file"),
        "text": (b"not an array", "not a readable .npy file"),
        "truncated": (buffer.getvalue()[:-100], "truncated"),
        "objects": (np.array([{}, {}, {}], object), "not a readable .npy file"),
        "archive": (archive.getvalue(), "an archive"),
        "four_dimensions": (good[:, None], "shape (3, 1, 10, 16)"),
        "integers": (good.astype(np.uint16), "uint16"),
        "no_pixels": (good[:, :0], "shape (3, 0, 16)"),
        "short": (good[:2], "holds 2 predictions but G.npz holds 3 ground truths"),
    }


@pytest.mark.parametrize("case", list(bad_predictions()))
def test_bad_predictions_are_one_line_with_the_file(files, refused, case):
    content, says = bad_predictions()[case]
    path = Path(f"{case}.npy")
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        np.save(path, content)
    message = refused(run, "--pred", str(path), "--json", "out.json")
    assert path.name in message and says in message
    assert not Path("out.json").exists()


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["--crop", "grag"], "--crop"),
        (["--max-depth", "deep"], "--max-depth"),
        (["--min-depth", "90"], "min_depth 90"),
        (["--json", "G.npz/out.json"], "cannot write"),
    ],
)
def test_bad_options_are_one_line(files, refused, arguments, says):
    assert says in refused(run, *arguments)


def test_scores_need_no_torch(files):
    poses = np.tile(np.eye(4), (300, 1, 1))
    poses[:, 2, 3] = np.arange(300)
    write_trajectory("poses.txt", poses)
    script = (
        "import sys, dualdepth.cli as cli\n"
        "cli.main(['evaluate', 'odometry', '--pred', 'poses.txt', '--gt', 'poses.txt'])\n"
        "cli.main(['evaluate', 'depth', '--pred', 'P.npy', '--gt', 'G.npz'])\n"
        "assert 'torch' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stderr == "", done.stderr


def test_ctrl_c_is_one_line_that_says_how_to_go_on(monkeypatch, capsys):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("dualdepth.commands.reproduce._train", interrupted)
    assert main(["train"]) == 130
    assert capsys.readouterr().err == "stopped; the same command goes on where it was\n"
