"""Files of ground-truth depth: our npz, one plain float32 array per image, and the field's pickled one.

Maps are written and read one by one, so that the 697 of the Eigen split need not be in memory together.
"""

import itertools
import re
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from dualdepth.errors import InputError, reading
from dualdepth.files import atomic_path

MEND = "write it with data_scripts/export_depth.py"
LARGEST = 4 * 10**9
"""Bytes that an array may unpack to: a map of the Eigen split takes 1.9 million, all 697 in one array 1.3 thousand million."""


def save_ground_truth(path: str | Path, maps: Iterable[np.ndarray], names: Iterable[str] | None = None, listed: int = 0) -> int:
    """Write depth maps (H, W) in metres, 0 for none, of any sizes, to a compressed npz, atomically and without pickle; gives their number.

    The keys are `names`, else the maps' numbers as `%06d`; the same maps and names give the same bytes. `listed` is the number of frames of
    the list in which the keys are places, 0 where there is none. An `InputError` says that the file cannot be written.
    """
    path, keys = Path(path), names or map("{:06d}".format, itertools.count())
    try:
        with atomic_path(path) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
            for key, depth in zip(keys, maps, strict=bool(names)):
                with archive.open(f"{key}.npy", "w", force_zip64=True) as file:  # of 1980, whatever the time
                    np.lib.format.write_array(file, np.ascontiguousarray(depth, np.float32), allow_pickle=False)
            archive.comment = str(listed or "").encode()
            return len(archive.namelist())
    except OSError as error:
        raise InputError(f"{path}: cannot write the ground truth ({error.strerror})") from None


class DepthMaps(Sequence):
    """Depth maps of a ground-truth file in their order, each read when it is asked for.

    `maps[i]` is (H, W) float in metres; `maps.names` holds the keys, `maps.listed` the frames of their list, 0 where that is not known.
    """

    def __init__(self, path: Path, archive: "np.lib.npyio.NpzFile") -> None:
        self.path, self.names, self._archive = path, list(archive.files), archive
        self.listed = int(archive.zip.comment[:9]) if archive.zip.comment.isdigit() else 0
        self._stacked, announced = None, max(info.file_size for info in archive.zip.infolist())
        if announced > LARGEST:
            raise InputError(f"{path}: refused, since it unpacks to {announced / 1e9:.1f} GB; {MEND}")
        if len(self.names) == 1:  # all maps under one key, the field's or, of numpy.savez, arr_0
            values = self._member(self.names[0])
            if values.ndim == 4:
                values = values[:, 0] if values.shape[1] == 1 else values[..., 0] if values.shape[3] == 1 else values
            if values.dtype == object or values.ndim == 3:
                self._stacked, self.names = values, [f"{number:06d}" for number in range(len(values))]

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> np.ndarray:
        name = self.names[index]
        depth = self._member(name) if self._stacked is None else np.asarray(self._stacked[index])
        if depth.ndim != 2 or not depth.size or depth.dtype.kind != "f":
            raise InputError(f"{self.path}: {name} is {depth.dtype} of shape {depth.shape}; expected a float array (height, width)")
        return depth

    def _member(self, name: str) -> np.ndarray:
        with reading(f"{self.path}: {name}", f"{MEND}; of a pickled file whose source you trust pass --allow-pickle"):
            return np.asarray(self._archive[name])  # of a member that is no array, its bytes


def load_ground_truth(path: str | Path, *, allow_pickle: bool = False) -> DepthMaps:
    """Open a file of depth maps: an npz with one float array per image, or the field's `gt_depths.npz` with all of them under `data`.

    `allow_pickle` also reads pickled object arrays, which the field's file is. A pickle can run any code, so say so only for files from a
    source you trust. An `InputError` says that the file is missing, truncated, no npz, empty, or pickled without `allow_pickle`.
    """
    path = Path(path)
    with reading(path, MEND):
        archive = np.load(path, allow_pickle=allow_pickle, encoding="latin1")
    if not getattr(archive, "files", None):
        raise InputError(f"{path}: not an npz file with depth maps; {MEND}")
    return DepthMaps(path, archive)


def places_of(truths: DepthMaps, frames: int = 0, source: str | None = None) -> list[int]:
    """Places, in their list, of the images that have ground truth; the list, where one is given, is of so many frames and named `source`.

    They are the keys, if all are numbers; else, and for a list that has as many frames as there are maps (and lacks the others), 0, 1, 2, …
    An `InputError` says that the list cannot be the one that the file was made from, by its length, nor one of the maps alone.
    """
    keys, held = [int(name) for name in truths.names if re.fullmatch("[0-9]{1,9}", name)], len(truths)
    places = keys if len(keys) == held != frames else [*range(held)]
    if 0 < frames <= max(places, default=-1) or (frames and truths.listed and frames not in (held, truths.listed)):
        raise InputError(f"{source}: lists {frames} frames but {truths.path} holds {held}; give the list it was made from")
    return places


def at_places(predictions: Sequence[np.ndarray], places: list[int], listed: int) -> Sequence[np.ndarray]:
    """Predictions at the places if they are for the whole list, else as they are; whether they are as many, `evaluate` looks.

    They are for the whole list if they are not as many as the places, reach to the last one, and are as many as `listed` frames; where
    nobody knows these (0), if the last place lies beyond the number of places.
    """
    held, last, count = len(places), max(places, default=-1), len(predictions)
    whole = held != count > last and (count == listed or (last >= held and not listed))
    return [predictions[place] for place in places] if whole else predictions
