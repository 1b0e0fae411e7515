"""The intrinsics of a user's own camera: given, found with a chessboard, or estimated from the field of view and said to be so."""

import json
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from dualdepth.data.camera import Camera, centred_camera, focal_length
from dualdepth.data.kitti import calibration_entry, read_calibration
from dualdepth.errors import InputError, reading

FIELD = (20.0, 150.0)
"""Horizontal fields of view, in degrees, that are believed: below is a telephoto lens, above a fisheye that no pinhole fits."""
BOARDS, MOST_BOARDS = 8, 60  # Views of the chessboard, at least and at most: more take minutes and change nothing.
REPROJECTION = 1.0
"""Root mean square error of the chessboard's corners in pixels, at most; in frames wider than 1000 pixels a thousandth of the width."""
KEYS = ("P_rect_02", "P2", "P_rect_00", "P0")  # of KITTI's calibration files, in order of preference
JSON_KEYS = {"fx", "fy", "cx", "cy", "width", "height", "distortion", "field_of_view_degrees", "origin"}


def camera_of_matrix(matrix: np.ndarray, size: tuple[int, int], origin: str, distortion: tuple[float, ...] = ()) -> Camera:
    """Camera of intrinsics (3, 3) or a rectified projection (3, 4)."""
    return Camera(*matrix.diagonal()[:2].tolist(), *matrix[:2, 2].tolist(), size, origin, distortion)


def record(camera: Camera) -> dict[str, Any]:
    """A camera as JSON, which `camera_of_file` reads."""
    numbers = {name: round(getattr(camera, name), 4) for name in ("fx", "fy", "cx", "cy")}
    numbers |= {"width": camera.size[1], "height": camera.size[0], "distortion": list(camera.distortion)}
    return numbers | {"field_of_view_degrees": round(camera.field, 1), "origin": camera.origin}


def camera_of_numbers(text: str, size: tuple[int, int]) -> Camera:
    """Camera of `fx,fy,cx,cy` in pixels of frames of `size` (height, width), or scaled from the size behind them, `…,width,height`.

    Raises:
        InputError: no four or six finite numbers, or numbers of frames of another size or shape.
    """
    with reading(f"--intrinsics {text!r}", "give fx,fy,cx,cy in pixels, such as 1000,1000,959.5,539.5, or a calibration file"):
        numbers = re.split(r",?\s+|,", text.strip())
        fx, fy, cx, cy, width, height = map(float, numbers + [*size[::-1]] * (len(numbers) == 4))
    camera = Camera(fx, fy, cx, cy, (height, width), "given as numbers")
    return validate(scaled(camera, size, f"--intrinsics {text!r}"), "--intrinsics", told=len(numbers) > 4)


def scaled(camera: Camera, size: tuple[int, int], what: str) -> Camera:
    """The camera for frames of `size`, of any scale; an `InputError` says of `what` that they have another shape."""
    if camera.size == size:
        return camera._replace(size=size)  # whole numbers
    (height, width), (fx, fy, cx, cy) = camera.size, camera[:4]
    crop = 0.9 < size[1] / (width or 1) < 1.1  # Nobody scales by so little.
    if crop or not (min(height, width) > 0 and 0.98 < size[1] / width * height / size[0] < 1.02):
        sizes = f"is of {width:g}×{height:g} pixels, the frames, {size[1]}×{size[0]}, have another shape or are another crop"
        raise InputError(f"{what}: {sizes}; calibrate with frames of the same mode")
    x, y, origin = size[1] / width, size[0] / height, f"{camera.origin}, scaled from {width:g}×{height:g}"
    return Camera(fx * x, fy * y, (cx + 0.5) * x - 0.5, (cy + 0.5) * y - 0.5, size, origin, camera.distortion)


def camera_of_file(path: str | Path, size: tuple[int, int]) -> Camera:
    """Camera of a calibration file: JSON with fx, fy, cx, cy (and width, height, distortion) or a data set's `own.json`, or KITTI's text.

    Raises:
        InputError: it cannot be read, holds no camera, or is of frames of another shape; to those of another size it is scaled.
    """
    path, said, distortion, source = Path(path), None, (), f"read from {Path(path).name}"
    if path.suffix.lower() != ".json":
        values = read_calibration(path)
        if not (key := next((k for k in KEYS if k in values), None)):
            mend = 'of another format write JSON: {"fx": …, "fy": …, "cx": …, "cy": …, "width": …, "height": …, "distortion": […]}'
            raise InputError(f"{path}: has none of KITTI's matrices {', '.join(KEYS)}; {mend}")
        camera = camera_of_matrix(calibration_entry(values, key, 12, path).reshape(3, 4), size, f"given; {source}")
        if (rectified := key.replace("P", "S")) in values:
            said = tuple(calibration_entry(values, rectified, 2, path)[::-1].round().astype(int))
    else:
        with reading(path, 'give {"fx": …, "fy": …, "cx": …, "cy": …}, perhaps with "width" and "height", in pixels'):
            values = json.loads(path.read_text(encoding="utf-8-sig"))
            values = values.get("camera", values)
            if unknown := sorted({*values} - JSON_KEYS):
                known = ", ".join(sorted(JSON_KEYS))
                raise InputError(f"{path}: unknown {', '.join(unknown)}; known are {known}: rename or remove the others")
            distortion = tuple(float(v) for v in values.get("distortion", ()))
            said = (int(values["height"]), int(values["width"])) if {"height", "width"} & {*values} else None
            numbers = (float(values[k]) for k in ("fx", "fy", "cx", "cy"))
            camera = Camera(*numbers, size, f"{values.get('origin', 'given')}; {source}", distortion)
    if len(distortion) not in (0, 4, 5, 8) or not np.isfinite(distortion).all():
        raise InputError(f"{path}: distortion has {len(distortion)} numbers; give OpenCV's k1, k2, p1, p2, k3, or none")
    return validate(scaled(camera._replace(size=said or size), size, str(path)), str(path), told=said is not None)


