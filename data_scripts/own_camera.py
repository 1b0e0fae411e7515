"""Make a data set of your own camera that the notebooks train on: from a folder of frames or a video, and the camera's intrinsics.

    python data_scripts/own_camera.py drive.mp4 --out DIR --chessboard board.mp4 --squares 9x6
    make reproduce PROFILE=DIR/own.yaml KITTI_ROOT=DIR

Intrinsics are given (--intrinsics fx,fy,cx,cy or a calibration file), found (--chessboard, a folder or a video), or estimated (--fov).
The film is cut where it stands still, jumps or misses frames; what can be known to fail before a week of training is said at once.
"""

import json
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from data_scripts.own import dataset
from data_scripts.own.camera import MOST_BOARDS, calibrate, camera_of_field, camera_of_file, camera_of_numbers, record, straightener
from data_scripts.own.checks import examine, hold_out
from data_scripts.own.footage import Footage
from dualdepth.cli import OneLineParser
from dualdepth.data.camera import Camera
from dualdepth.data.frames import is_image
from dualdepth.errors import InputError, exit_on_input_error
from dualdepth.files import file_digest, locked, short_digest, write_json, write_text


class Made(NamedTuple):
    """A data set: its folder and profile, what `own.json` says, and whether it was there already."""

    root: Path
    profile: Path
    record: dict[str, Any]
    kept: bool


def make(
    inputs: Sequence[str | Path],
    out: str | Path,
    *,
    stride: int | None = None,
    held_out: int | None = None,
    name: str = "own",
    anyway: bool = False,
    **given: Any,
) -> Made:
    """Make a data set in the folder `out`, unless this very one is there; all arguments are those of the command line.

    Raises:
        InputError: no camera or more than one, bad footage, a failed check, or `out` holds something else.
    """
    if not re.fullmatch(r"(?!(kitti|published|lock|home)$)\w[\w-]*", name):
        raise InputError(f"--name {name!r}: a profile and its folders are called so; give letters, digits, _ and -, not a folder of ours")
    for option, value in (("stride", stride), ("held-out", held_out)):
        if value is not None and value < 1:
            raise InputError(f"--{option} {value}: give a whole number from 1 up")
    out, footages = Path(out).absolute(), [footage_of(path) for path in inputs]
    options = {"stride": stride, "held_out": held_out, "name": name, "anyway": anyway}
    digest = short_digest(*(f.digest() for f in footages), json.dumps([_by_content(given), options]))
    partial = out.with_name(f".{out.name}.part")
    with locked(out.with_name(f".{out.name}.lock")):
        found = dataset.read_record(out)
        if found and found["made_from"] == digest:
            return Made(out, out / f"{name}.yaml", found, kept=True)
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            what = "a data set made of other footage or options" if found else "something else"
            raise InputError(f"{out}: holds {what}; remove it, or give another --out")
        shutil.rmtree(partial, ignore_errors=True)
        try:
            said = write(partial, footages, camera_of(footages, **given), **options)
            said |= {"inputs": [str(f.path) for f in footages], "made_from": digest}
            write_json(partial / dataset.RECORD, said)
            partial.rename(out)  # an empty folder gives way
        except OSError as error:
            raise InputError(f"{out}: could not be written ({error}); free space, or give another --out") from None
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    return Made(out, out / f"{name}.yaml", said, kept=False)


def footage_of(path: str | Path) -> Footage:
    """A folder of frames or a video; an `InputError` says that it is one photo, or what else it is."""
    if Path(path).is_file() and is_image(Path(path)):
        raise InputError(f"{path}: this is one photo; give a film, or the folder that its frames lie in")
    return Footage(path)


def _by_content(given: dict[str, Any]) -> list[Any]:
    """The camera's options, a file or chessboard by its content: one that was moved is the same one."""
    board, numbers = given.get("chessboard"), given.get("intrinsics", "")
    return [footage_of(board).digest() if board else "", file_digest(Path(numbers)) or numbers, given.get("squares"), given.get("fov")]


def write(
    root: Path, footages: Sequence[Footage], camera: Camera, *, stride: int | None, held_out: int | None, name: str, anyway: bool
) -> dict[str, Any]:
    """Examine the footages and write the data set; returns its record.

    Raises:
        InputError: a check fails, or too little is left to train on.
    """
    hr_size = dataset.fitting_size(camera.size)
    film = examine(footages, camera.fx / camera.size[1], stride)
    failed = [f"{check}: {said}" for check, said in film.checks.items() if said]
    if failed and not (anyway and film.drives):
        more = f" (--anyway makes the data set all the same; {len(failed)} of {len(film.checks)} checks failed)" if film.drives else ""
        raise InputError(f"{footages[0].path}: {failed[0]}{more}")
    train, shown = hold_out(film.drives, held_out)
    if not train:
        what = "no three frames are left to train on beside the held-out ones"
        raise InputError(f"{footages[0].path}: {what}: film longer, or lower --held-out")
    used, straighten = straightener(camera) if any(camera.distortion) else (camera, None)
    dataset.write_frames(root, footages, [*train, shown], straighten)
    triplets = sum(len(drive.numbers) - 2 for drive in train)
    dataset.write_texts(root, used, len(train), len(shown.numbers))
    write_text(root / f"{name}.yaml", dataset.profile_text(hr_size, triplets))
    drives = [
        {"drive": dataset.drive_name(k), "input": d.footage, "first": d.numbers[0], "last": d.numbers[-1], "frames": len(d.numbers)}
        for k, d in enumerate([*train, shown], 1)
    ]
    drives[-1]["held_out"] = True
    found = {check: f"FAILED: {said}" if said else "passed" for check, said in film.checks.items()}
    said = {"camera": record(camera)} | ({"undistorted_to": record(used)} if straighten else {})
    said |= {"hr_size": list(hr_size), "triplets": triplets, "stride": film.stride, "frames": film.counts}
    return said | {"median_motion": film.medians, "checks": found, "drives": drives}


