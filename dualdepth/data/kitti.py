"""KITTI raw on disk: frame lists, image files, calibration.

Layout, as KITTI unpacks: `ROOT/2011_09_26/calib_cam_to_cam.txt`,
`ROOT/2011_09_26/2011_09_26_drive_0095_sync/image_02/data/0000000000.png` (or .jpg).
"""

import contextlib
import functools
import io
import re
import shlex
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import PIL.Image
import PIL.ImageOps

from dualdepth.errors import InputError, note, reading

CAMERA_OF_SIDE = {"l": "image_02", "r": "image_03"}
SUFFIXES = tuple(case(ending) for case in (str.lower, str.upper, str.title) for ending in (".png", ".jpg", ".jpeg"))
AGAIN, FOLDERS = "copy or download it again", "give the folder that holds 2011_09_26, 2011_09_28, …"
HEIF = tuple(b"ftyp" + brand for brand in b"heic heix heim heis hevc mif1 msf1 avif avis".split())  # Bytes 4 to 12 of phones' photos.
TIFF = (b"II", b"MM")  # Bytes 0 to 2.
FILLING = b"".join(4096 * b"U" + bytes((0xFF, 0xD0 + n)) for n in range(8))  # Changes pixels that a JPEG lacks, behind any restart.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # What cannot be read is told in one line here.


class Frame(NamedTuple):
    """One camera frame: `drive` is `date/date_drive_XXXX_sync`, `camera` a folder like `image_02`."""

    drive: str
    index: int
    camera: str = "image_02"

    @property
    def date(self) -> str:
        """Recording day, the folder that holds the calibration."""
        return self.drive.split("/")[0]

    def __str__(self) -> str:
        return f"{self.drive}/{self.camera}/{self.index:010d}"


def read_frame_list(path: str | Path) -> list[Frame]:
    """Read a list in the field's format, one `2011_09_26/2011_09_26_drive_0052_sync 0000000000 l` a line; without `l` or `r`, left.
    SfMLearner's `…_sync/image_02/data/0000000000.png` is read, too, and monodepth's pairs. An `InputError` names the first bad line."""
    pattern = r"(\d{4}_\d{2}_\d{2})/(\1_drive_\d{4}_sync)(?: |/(image_0\d)/data/)(\d{1,10})(?:\.(?i:png|jpe?g)(?: \S+)?)?(?: ([lr]))?"
    if not (lines := _matched_lines(path, pattern, "date/date_drive_XXXX_sync frame l|r")):
        raise InputError(f"{path}: the list is empty")
    return [Frame(f"{date}/{drive}", int(index), camera or CAMERA_OF_SIDE[side or "l"]) for date, drive, camera, index, side in lines]


def read_static_frames(path: str | Path) -> set[tuple[str, int]]:
    """Read the field's list of frames where the camera stands still, as (drive, index): `date date_drive_XXXX_sync index`."""
    pattern = r"(\d{4}_\d{2}_\d{2}) (\1_drive_\d{4}_sync) (\d{1,10})"
    return {(f"{date}/{drive}", int(index)) for date, drive, index in _matched_lines(path, pattern, "date date_drive_XXXX_sync frame")}


def read_test_scenes(path: str | Path) -> set[str]:
    """Read the drives that hold test frames (`2011_09_26_drive_0117` a line), as `date/date_drive_XXXX_sync`."""
    lines = _matched_lines(path, r"((\d{4}_\d{2}_\d{2})_drive_\d{4})", "date_drive_XXXX")
    return {f"{date}/{drive}_sync" for drive, date in lines}


def _matched_lines(path: str | Path, pattern: str, form: str) -> list[tuple]:
    """Groups of each line, all of which must match; an `InputError` names the first that does not by its number."""
    found = []
    for number, line in numbered_lines(Path(path)):
        if not (match := re.fullmatch(pattern, line)):
            raise InputError(f"{path}, line {number}: {line[:80]!r} is not `{form}`")
        found.append(match.groups())
    return found


def numbered_lines(path: Path) -> list[tuple[int, str]]:
    """Lines of a text file that are not blank, and their numbers from 1; without quotes and a byte order mark, words a space apart.
    An `InputError` says that it cannot be read, or is no text."""
    with reading(path, f"give a text file in UTF-8, or {AGAIN}"):
        text = path.read_text(encoding="utf-8-sig").replace('"', " ").replace("'", " ")
    return [(number, " ".join(line.split())) for number, line in enumerate(text.splitlines(), 1) if line.strip()]


