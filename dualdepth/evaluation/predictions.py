"""Prediction files as the field saves them: one `.npy` with all images."""

from pathlib import Path

import numpy as np

from dualdepth.errors import InputError


def load_predictions(path: str | Path) -> np.ndarray:
    """Open a file of predictions without reading it into memory and without pickle.

    Returns:
        (N, h, w) float array, mapped from the file.

    Raises:
        InputError: missing, truncated, no `.npy`, or not a float array of three dimensions with at least one image.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a .npy file with an (N, h, w) float array")
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # of numpy, tokenize and zipfile: ten kinds and more
        raise InputError(f"{path}: not a readable .npy file, or truncated ({error}); write it with numpy.save") from None
    if not isinstance(values, np.ndarray):
        raise InputError(f"{path}: an archive of arrays; give a .npy file with one (N, h, w) float array")
    if values.dtype.kind != "f":
        raise InputError(f"{path}: holds {values.dtype} values; predictions must be floats")
    if values.ndim != 3 or 0 in values.shape:
        raise InputError(f"{path}: has shape {values.shape}; expected (N, h, w), one map for each image")
    return values