def camera_of(
    footages: Sequence[Footage], intrinsics: str = "", chessboard: str | Path = "", squares: str = "", fov: float | None = None
) -> Camera:
    """The camera by the one way that was given.

    Raises:
        InputError: none or several ways are given, the footages have frames of several sizes, or the camera is none.
    """
    if sum((bool(intrinsics), bool(chessboard), fov is not None)) != 1 or bool(squares) != bool(chessboard):
        ways = "--intrinsics fx,fy,cx,cy (or a calibration file), --chessboard FOLDER_OR_VIDEO --squares 9x6, or --fov DEGREES"
        raise InputError(f"the camera: give one of {ways}, and only one")
    sizes = {footage.path: next(footage.stills()).image.shape[:2] for footage in footages}
    size = sizes[footages[0].path]
    for path, other in sizes.items():
        if other != size:
            raise InputError(f"{path}: has {other[1]}×{other[0]} pixels, {footages[0].path} {size[1]}×{size[0]}; make a data set of each")
    if fov is not None:
        return camera_of_field(fov, size)
    if intrinsics:
        numbers = re.search(r",|^[-+\d.e\s]+$", intrinsics) and not Path(intrinsics).exists()
        return camera_of_numbers(intrinsics, size) if numbers else camera_of_file(intrinsics, size)
    match = re.fullmatch(r"(\d{1,2})[x×](\d{1,2})", squares)
    if not match:
        raise InputError(f"--squares {squares!r}: give the board's squares, or inner corners, along and across, such as 9x6")
    board = footage_of(chessboard)
    every = max(1, board.length // MOST_BOARDS)
    views = ((f"{still.file or board.path}, frame {still.number}", still.image) for still in board.stills(range(0, 10**9, every)))
    return calibrate(views, (int(match[1]), int(match[2])), size, f"chessboard {board.path}")


def summary(made: Made) -> str:
    """What a user wants to know of a data set, and what to type next."""
    said, (height, width) = made.record, made.record["hr_size"]
    camera, found = said["camera"], ", ".join(f"{count} {name}" for name, count in said["frames"].items())
    lines = [
        f"{made.root}: {'is there already' if made.kept else 'made'}",
        f"{said['triplets']} triplets to train on, {said['drives'][-1]['frames']} frames held out, {len(said['drives'])} drives",
        f"camera: {camera['origin']}; fx {camera['fx']:g}, field of view {camera['field_of_view_degrees']:g} degrees"
        + ("; frames were undistorted" if "undistorted_to" in said else ""),
        f"stride {said['stride']}: {found}",
        f"the picture moves by {said['median_motion']['flow']:.2%} of its width from frame to frame (KITTI: about 1.2 %)",
        *(f"warning: {name}: {words}" for name, words in said["checks"].items() if words != "passed"),
        f"HR-Net sees {width}×{height} (hr_size in {made.profile.name}). Train with",
        f"    make reproduce PROFILE={made.profile} KITTI_ROOT={made.root}",
    ]
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> None:
    """Run the command line."""
    description = "Make a data set of your own camera that the notebooks train on."
    parser = OneLineParser(prog="python data_scripts/own_camera.py", description=description)
    add = parser.add_argument
    add("inputs", nargs="+", metavar="INPUT", help="folder of frames, or video; several of one camera are drives of one data set")
    add("--out", required=True, metavar="DIR", help="folder to make; it is the KITTI_ROOT of the training")
    kinds = "in pixels of the frames, or of the size behind them, FX,FY,CX,CY,W,H, with commas or blanks; or a file: JSON with fx, fy, cx, "
    kinds += "cy (and width, height, distortion), another data set's own.json, KITTI's own"
    add("--intrinsics", default="", metavar="FX,FY,CX,CY", help=kinds)
    add("--chessboard", default="", metavar="PATH", help="folder or video of a chessboard seen from all sides, same camera mode")
    add("--squares", default="", metavar="9x6", help="the chessboard's squares, or inner corners, along and across")
    add("--fov", type=float, metavar="DEGREES", help="horizontal field of view: an estimate, and recorded as one")
    add("--stride", type=int, metavar="N", help="take every N-th frame (default: so that the picture moves about as in KITTI)")
    add("--held-out", type=int, metavar="N", help="frames at the end to show, not to train on (default: a tenth, 3 to 40)")
    add("--name", default="own", help="of the profile that is written: results/NAME (default: %(default)s)")
    add("--anyway", action="store_true", help="make the data set even if a check fails, and record it")
    with exit_on_input_error():
        arguments = vars(parser.parse_args(argv))
        print(summary(make(arguments.pop("inputs"), arguments.pop("out"), **arguments)))


if __name__ == "__main__":
    main()
