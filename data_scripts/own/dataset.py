"""A data set of a user's own camera, in KITTI's layout, so that all else reads it as it reads KITTI.

Layout: `ROOT/2000_01_01/calib_cam_to_cam.txt`, `ROOT/2000_01_01/2000_01_01_drive_0001_sync/image_02/data/0000000000.jpg`,
`ROOT/lists/train_drives.txt` and `test_files.txt` (frames held out, to be shown), `ROOT/own.json` (what it was made from and what was
found), `ROOT/own.yaml` (a profile that fits it).
"""

import json
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from data_scripts.own.checks import Drive
from data_scripts.own.footage import Footage
from dualdepth.data.camera import Camera
from dualdepth.data.kitti import SUFFIXES
from dualdepth.errors import InputError, reading
from dualdepth.files import write_text
from dualdepth.profile import PROFILES
from dualdepth.run import RECORD

DATE = "2000_01_01"  # Stands where KITTI has the day of the recording; no day of KITTI's, so that its drives are never taken for KITTI's.
JPEG_QUALITY = 95
PIXELS = 384 * 1248  # of HR-Net's input, at most: the paper's
STEPS = {"lr": 1200, "hr": 400}  # of 4, that the written profile asks for, about


def drive_name(number: int) -> str:
    """`date/date_drive_XXXX_sync` of a drive, counted from 1."""
    return f"{DATE}/{DATE}_drive_{number:04d}_sync"


def fitting_size(size: tuple[int, int]) -> tuple[int, int]:
    """HR-Net's input for frames of `size` (height, width): multiples of 96 of nearly their shape, as large as frames and paper allow.

    Raises:
        InputError: the frames are too small.
    """
    height, width = size
    if min(size) < 175:
        raise InputError(f"frames of {width}×{height} pixels are too small: film with at least 192 pixels on each side")
    tall, wide = (range(192, int(max(192, 1.1 * side)) + 1, 96) for side in size)
    choices = [(h, w) for h in tall for w in wide if h * w <= PIXELS]

    squeezed = {c: abs(np.log(c[1] / c[0] * height / width)) for c in choices}
    alike = [c for c in choices if squeezed[c] < np.log(1.06)]
    return max(alike, key=np.prod) if alike else min(choices, key=squeezed.get)


def write_frames(root: Path, footages: Sequence[Footage], drives: Sequence[Drive], straighten: Callable | None) -> None:
    """Write the drives' frames, numbered from 0: image files as they are, else JPEG; undistorted by `straighten` where it is given."""
    with tqdm(total=sum(len(d.numbers) for d in drives), desc="writing frames", unit="frame", disable=None) as bar:
        for place, footage in enumerate(footages):
            own = [(i, d) for i, d in enumerate(drives, 1) if d.footage == place]
            targets = {n: root / drive_name(i) / "image_02" / "data" / f"{k:010d}" for i, d in own for k, n in enumerate(d.numbers)}
            suffixes = {file.suffix.lower() for file in (footage.files or {}).values()}
            copies = straighten is None and bool(suffixes) and suffixes <= set(SUFFIXES)
            for still in footage.stills(targets):
                target = targets[still.number].with_suffix(still.file.suffix.lower() if copies else ".jpg")
                target.parent.mkdir(parents=True, exist_ok=True)
                if copies:
                    shutil.copyfile(still.file, target)
                else:
                    image = cv2.cvtColor(straighten(still.image) if straighten else still.image, cv2.COLOR_RGB2BGR)
                    target.write_bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())
                bar.update()


def write_texts(root: Path, camera: Camera, train: int, held_out: int) -> None:
    """Write KITTI's `calib_cam_to_cam.txt` with the one camera, and the lists: training drives 1 … `train`, and all frames of the drive
    behind them, which are held out."""
    numbers = " ".join(f"{value:.9g}" for value in np.hstack([camera.matrix, np.zeros((3, 1))]).ravel())
    texts = {
        f"{DATE}/calib_cam_to_cam.txt": f"S_rect_02: {camera.size[1]} {camera.size[0]}\nP_rect_02: {numbers}\n",
        "lists/train_drives.txt": "".join(f"{drive_name(k)}\n" for k in range(1, train + 1)),
        "lists/test_files.txt": "".join(f"{drive_name(train + 1)} {k:010d} l\n" for k in range(held_out)),
    }
    for name, text in texts.items():
        write_text(root / name, text)


def profile_text(hr_size: tuple[int, int], triplets: int) -> str:
    """The profile `own` with a size that fits, and as many epochs as make about `STEPS`."""
    text = (PROFILES / "own.yaml").read_text(encoding="utf-8")
    size = f"hr_size: [{hr_size[0]}, {hr_size[1]}]           # nearest to the frames' shape; multiples of 96, at least 192"
    text = re.sub(r"hr_size: \[.*?\] *#.*", size, text)
    for stage, steps in STEPS.items():
        epochs = int(np.clip(round(4 * steps / max(triplets, 1)), 1, 40))
        why = f"# {epochs * (triplets // 4)} steps of 4 from {triplets} triplets; the paper has 40 epochs"
        text = re.sub(rf"( {stage}:\n +epochs:) \d+ *#.*", rf"\1 {epochs:<18}{why}", text)
    return text


def read_record(root: str | Path) -> dict[str, Any] | None:
    """What `own.json` says of a data set; None where there is none.

    Raises:
        InputError: it cannot be read.
    """
    path = Path(root) / RECORD
    if not path.is_file():
        return None
    with reading(path, "make the data set again with data_scripts/own_camera.py"):
        values = json.loads(path.read_text(encoding="utf-8"))
        if min(values["camera"]["width"], values["camera"]["height"]) > 0 and isinstance(values["made_from"], str):
            return values
        raise ValueError("no record of an own camera")