def camera_of_field(degrees: float, size: tuple[int, int]) -> Camera:
    """Camera with square pixels, its axis through the middle, estimated from the horizontal field of view alone.

    Raises:
        InputError: the field is not a believable one.
    """
    if not FIELD[0] <= degrees <= FIELD[1]:
        mend = f"give the horizontal field of view in degrees, {FIELD[0]:g} to {FIELD[1]:g}; phones have 60 to 75"
        raise InputError(f"--fov {degrees:g}: {mend}")
    origin = f"ESTIMATED from a horizontal field of view of {degrees:g} degrees, not calibrated"
    return centred_camera(focal_length(degrees, size[1]), size, origin)


def calibrate(views: Iterable[tuple[str, np.ndarray]], squares: tuple[int, int], size: tuple[int, int], what: str) -> Camera:
    """Camera found with views of a chessboard (Z. Zhang, "A Flexible New Technique for Camera Calibration", PAMI 2000), by OpenCV.

    Args:
        views: names and images (H, W, 3) uint8 RGB.
        squares: inner corners along and across the board; the number of its squares is understood, too.
        size: (height, width) of the frames that the camera is for.
        what: the views are of, for messages.

    Raises:
        InputError: views of another size, too few with the whole board in sight, or corners that no camera explains within `REPROJECTION`.
    """
    corners, seen, patterns = [], 0, [p for p in (squares, (squares[0] - 1, squares[1] - 1)) if min(p) > 2]
    for name, image in views:
        seen += 1
        if image.shape[:2] != size:
            sizes = f"has {image.shape[1]}×{image.shape[0]} pixels, the frames have {size[1]}×{size[0]}"
            raise InputError(f"{name}: {sizes}; film both in the same mode")
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        found = {pattern: cv2.findChessboardCornersSB(grey, pattern, None) for pattern in patterns}
        if whole := [pattern for pattern in patterns if found[pattern][0]]:
            patterns = whole[:1]  # the same board in all views
            corners.append(found[whole[0]][1].reshape(-1, 1, 2).astype(np.float32))
    if len(corners) < BOARDS:
        found = f"the whole board of {squares[0]}x{squares[1]} was found in {len(corners)} of {seen} views, {BOARDS} are needed"
        mend = "check --squares, and film the board sharp, flat, tilted each way, with a white margin, wholly in sight"
        raise InputError(f"{what}: {found}; {mend}")
    pattern = patterns[0]
    board = np.zeros((pattern[0] * pattern[1], 3), np.float32)
    board[:, :2] = np.mgrid[: pattern[0], : pattern[1]].T.reshape(-1, 2)
    error, matrix, distortion, *_ = cv2.calibrateCamera([board] * len(corners), corners, size[::-1], None, None)
    most = REPROJECTION * max(1.0, size[1] / 1000)
    if not error <= most:
        mend = "use a flat board, sharp views and a lens that neither zooms nor stabilises"
        raise InputError(f"{what}: the corners are off by {error:.2f} pixels (RMS), at most {most:.2f} is taken; {mend}")
    origin = f"chessboard, {pattern[0]}x{pattern[1]} inner corners in {len(corners)} of {seen} views, RMS error {error:.3f} pixels"
    return validate(camera_of_matrix(matrix, size, origin, tuple(distortion.ravel().tolist())), what)


def validate(camera: Camera, what: str, told: bool = True) -> Camera:
    """The camera, checked to be a believable one; `told`: the size that its numbers are of is known to be that of the frames.

    Raises:
        InputError: numbers that are not finite, a field of view outside `FIELD`, pixels far from square, an axis outside of the frame, or,
            where it is not told, far from its middle.
    """
    fx, fy, cx, cy, (height, width), *_ = camera
    if not np.isfinite(camera.matrix).all() or min(fx, fy) <= 0:
        wrong = "the numbers must be finite and the focal lengths above 0, in pixels"
    elif not FIELD[0] <= camera.field <= FIELD[1]:
        wrong = f"a field of view of {camera.field:.0f} degrees, not {FIELD[0]:g} to {FIELD[1]:g}; give pixels of these frames"
    elif not 0.5 < fx / fy < 2:
        wrong = "fx and fy differ by more than a factor of two; give fx,fy,cx,cy in this order"
    elif not (0 <= cx < width and 0 <= cy < height):
        wrong = "the centre lies outside of the frame; give fx,fy,cx,cy in this order, in pixels of these frames"
    elif not (told or (0.3 < cx / width < 0.7 and 0.3 < cy / height < 0.7)):
        wrong = "the centre is far from the middle; if they are of another size, give it: --intrinsics fx,fy,cx,cy,width,height"
    else:
        return camera
    raise InputError(f"{what}: fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} for frames of {width}×{height}: {wrong}")


def straightener(camera: Camera) -> tuple[Camera, Callable[[np.ndarray], np.ndarray]]:
    """The camera without its distortion, in frames of the same size without black margins, and what makes its images (H, W, 3) uint8."""
    matrix, size, lens = camera.matrix, camera.size[::-1], np.array(camera.distortion)
    rectified, _ = cv2.getOptimalNewCameraMatrix(matrix, lens, size, 0.0)
    straight = validate(camera_of_matrix(rectified, camera.size, f"{camera.origin}; frames undistorted"), "the camera after undistortion")
    maps = cv2.initUndistortRectifyMap(matrix, lens, None, rectified, size, cv2.CV_16SC2)
    return straight, lambda image: cv2.remap(image, *maps, cv2.INTER_LINEAR)
