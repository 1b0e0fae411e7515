"""Make3D's test photos and their laser grids (A. Saxena, M. Sun, A. Ng, "Make3D", IEEE PAMI 2009).

Layout, as the archives unpack: `ROOT/Test134/img-<name>.jpg` (2272 rows, 1704 columns) and `ROOT/Gridlaserdata/depth_sph_corr-<name>.mat`.
One photo of the published set is truncated; the field scores it all the same, so a photo that lacks its end is read as far as it goes.
"""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from dualdepth.data.kitti import AGAIN, check_image, read_image
from dualdepth.errors import InputError, reading

PHOTO_FOLDERS = ("Test134", "Test134Img")
GRID_FOLDERS = ("Gridlaserdata", "Test134Depth", "Test134Depth/Gridlaserdata")
"""Names that the field's code has for the two folders; the first one is the archives'."""
PHOTO, GRID = ("img-", ".jpg"), ("depth_sph_corr-", ".mat")  # What stands before and after a photo's and a grid's name.
GRID_KEY, GRID_SHAPE = "Position3DGrid", (55, 305)
END_OF_JPEG = b"\xff\xd9"
MAKE3D_PHOTOS = 134
LEAST_LEFT = 0.5  # Share of a truncated photo's rows that must be there.


class PhotoGrid(NamedTuple):
    """A photo and its laser grid."""

    name: str
    photo: Path
    grid: Path


def find_pairs(root: str | Path) -> list[PhotoGrid]:
    """All photos with their grids, by name. An `InputError` says that a folder is missing or empty, or that a photo or a grid stands alone;
    it names the first ones."""
    root = Path(root)
    photos, grids = _named(root, PHOTO_FOLDERS, *PHOTO), _named(root, GRID_FOLDERS, *GRID)
    if alone := sorted(f"{(photos | grids)[name].name} stands alone" for name in photos.keys() ^ grids.keys()):
        more = f" and {len(alone) - 3} more" if len(alone) > 3 else ""
        raise InputError(f"MAKE3D_ROOT {root}: {', '.join(alone[:3])}{more}; unpack both archives of the test set anew")
    return [PhotoGrid(name, photos[name], grids[name]) for name in sorted(photos)]


def _named(root: Path, folders: Sequence[str], before: str, after: str) -> dict[str, Path]:
    """Files `<before><name><after>` by name, of the first of the folders that holds any."""
    for folder in folders:
        files = {path.name.removeprefix(before).removesuffix(after): path for path in (root / folder).glob(f"{before}*{after}")}
        if files:
            return files
    mend = f"give the folder that holds {PHOTO_FOLDERS[0]} and {GRID_FOLDERS[0]}, as data_scripts/download_make3d.py makes it"
    raise InputError(f"MAKE3D_ROOT {root}: holds no {folders[0]}/{before}*{after}; {mend}")


def read_grid(path: str | Path) -> np.ndarray:
    """Distances (55, 305) float64 of a laser grid, the fourth channel of its points: metres along the ray; some 80 m stand for no return.

    Its rows are from the top, over the whole photo. An `InputError` says that it is missing, or no `.mat` file with a `Position3DGrid`
    of shape (55, 305, 4).
    """
    from scipy.io import loadmat

    with reading(path, AGAIN):
        points = loadmat(path, variable_names=[GRID_KEY]).get(GRID_KEY, np.empty(0))
    if points.shape != (*GRID_SHAPE, 4) or points.dtype.kind not in "fiu":
        found = f"{GRID_KEY} is {points.dtype} of shape {points.shape}"
        raise InputError(f"{path}: {found}; give a grid of Make3D's test set, numbers of shape {(*GRID_SHAPE, 4)}")
    return points[..., 3].astype(np.float64)


def read_photo(path: str | Path) -> np.ndarray:
    """Decode a photo to RGB, (H, W, 3) uint8; one that lacks its end keeps its size and is grey where nothing is left. An `InputError` says
    that it is missing, no image, or that more than half of it is lacking."""
    if not is_truncated(path):
        return read_image(path)
    data, photo = np.frombuffer(Path(path).read_bytes() + END_OF_JPEG, np.uint8), None
    with contextlib.suppress(InputError):  # not even the header is left
        check_image(path, data)
        photo = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)
    # the decoder fills with mid-grey what it has no data for
    if photo is None or (photo == 128).all(axis=(1, 2)).mean() > 1 - LEAST_LEFT:
        raise InputError(f"{path}: truncated, less than half of the photo is there ({data.size - 2} bytes); {AGAIN}")
    return photo


def is_truncated(path: str | Path) -> bool:
    """Whether a JPEG lacks its end; False for what is no JPEG, an `InputError` for what cannot be read."""
    with reading(path, AGAIN):
        data = Path(path).read_bytes()
    # the mark of the end never stands within a picture; that of a preview may stand at the file's beginning
    return data[:2] == b"\xff\xd8" and END_OF_JPEG not in data[len(data) // 2 :]
