"""Label maps of scored frames: 8-bit PNG files of Cityscapes training ids, one an image (cityscapesScripts `labels.py`)."""

import functools
import io
from pathlib import Path

import numpy as np
from PIL import Image

from dualdepth.data.kitti import Frame, check_root, whole_image
from dualdepth.errors import InputError, reading

CITYSCAPES = (
    *("road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign", "vegetation", "terrain"),
    *("sky", "person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle"),
)
"""Names of the training ids 0 … 18."""
IGNORE = 255  # What has none of these classes.
check_labels_root = functools.partial(
    check_root, option="LABELS_ROOT", pattern="*/*.png", mend="make <drive>/<frame>.png with python data_scripts/export_labels.py"
)


def label_path(labels_root: str | Path, frame: Frame) -> Path:
    """Where the label map of a frame is: `<root>/<date_drive_XXXX_sync>/<index>.png`."""
    return Path(labels_root) / frame.drive.split("/")[-1] / f"{frame.index:010d}.png"


def read_label_map(path: str | Path) -> np.ndarray:
    """Read a label map, (H, W) uint8: training ids 0 … 18, or 255 (ignore). Of a file with a palette the indices count, not their colours.
    An `InputError` says that it is missing, damaged, no PNG, of several channels or 16 bits, or holds other ids."""
    data, mend = whole_image(path), "make it with data_scripts/export_labels.py"
    ids = f"training ids 0 to {len(CITYSCAPES) - 1} (Cityscapes' labelTrainIds), or {IGNORE}"
    with reading(path, mend), Image.open(io.BytesIO(data)) as image:
        if image.format != "PNG" or image.mode not in ("L", "P"):
            raise InputError(f"{path}: a {image.format} of mode {image.mode}; give a PNG of one 8-bit channel with {ids}")
        labels = np.array(image)
    unknown = sorted({*np.unique(labels).tolist()} - {*range(len(CITYSCAPES)), IGNORE})
    if unknown:
        raise InputError(f"{path}: holds {', '.join(map(str, unknown))}; give {ids}, not Cityscapes' raw ids (labelIds), which go up to 33")
    return labels
