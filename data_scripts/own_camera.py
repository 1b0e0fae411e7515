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
from dualdepth.errors import InputError, exit_on_input_error, reading
from dualdepth.files import locked, write_json


class Options(NamedTuple):
    """What the command line takes beside inputs and folder."""

    intrinsics: str = ""
    chessboard: str | Path = ""
    squares: str = ""
    fov: float | None = None
    stride: int | None = None
    held_out: int | None = None
    name: str = "own"
    anyway: bool = False

    @property
    def file(self) -> Path | None:
        """The calibration file that `intrinsics` names; None where they are numbers or not given."""
        numbers = "," in self.intrinsics and not Path(self.intrinsics).exists()
        return Path(self.intrinsics) if self.intrinsics and not numbers else None

    def check(self) -> None:
        """Refuse a name that is no file's, counts below 1, and no camera or more than one.

        Raises:
            InputError: naming the options.
        """
        if not re.fullmatch(r"[\w-]+", self.name):
            raise InputError(f"--name {self.name!r}: a profile and its folders are called so; give letters, digits, _ and -")
        for option, value in (("stride", self.stride), ("held-out", self.held_out)):
            if value is not None and value < 1:
                raise InputError(f"--{option} {value}: give a whole number from 1 up")
        if sum(map(bool, (self.intrinsics, self.chessboard, self.fov))) != 1:
            raise InputError(
                "the camera: give one of --intrinsics fx,fy,cx,cy (or a calibration file), --chessboard FOLDER_OR_VIDEO --squares 9x6, or"
                " --fov DEGREES, and only one"
            )
        if self.squares and not self.chessboard:
            raise InputError(f"--squares {self.squares}: is of a chessboard; give --chessboard FOLDER or a video, too")


class Made(NamedTuple):
    """A data set."""

    root: Path
    profile: Path
    record: dict[str, Any]
    """What `own.json` says."""
    kept: bool
    """Whether it was there already."""


def make(inputs: Sequence[str | Path], out: str | Path, **options: Any) -> Made:
    """Make a data set in the folder `out`, unless this very one is there; `options` are the fields of `Options`.

    Raises:
        InputError: no camera or more than one, bad footage, a failed check, or `out` holds something else.
    """
    out, chosen = Path(out).absolute(), Options(**options)
    chosen.check()
    footages = [Footage(path) for path in inputs]
    board = Footage(chosen.chessboard) if chosen.chessboard else None
    digest = digest_of([*footages, *([board] if board else [])], chosen)
    profile, partial = out / f"{chosen.name}.yaml", out.with_name(f".{out.name}.part")
    out.parent.mkdir(parents=True, exist_ok=True)
    with locked(out.with_name(f".{out.name}.lock")):
        found = dataset.read_record(out)
        if found and found["made_from"] == digest:
            return Made(out, profile, found, kept=True)
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            what = "a data set made of other footage or options" if found else "something else"
            raise InputError(f"{out}: holds {what}; remove it, or give another --out")
        shutil.rmtree(partial, ignore_errors=True)
        try:
            said = write(partial, footages, camera_of(footages, board, chosen), chosen)
            write_json(partial / dataset.RECORD, said | {"inputs": [str(f.path) for f in footages], "made_from": digest})
            if out.exists():
                out.rmdir()
            partial.rename(out)
        except OSError as error:
            raise InputError(f"{out}: could not be written ({error}); free space, or give another --out") from None
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    return Made(out, profile, dataset.read_record(out) or {}, kept=False)


def digest_of(footages: Sequence[Footage], chosen: Options) -> str:
    """Digest of all that a data set is made from."""
    read_from = [footage.digest() for footage in footages]
    options = {key: value for key, value in chosen._asdict().items() if key != "chessboard"}
    if chosen.file:
        with reading(chosen.file, "give a calibration file, or fx,fy,cx,cy in pixels"):
            read_from.append(hashlib.sha256(chosen.file.read_bytes()).hexdigest())
        options["intrinsics"] = "file"
    return hashlib.sha256(json.dumps([1, read_from, options]).encode()).hexdigest()


def write(root: Path, footages: Sequence[Footage], camera: Camera, chosen: Options) -> dict[str, Any]:
    """Examine the footages and write the data set; returns its record.

    Raises:
        InputError: a check fails, or too little is left to train on.
    """
    hr_size = dataset.fitting_size(camera.size)
    film = examine(footages, camera.matrix[0, 0] / camera.size[1], chosen.stride)
    failed = [check for check in film.checks if not check.passed]
    if failed and not (chosen.anyway and film.drives):
        more = f" (--anyway makes the data set all the same; {len(failed)} of {len(film.checks)} checks failed)" if film.drives else ""
        raise InputError(f"{footages[0].path}: {failed[0].name}: {failed[0].said}{more}")
    train, shown = hold_out(film.drives, chosen.held_out)
    if not train:
        raise InputError(
            f"{footages[0].path}: no three frames are left to train on beside the held-out ones: film longer, or lower --held-out"
        )
    straighten = Straightener(camera) if any(camera.distortion) else None
    used = straighten.camera if straighten else camera
    dataset.write_frames(root, footages, [*train, shown], straighten)
    dataset.write_calibration(root, used)
    dataset.write_lists(root, len(train), len(shown.numbers))
    triplets = sum(len(drive.numbers) - 2 for drive in train)
    (root / f"{chosen.name}.yaml").write_text(dataset.profile_text(hr_size, triplets), encoding="utf-8")
    drives = [
        {"drive": dataset.drive_name(k), "input": d.footage, "first": d.numbers[0], "last": d.numbers[-1], "frames": len(d.numbers)}
        for k, d in enumerate([*train, shown], 1)
    ]
    drives[-1]["held_out"] = True
    cards = {"camera": camera.record()} | ({"undistorted_to": used.record()} if straighten else {})
    return cards | {"hr_size": list(hr_size), "triplets": triplets, **record(film), "drives": drives}


def camera_of(footages: Sequence[Footage], board: Footage | None, chosen: Options) -> Camera:
    """The camera by the one way that was given.

    Raises:
        InputError: the footages have frames of several sizes, or the camera is none.
    """
    sizes = {footage.path: next(footage.stills()).image.shape[:2] for footage in footages}
    size = sizes[footages[0].path]
    for path, other in sizes.items():
        if other != size:
            raise InputError(f"{path}: has {other[1]}×{other[0]} pixels, {footages[0].path} {size[1]}×{size[0]}; make a data set of each")
    if board:
        match = re.fullmatch(r"(\d{1,2})[x×](\d{1,2})", chosen.squares)
        if not match:
            raise InputError(f"--squares {chosen.squares!r}: give the board's squares, or inner corners, along and across, such as 9x6")
        every = max(1, board.length // MOST_BOARDS)
        views = ((f"{still.file or board.path}, frame {still.number}", still.image) for still in board.stills(range(0, 10**9, every)))
        return calibrate(views, (int(match[1]), int(match[2])), size, f"chessboard {board.path}")
    if chosen.fov:
        return camera_of_field(chosen.fov, size)
    return camera_of_file(chosen.file, size) if chosen.file else camera_of_numbers(chosen.intrinsics, size)


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
        options = vars(arguments)
        print(summary(make(options.pop("inputs"), options.pop("out"), **options)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
