"""Make a data set of your own camera that the notebooks train on: from a folder of frames or a video, and the camera's intrinsics.

    python data_scripts/own_camera.py drive.mp4 --out DIR --chessboard board.mp4 --squares 9x6
    make reproduce PROFILE=DIR/own.yaml KITTI_ROOT=DIR

Intrinsics are given (--intrinsics fx,fy,cx,cy or a calibration file), found (--chessboard, a folder or a video), or estimated (--fov).
The film is cut where it stands still, jumps or misses frames; what can be known to fail before a week of training is said at once.
"""

import argparse
import hashlib
import json
import re
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from data_scripts.own import dataset
from data_scripts.own.camera import MOST_BOARDS, Camera, Straightener, calibrate, camera_of_field, camera_of_file, camera_of_numbers
from data_scripts.own.checks import examine, hold_out, record
from dualdepth.data.frames import Footage
from dualdepth.errors import InputError, exit_on_input_error
from dualdepth.files import locked, write_json


class Made(NamedTuple):
    """A data set."""

    root: Path
    profile: Path
    record: dict[str, Any]
    """What `own.json` says."""
    kept: bool
    """Whether it was there already."""


def make(
    inputs: Sequence[str | Path],
    out: str | Path,
    *,
    intrinsics: str = "",
    chessboard: str | Path = "",
    squares: str = "",
    fov: float | None = None,
    stride: int | None = None,
    held_out: int | None = None,
    name: str = "own",
    anyway: bool = False,
) -> Made:
    """Make a data set in the folder `out`, unless this very one is there; arguments as on the command line.

    Raises:
        InputError: no camera or more than one, bad footage, a failed check, or `out` holds something else.
    """
    out = Path(out).absolute()
    if not re.fullmatch(r"[\w-]+", name):
        raise InputError(f"--name {name!r}: a profile and its folders are called so; give letters, digits, _ and -")
    footages = [Footage(path) for path in inputs]
    board = Footage(chessboard) if chessboard else None
    options = {
        "intrinsics": intrinsics,
        "squares": squares,
        "fov": fov,
        "stride": stride,
        "held_out": held_out,
        "name": name,
        "anyway": anyway,
    }
    file = Path(intrinsics) if intrinsics and not _numbers(intrinsics) else None
    if sum(map(bool, (intrinsics, chessboard, fov))) != 1:
        raise InputError(
            "the camera: give one of --intrinsics fx,fy,cx,cy (or a calibration file), --chessboard FOLDER_OR_VIDEO --squares 9x6, or"
            " --fov DEGREES, and only one"
        )
    if squares and not chessboard:
        raise InputError(f"--squares {squares}: is of a chessboard; give --chessboard FOLDER or a video, too")
    read_from = [f.digest() for f in (*footages, *([board] if board else []))]
    if file:
        read_from.append(_file_digest(file))
        options["intrinsics"] = "file"
    digest = hashlib.sha256(json.dumps([1, read_from, options]).encode()).hexdigest()
    out.parent.mkdir(parents=True, exist_ok=True)
    with locked(out.with_name(f".{out.name}.lock")):
        found = dataset.read_record(out)
        if found and found["made_from"] == digest:
            return Made(out, out / f"{name}.yaml", found, kept=True)
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            what = "a data set made of other footage or options" if found else "something else"
            raise InputError(f"{out}: holds {what}; remove it, or give another --out")
        partial = out.with_name(f".{out.name}.part")
        shutil.rmtree(partial, ignore_errors=True)
        try:
            said = _make(partial, footages, _camera(footages, intrinsics, board, squares, fov), stride, held_out, name, anyway)
            write_json(partial / dataset.RECORD, said | {"inputs": [str(f.path) for f in footages], "made_from": digest})
            if out.exists():
                out.rmdir()
            partial.rename(out)
        except OSError as error:
            raise InputError(f"{out}: could not be written ({error}); free space, or give another --out") from None
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    return Made(out, out / f"{name}.yaml", dataset.read_record(out) or {}, kept=False)


def _make(
    root: Path, footages: Sequence[Footage], camera: Camera, stride: int | None, held_out: int | None, name: str, anyway: bool
) -> dict[str, Any]:
    """Examine and write; returns the record."""
    hr_size = dataset.fitting_size(camera.size)
    film = examine(footages, camera.matrix[0, 0] / camera.size[1], stride)
    failed = [check for check in film.checks if not check.passed]
    if failed and not (anyway and film.drives):
        more = f" (--anyway makes the data set all the same; {len(failed)} of {len(film.checks)} checks failed)" if film.drives else ""
        raise InputError(f"{footages[0].path}: {failed[0].name}: {failed[0].said}{more}")
    train, shown = hold_out(film.drives, held_out)
    if not train:
        raise InputError(
            f"{footages[0].path}: no three frames are left to train on beside the held-out ones: film longer, or lower --held-out"
        )
    straighten = Straightener(camera) if camera.distortion and any(camera.distortion) else None
    used = straighten.camera if straighten else camera
    dataset.write_frames(root, footages, [*train, shown], straighten)
    dataset.write_calibration(root, used)
    dataset.write_lists(root, len(train), len(shown.numbers))
    triplets = sum(len(drive.numbers) - 2 for drive in train)
    (root / f"{name}.yaml").write_text(dataset.profile_text(hr_size, triplets), encoding="utf-8")
    drives = [
        {
            "drive": dataset.drive_name(k),
            "input": drive.footage,
            "first": drive.numbers[0],
            "last": drive.numbers[-1],
            "frames": len(drive.numbers),
        }
        for k, drive in enumerate([*train, shown], 1)
    ]
    drives[-1]["held_out"] = True
    cards = {"camera": camera.record()} | ({"undistorted_to": used.record()} if straighten else {})
    return cards | {"hr_size": list(hr_size), "triplets": triplets, **record(film), "drives": drives}


