"""`dualdepth predict`: from a folder of whatever people have to results that say what they are."""

import io
import json
import os
import shutil
from functools import partial
from unittest.mock import Mock

import cv2
import numpy as np
import PIL.Image
import pytest
import torch
from own_film import write_video
from small_kitti import wall
from small_nets import output_of
from torch import nn

from dualdepth.cli import main
from dualdepth.data.frames import Video
from dualdepth.model import DepthModel

ABOUT = "a net, trained on 7 triplets: a synthetic street world"


class Brightness(nn.Module):
    """Stands for HR-Net, whose results cannot be foreseen: the brighter, the nearer."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(1))

    def forward(self, image, scales=4):
        return output_of([self.weight * 10 * image.mean(1, keepdim=True) + 0.01], image)


@pytest.fixture(autouse=True)
def weights(tmp_path, monkeypatch):
    monkeypatch.setattr("dualdepth.networks.depth_nets.HRNet", Brightness)
    DepthModel({"network": "hr", "hr_size": [192, 288], "about": ABOUT}).save_pretrained(tmp_path / "weights")
    return tmp_path / "weights"


@pytest.fixture
def photos(tmp_path):
    """What people have: grey, 16-bit, transparent, turned, of any name and size."""
    folder = tmp_path / "in put"
    folder.mkdir()
    image = wall(60, 100)
    cv2.imwrite(str(folder / "a.png"), image)
    cv2.imwrite(str(folder / "a.jpg"), image)
    cv2.imwrite(str(folder / "b grey ü.png"), image[..., 0])
    cv2.imwrite(str(folder / "c deep.png"), image.astype(np.uint16) * 257)
    cv2.imwrite(str(folder / "d clear.png"), np.dstack([image, image[..., 0]]))
    turned = PIL.Image.fromarray(image)
    turned.getexif()[0x112] = 6
    turned.save(folder / "e turned.jpg", exif=turned.getexif(), quality=100)
    (folder / "notes.txt").touch()
    return folder


@pytest.fixture
def clip(tmp_path):
    """Ten frames of an odd size that get brighter."""
    return write_video(tmp_path / "clip.avi", [wall(91, 161) // 8 + np.uint8(20 * i + 30) for i in range(10)], "MJPG")


@pytest.fixture
def out(tmp_path):
    return tmp_path / "o"


@pytest.fixture
def run(weights, out):
    """Predicts what is given, with options; a later one of a name counts."""
    return lambda *words: main(["predict", "--weights", str(weights), "--out", str(out), *map(str, words)])


def read(out, name):
    return np.load(out / f"{name}.depth.npy")


def visible(out):
    return sorted(path.name for path in out.iterdir() if not path.name.startswith("."))


def test_every_kind_of_photo_becomes_depth_of_its_own_size(photos, run, out, capsys):
    assert run(photos, "--save", "all", "--device", "cpu") == 0
    said = capsys.readouterr().out
    assert f"Depth is relative: its unit is unknown. Learned by {ABOUT}." in said and "81.4 degrees by default" in said
    stamp = json.loads((out / "predictions.json").read_text())
    assert [os.path.basename(entry["path"]) for entry in stamp["inputs"].values()] == sorted(set(os.listdir(photos)) - {"notes.txt"})
    assert list(stamp["inputs"]) == ["a", "a-2", "b grey ü", "c deep", "d clear", "e turned"]
    assert ABOUT in stamp["options"]["weights"] and stamp["options"]["precision"] == "float32"
    sizes = {name: read(out, name).shape for name in stamp["inputs"]}
    assert sizes == {name: (60, 100) for name in sizes} | {"e turned": (100, 60)}
    assert np.array_equal(read(out, "c deep"), read(out, "d clear"))
    np.testing.assert_allclose(read(out, "e turned").T[::-1], read(out, "a-2"), rtol=0.3)
    for name in sizes:
        png = cv2.imread(str(out / f"{name}.depth.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_allclose(png / 256, np.minimum(read(out, name), 65535 / 256), atol=1 / 512 + 1e-4)
        assert cv2.imread(str(out / f"{name}.colour.png")).shape[0] == 120 and (out / f"{name}.ply").stat().st_size > 60 * 100 * 15


def test_broken_files_are_named_and_the_others_done(photos, run, capsys, monkeypatch):
    broken = {"a0.png": b"", "b1.jpg": b"no image", "c2.png": (photos / "a.png").read_bytes()[:200], "d3.mp4": b"no video"}
    broken |= dict.fromkeys(("closed.png", "closed.mp4"), (photos / "a.png").read_bytes())
    for name, content in broken.items():
        (photos / name).write_bytes(content)
    (photos / "closed").mkdir()

    def without_rights(call, path, *rest, **named):  # as nobody; root may touch everything
        if "in put/closed" in str(path):
            raise PermissionError(13, "Permission denied", str(path))
        return call(path, *rest, **named)

    for name, call in {"io.open": io.open, "numpy.fromfile": np.fromfile, "os.listdir": os.listdir}.items():
        monkeypatch.setattr(name, partial(without_rights, call))
    for counts in ("6 predicted, 8 broken\n", "0 predicted, 6 were there, 8 broken\n"):
        assert run(photos, photos / "gone", photos / "closed") == 1
        said = capsys.readouterr()
        assert all(f"broken: {photos / name}: " in said.err for name in ("gone", "closed", *broken)) and said.out.endswith(counts)
        assert said.err.count(": cannot be read (Permission denied); change its permissions\n") == 3
    for name in broken:
        (photos / name).unlink()
    shutil.copyfile(photos / "a.png", photos / "a0.png")
    monkeypatch.setattr("sys.stderr", None)  # as of 2>&-
    assert run(photos) == 0


@pytest.fixture
def stop_at(monkeypatch):
    """As Ctrl-C at the n-th call of the network; gives the calls."""
    predict, calls = DepthModel.predict_batch, []

    def call(number):
        def counted(model, images):
            calls.append(images)
            if len(calls) == number:
                raise KeyboardInterrupt
            return predict(model, images)

        monkeypatch.setattr(DepthModel, "predict_batch", counted)
        return calls

    return call


def test_a_run_that_is_stopped_goes_on_where_it_was(photos, run, out, stop_at, capsys):
    calls = stop_at(5)
    with pytest.raises(SystemExit, match="130"):
        run(photos)
    assert len(list(out.glob("*.depth.png"))) == 4
    (out / ".a.0123abcd.part.png").touch()  # as a killed writer leaves it
    assert run(photos) == 0 and capsys.readouterr().out.endswith("2 predicted, 4 were there\n") and len(calls) == 7
    assert not list(out.glob(".*.part*")) and len(visible(out)) == 13


@pytest.mark.parametrize(("words", "scale", "unit"), [(["--scale", 2.5], 2.5, " x2.5"), (["--batch-size", 4], 1, "")])
def test_a_scale_is_applied_to_all_and_said_and_batches_give_what_single_images_give(photos, run, out, tmp_path, words, scale, unit):
    (photos / "b0.png").write_bytes(b"")
    assert run(photos, "--save", "npy", "--batch-size", 1, "--out", tmp_path / "one") == 1
    assert run(photos, "--save", "npy,depth", *words) == 1
    for path in (tmp_path / "one").glob("*.npy"):
        np.testing.assert_allclose(np.load(out / path.name), scale * np.load(path), rtol=1e-5)
    with PIL.Image.open(out / "a.depth.png") as image:
        assert f"value / 256 = relative depth{unit};" in image.text["Description"]


@pytest.mark.parametrize("numbers", [(90, 90, 80, 45), ("90,90,80,45",), ("90 90 80 45",)], ids=str)
def test_a_principal_point_outside_of_a_picture_is_refused_for_that_picture(photos, clip, run, capsys, numbers):
    assert run("--save", "ply", "--intrinsics", *numbers, photos, clip) == 1
    said = capsys.readouterr()
    assert f"broken: {photos}/e turned.jpg: 60x100 pixels do not hold the point CX 80 CY 45" in said.err
    assert "6 predicted, 1 broken" in said.out
    assert run(photos / "a.png", clip, "--save", "ply", "--intrinsics", 90, 90, 80, 75) == 1
    assert f"{photos}/a.png: 100x60 pixels" in capsys.readouterr().err


def test_a_gpu_that_is_too_small_gets_smaller_batches(photos, run, monkeypatch):
    predict, sizes = DepthModel.predict_batch, []

    def small(model, images):
        sizes.append(len(images))
        if len(images) > 1:
            raise torch.OutOfMemoryError
        return predict(model, images)

    monkeypatch.setattr(DepthModel, "predict_batch", small)
    assert run(photos, "--batch-size", 4) == 0 and sizes == [4, 2, *[1] * 6]


def test_a_video_becomes_a_video_side_by_side(clip, run, out):
    assert run(clip) == 0 and visible(out) == ["clip.side.mp4", "predictions.json"]
    made = Video(out / "clip.side.mp4")
    frames = [frame for _, frame in made.frames()]
    assert made.rate == 10 and len(frames) == 10 and frames[0].shape[0] == 120 and frames[0].shape[1] > 2 * 161


def test_each_frame_has_files_where_they_are_asked_for_and_the_first_ones_say_that_all_are_there(clip, run, out, stop_at, capsys):
    folder, words = out / "clip.frames", (clip, "--save", "npy,depth")
    stop_at(8)
    with pytest.raises(SystemExit, match="130"):
        run(*words)
    assert sorted(path.name for path in folder.glob("*.npy")) == [f"{i:06d}.depth.npy" for i in range(1, 7)]
    for expected in ("1 predicted (clip.frames/000000.depth.npy, clip.frames/000000.depth.png)\n", "0 predicted, 1 were there\n"):
        assert run(*words) == 0 and capsys.readouterr().out.endswith(expected)
    assert len(list(folder.iterdir())) == 20
    depths = [np.load(folder / f"{i:06d}.depth.npy").mean() for i in range(10)]
    assert depths == sorted(depths, reverse=True)


def test_a_video_that_ends_early_gives_what_it_has_and_says_so(clip, run, out, capsys):
    clip.write_bytes(b"00dc".join(clip.read_bytes().split(b"00dc")[:6]))  # before the fifth frame's end
    assert run(clip) == 1 and f"broken: {clip}: " in capsys.readouterr().err and (out / "clip.side.mp4").is_file()


def test_a_shorter_film_of_the_same_name_leaves_no_frames_of_the_longer_one(clip, run, out):
    assert run(clip, "--save", "npy,depth") == 0
    (out / "clip.frames/note.npy").touch()
    write_video(clip, [wall(91, 161)] * 3, "MJPG")
    assert run(clip, "--save", "npy") == 0
    left = {path.name for path in (out / "clip.frames").iterdir()}
    assert left == {"note.npy", *(f"{i:06d}.depth.npy" for i in range(3)), *(f"{i:06d}.depth.png" for i in range(10))}


def test_a_video_that_the_codec_does_not_take_stops_no_other(clip, photos, run, capsys, monkeypatch):
    monkeypatch.setattr("dualdepth.inference.results.CODEC", "none")
    assert run(clip, photos) == 1
    said = capsys.readouterr()
    assert f"broken: {clip}: OpenCV cannot write none of" in said.err and said.out.endswith("6 predicted, 1 broken\n")


def test_the_card_of_weights_that_a_link_points_to_is_found(photos, run, weights, tmp_path):
    (tmp_path / "best.safetensors").symlink_to(weights / "model.safetensors")
    assert run(photos / "a.png", "--weights", tmp_path / "best.safetensors") == 0


NUMBERS = {"--scale": ("0", "nan", "inf"), "--focal": ("0", "nan", "inf"), "--fov": ("0", "180"), "--batch-size": ("0",)}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["gone.png"], "gone.png: "),
        (["{photos}", "--weights", "gone.safetensors"], "gone.safetensors: "),
        (["{photos}", "--weights", "gone"], "gone: no such weights; give "),  # the hub, whose names are owner/name, is not asked
        (["{photos}", "--save", "colour,gif"], "'gif'"),
        *((["{photos}", option, value], f"{option}: {value} must be") for option, wrong in NUMBERS.items() for value in wrong),
        (["{photos}", "--intrinsics", "1", "0", "5", "5"], "--intrinsics: 1 0 5 5 must be FX,FY,CX,CY, of which the focal lengths"),
        *((["{photos}", "--intrinsics", *wrong], "must be FX,FY,CX,CY") for wrong in (["1,1,5"], ["1", "1", "5"], ["1 1 5 5 9"])),
        *((["{photos}", *words, ""], "an empty word ''") for words in ([], ["--out"], ["--weights"])),
        (["{photos}", "--intrinsics", "1,1,inf,5"], "--intrinsics: inf must be"),
        (["{photos}", "--device", "tpu"], "'tpu'"),
        (["{photos}", "--out", "{photos}/a.png"], "a.png: "),
    ],
    ids=str,
)
def test_mistakes_are_one_line_and_nothing_is_written(photos, run, out, refused, words, said):
    assert said in refused(run, *(word.format(photos=photos) for word in words)) and not out.exists()


ERRORS = {"No space": OSError(28, "No space left on device"), "PYTHONUTF8=1": UnicodeEncodeError("ascii", "ü", 0, 1, "no")}


@pytest.mark.parametrize(("said", "error"), ERRORS.items())
def test_a_full_disk_and_a_locale_without_letters_end_it_in_one_line(photos, run, out, capsys, monkeypatch, error, said):
    monkeypatch.setattr("dualdepth.inference.files.save", Mock(side_effect=error))
    with pytest.raises(SystemExit, match="2"):
        run(photos)
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"error: {out}: ") and said in last


def test_a_pipe_that_is_closed_early_is_not_said_to_be_the_results(photos, run, monkeypatch):
    monkeypatch.setattr("sys.stdout", Mock(spec=["write", "flush"], **{"flush.side_effect": BrokenPipeError(32, "Broken pipe")}))
    monkeypatch.setattr("os.dup2", Mock())
    with pytest.raises(SystemExit, match="141"):
        run(photos)