def check_root(root: str | Path, option: str = "KITTI_ROOT", pattern: str = "20??_??_??/calib_cam_to_cam.txt", mend: str = FOLDERS) -> Path:
    """A folder of data that a user gives as `option`: the KITTI raw folder, or another one with its pattern and mend.
    An `InputError` says that it holds nothing of the pattern."""
    if not any(Path(root).glob(pattern)):
        raise InputError(f"{option} {root}: holds no {pattern}; {mend}")
    return Path(root)


def image_path(root: str | Path, frame: Frame) -> Path | None:
    """Path of a frame's image, PNG or JPEG, or None where there is none."""
    paths = (Path(root) / frame.drive / frame.camera / "data" / f"{frame.index:010d}{suffix}" for suffix in SUFFIXES)
    return next((path for path in paths if path.is_file()), None)


def velodyne_path(root: str | Path, frame: Frame) -> Path:
    """Path of the laser scan taken with a frame."""
    return Path(root) / frame.drive / "velodyne_points" / "data" / f"{frame.index:010d}.bin"


def read_image(path: str | Path) -> np.ndarray:
    """Decode an image to RGB, (H, W, 3) uint8; grey is repeated over the channels. 16-bit files of a folder are shown alike: the highest 8
    of the bits in use (10, 12, 14 or 16), or a narrow range far from 0. An `InputError` says that it is missing, truncated or no image."""
    image, path = _decoded(Path(path)), Path(path)
    if image.dtype == np.uint8:
        return image
    lowest, highest = _range(path.parent, path.suffix.lower()) or np.percentile(image[::4, ::4], (1, 99))
    if highest / 2 < lowest < highest:  # such as temperatures in hundredths of a kelvin
        note(f"{path.parent}: holds 16-bit images with values from {lowest:.0f} to {highest:.0f} alone; these become 0 to 255")
        return np.interp(image, (lowest, highest), (0, 255)).round().astype(np.uint8)
    bits = next(bits for bits in (8, 10, 12, 14, 16) if highest < 2**bits)
    if bits < 16:
        note(f"{path.parent}: holds 16-bit images with values of {bits} bits; the highest 8 of these are taken")
    return np.minimum(image >> (bits - 8), 255).astype(np.uint8)