def _camera(footages: Sequence[Footage], intrinsics: str, board: Footage | None, squares: str, fov: float | None) -> Camera:
    """The camera by the one way that was given; all footages must have frames of one size."""
    sizes = {footage.path: next(footage.stills()).image.shape[:2] for footage in footages}
    size = next(iter(sizes.values()))
    for path, other in sizes.items():
        if other != size:
            raise InputError(f"{path}: has {other[1]}×{other[0]} pixels, {footages[0].path} {size[1]}×{size[0]}; make a data set of each")
    if board:
        match = re.fullmatch(r"(\d{1,2})[x×](\d{1,2})", squares)
        if not match:
            raise InputError(f"--squares {squares!r}: give the board's squares, or their inner corners, along and across, such as 9x6")
        every = max(1, board.length // MOST_BOARDS)
        views = ((f"{still.file or board.path}, frame {still.number}", still.image) for still in board.stills(range(0, 10**9, every)))
        return calibrate(views, (int(match[1]), int(match[2])), size, f"chessboard {board.path}")
    if fov:
        return camera_of_field(fov, size)
    return camera_of_numbers(intrinsics, size) if _numbers(intrinsics) else camera_of_file(intrinsics, size)


def _numbers(intrinsics: str) -> bool:
    return "," in intrinsics and not Path(intrinsics).exists()


def _file_digest(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot read the calibration ({error.strerror}); give a file, or fx,fy,cx,cy in pixels") from None


def summary(made: Made) -> str:
    """What a user wants to know of a data set, and what to type next."""
    said, found = made.record, made.record["frames"]
    camera, (height, width) = said["camera"], said["hr_size"]
    lines = [
        f"{made.root}: {'is there already, ' if made.kept else ''}{said['triplets']} triplets to train on,"
        f" {said['drives'][-1]['frames']} frames held out",
        f"camera: {camera['origin']}; fx {camera['fx']:g}, field of view {camera['field_of_view_degrees']:g} degrees"
        + ("; frames were undistorted" if "undistorted_to" in said else ""),
        f"stride {said['stride']}: {found['read']} frames, {found['used']} used, {found['standing']} standing, {found['gaps']} gaps,"
        f" {found['cuts']} cuts, {found['short']} in pieces of fewer than three; {len(said['drives'])} drives",
        f"the picture moves by {said['median_motion']['flow']:.2%} of its width from frame to frame (KITTI: about 1.2 %)",
        *(f"warning: {name}: {words}" for name, words in said["checks"].items() if words != "passed"),
        f"HR-Net sees {width}×{height} (hr_size in {made.profile.name}). Train with",
        f"    make reproduce PROFILE={made.profile} KITTI_ROOT={made.root}",
    ]
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Make a data set of your own camera that the notebooks train on.")
    parser.add_argument(
        "inputs", nargs="+", metavar="INPUT", help="folder of frames, or video; several of one camera are drives of one data set"
    )
    parser.add_argument("--out", required=True, metavar="DIR", help="folder to make; it is the KITTI_ROOT of the training")
    parser.add_argument(
        "--intrinsics",
        default="",
        metavar="FX,FY,CX,CY",
        help="in pixels of the frames; or a file: JSON with fx, fy, cx, cy (and distortion), another data set's own.json, KITTI's own",
    )
    parser.add_argument(
        "--chessboard", default="", metavar="PATH", help="folder or video of a chessboard seen from all sides, same camera mode"
    )
    parser.add_argument("--squares", default="", metavar="9x6", help="the chessboard's squares, or inner corners, along and across")
    parser.add_argument("--fov", type=float, metavar="DEGREES", help="horizontal field of view: an estimate, and recorded as one")
    parser.add_argument(
        "--stride", type=int, metavar="N", help="take every N-th frame (default: so that the picture moves about as in KITTI)"
    )
    parser.add_argument("--held-out", type=int, metavar="N", help="frames at the end to show, not to train on (default: a tenth, 3 to 40)")
    parser.add_argument("--name", default="own", help="of the profile that is written: results/NAME (default: %(default)s)")
    parser.add_argument("--anyway", action="store_true", help="make the data set even if a check fails, and record it")
    arguments = parser.parse_args(argv)
    with exit_on_input_error():
        for option in ("stride", "held_out"):
            if (value := getattr(arguments, option)) is not None and value < 1:
                raise InputError(f"--{option.replace('_', '-')} {value}: give a whole number from 1 up")
        options = vars(arguments)
        print(summary(make(options.pop("inputs"), options.pop("out"), **options)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