@functools.cache
def _range(folder: Path, suffix: str, most: int = 32) -> tuple[float, float] | None:
    """The least and largest value, but for a hundredth of the pixels each, in up to `most` 16-bit images (none black) all over a folder."""
    files, found = sorted(p for p in folder.glob("*") if p.suffix.lower() == suffix and not p.name.lower().endswith(".depth.png")), []
    for path in files[:: -(-len(files) // most) or 1]:
        with contextlib.suppress(InputError):
            if (image := _decoded(path)).dtype == np.uint16 and (ends := np.percentile(image[::4, ::4], (1, 99)))[1]:
                found.append(ends)
    return (np.min(found, 0)[0], np.max(found, 0)[1]) if found else None


def _decoded(path: Path) -> np.ndarray:
    """An image with the values that are stored, turned as it says: (H, W, 3) RGB, uint8 or uint16."""
    data = whole_image(path)
    if data[4:12].tobytes() in HEIF:  # which OpenCV does not turn
        with reading(path, AGAIN), PIL.Image.open(io.BytesIO(data)) as photo:
            return np.array(PIL.ImageOps.exif_transpose(photo).convert("RGB"))
    tiff = data[:2].tobytes() in TIFF  # In RGB their 16-bit colours would be memory that nobody wrote to (OpenCV 5.0.0).
    image = cv2.imdecode(data, cv2.IMREAD_ANYDEPTH | (cv2.IMREAD_COLOR if tiff else cv2.IMREAD_COLOR_RGB))
    if image is None or image.dtype not in (np.uint8, np.uint16, np.int16):
        raise _undecodable(path, data)
    image = image if image.dtype != np.int16 else image.clip(0).astype(np.uint16)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if tiff else image


def _undecodable(path: Path, data: np.ndarray | bytes) -> InputError:
    """What a file is that no reader knows, and what to do."""
    what = f"not an image that can be decoded; {AGAIN}, or convert it to PNG"
    if bytes(data[4:12]) in HEIF:
        names = (shlex.quote(str(name)) for name in (path, path.with_suffix(".converted.jpg")))
        what = f"a HEIC or AVIF photo, not read here; convert it: heif-convert {' '.join(names)}"
    elif bytes(data[:2]) in TIFF:
        what = "a damaged TIFF, or one of 32-bit or other values that are not read here; convert it to a 16-bit PNG"
    return InputError(f"{path}: {what}")


def whole_image(path: str | Path) -> np.ndarray:
    """Bytes (N,) of an image file, checked without decoding it, if nothing is behind the image; phones write films there, which do no
    harm. Raises an `InputError`: missing, truncated, no image, with a wrong checksum (PNG), or larger than 179 million pixels."""
    with reading(path, AGAIN):
        data = np.fromfile(path, np.uint8)
    end = {b"\xff\xd8": b"\xff\xd9", b"\x89P": b"IEND"}.get(data[:2].tobytes(), b"")  # of JPEG and PNG
    if end not in data[-64:].tobytes():
        with reading(path, AGAIN), contextlib.suppress(PIL.UnidentifiedImageError), PIL.Image.open(file := io.BytesIO(data)) as image:
            if end in data[file.tell() :].tobytes():  # behind the header, which may hold a small picture
                image.load()  # refuses pixels that are not there
            elif (
                image.format != "JPEG"
                or image.info.get("progressive")
                or not np.array_equal(*(_pixels(_with_end(data, filling)) for filling in (b"", FILLING)))
            ):
                raise InputError(f"{path}: truncated ({data.size} bytes); {AGAIN}")
            else:
                data = _with_end(data)
    check_image(path, data)
    return data


def _with_end(data: np.ndarray, filling: bytes = b"") -> np.ndarray:
    """A JPEG whose end marker is missing, with one; what fills a gap before it changes pixels that are not there."""
    data = re.sub(rb"(?<![\0\xff])\0+\Z", b"", data.tobytes()).rstrip(b"\xff")  # pixels end in no zero but that of FF 00
    return np.frombuffer(data + filling + b"\xff\xd9", np.uint8)


def _pixels(data: np.ndarray) -> np.ndarray:
    with PIL.Image.open(io.BytesIO(data)) as image:
        return np.asarray(image)


def check_image(path: str | Path, data: np.ndarray | bytes) -> None:
    """Refuse what is no image or announces too many pixels, by its header, and a PNG that is truncated or whose checksums are wrong.
    The `InputError` names `path`, where the bytes are from."""
    with reading(path, AGAIN):
        try:
            with PIL.Image.open(io.BytesIO(data)) as image:
                if getattr(image, "tag_v2", {}).get(254, 0) & 1:  # of the first image of DNG, NEF and ARW
                    raise InputError(f"{path}: a camera's raw photo, whose preview alone can be read; develop it to PNG or JPEG")
                with contextlib.suppress(Exception):  # of damage behind the first page
                    if image.format != "MPO" and (count := getattr(image, "n_frames", 1)) > 1:
                        note(f"{path}: has {count} frames or pages; the first is taken")
                image.verify()
        except PIL.UnidentifiedImageError:  # whose own message names no file
            raise _undecodable(Path(path), data) from None


def read_calibration(path: str | Path) -> dict[str, np.ndarray]:
    """Read a `key: numbers` calibration file (`calib_cam_to_cam.txt`, `calib_velo_to_cam.txt`, odometry's `calib.txt`) into flat
    float64 arrays; lines that hold no numbers (`calib_time`) are left out. In a file without any key (`calib_p0_p1.txt`) the rows are `P0`,
    `P1`, … An `InputError` says that it cannot be read or holds no calibration."""
    lines, values = [line for _, line in numbered_lines(Path(path))], {}
    if not any(":" in line for line in lines):
        lines = [f"P{number}: {line}" for number, line in enumerate(lines)]
    for key, _, rest in (line.partition(":") for line in lines):
        with contextlib.suppress(ValueError):
            if numbers := [float(x) for x in rest.split()]:
                values[key.strip()] = np.array(numbers)
    if not values:
        raise InputError(f"{path}: holds no `key: numbers` line; give KITTI's own calibration file")
    return values


def calibration_entry(values: dict[str, np.ndarray], key: str, size: int, path: str | Path) -> np.ndarray:
    """The entry `key` of a calibration, `size` finite numbers; where it is missing or bad, an `InputError` names `path` and `key`."""
    entry = values.get(key)
    if entry is None:
        raise InputError(f"{path}: has no {key}; known are {', '.join(list(values)[:12])}")
    if entry.size != size or not np.isfinite(entry).all():
        raise InputError(f"{path}: {key} must be {size} finite numbers, found {entry.size}")
    return entry


def intrinsics(root: str | Path, date: str, camera: str = "image_02") -> np.ndarray:
    """Intrinsics (3, 3) float64 of a rectified camera, from `P_rect` of `calib_cam_to_cam.txt`, in pixels of the raw frame; pixel (0, 0) is
    the centre of the first pixel."""
    path = Path(root) / date / "calib_cam_to_cam.txt"
    projection = calibration_entry(read_calibration(path), f"P_rect_{camera[-2:]}", 12, path)
    return projection.reshape(3, 4)[:, :3].copy()
