"""From the profile to prepared data: where the frames are, which are trained on, which are scored."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import TypeAdapter, ValidationError

from dualdepth.atomic import write_json
from dualdepth.data.depth_maps import save_ground_truth
from dualdepth.data.kitti import (
    Frame,
    check_root,
    image_path,
    read_frame_list,
    read_image,
    read_static_frames,
    read_test_scenes,
    velodyne_path,
)
from dualdepth.data.label_maps import label_path
from dualdepth.data.make3d import find_pairs
from dualdepth.data.odometry import check_odometry_root, frame_files, poses_path, sequence_of, write_odometry_index
from dualdepth.data.own import RECORD
from dualdepth.data.triplets import drive_triplets, missing_neighbours, name_missing, write_targets
from dualdepth.errors import InputError, first_mistake
from dualdepth.results import Run, file_digest


class Sources(NamedTuple):
    """Roots and lists of a run; lists that a profile does not use are None."""

    kitti_root: Path
    test_list: Path
    train_list: Path | None = None
    train_drives: tuple[str, ...] = ()
    """Training drives where the profile names none: those of the synthetic world."""
    static_frames: Path | None = None
    test_scenes: Path | None = None
    odometry_root: Path | None = None
    """Holds `sequences` and `poses`; None: no odometry here."""
    make3d_root: Path | None = None
    """Holds `Test134` and `Gridlaserdata`; None: no Make3D here."""
    labels_root: Path | None = None
    """Holds `<drive>/<frame>.png`, Cityscapes training ids of the scored frames; None: no labels here."""
    allow_leak: bool = False
    """Score even what was trained on, and say so."""

    def save(self, run: Run) -> None:
        """Write `work/<profile>/sources.json`."""
        write_json(run.sources, {k: str(v) if isinstance(v, Path) else v for k, v in self._asdict().items()})

    @classmethod
    def load(cls, run: Run) -> "Sources":
        """Read what notebook 01 wrote.

        Raises:
            InputError: it is not there, or is something else.
        """
        path = run.require(run.sources, "01_download_data")
        try:
            return _SAVED_SOURCES.validate_json(path.read_bytes())
        except ValidationError as error:
            raise InputError(f"{path}: {first_mistake(error)}; run notebook 01_download_data again") from None


_SAVED_SOURCES = TypeAdapter(Sources)


def training_targets(run: Run, sources: Sources) -> list[Frame]:
    """Targets of the training triplets: a field's list unchanged, or the drives of the profile.

    Raises:
        InputError: frames are missing (all in one message), a training drive is a test drive, or nothing is left.
    """
    data, root = run.profile.data, check_root(sources.kitti_root)
    static = read_static_frames(sources.static_frames) if sources.static_frames else set()
    scenes = read_test_scenes(sources.test_scenes) if sources.test_scenes else set()
    if sources.train_list:
        targets = read_frame_list(sources.train_list)
        missing = missing_neighbours(root, targets)
        if missing:
            raise name_missing("to train on", root, [(frame, frame.camera) for frame in missing])
        return targets
    return drive_triplets(root, data.train_drives or sources.train_drives, data.cameras, static, scenes)


def test_frames(run: Run, sources: Sources) -> tuple[list[Frame], int]:
    """Frames to score, those with image and laser scan, and how many the list names; of an own camera frames to show.

    Raises:
        InputError: frames of the list are missing and the profile does not allow it, or all are.
    """
    listed = read_frame_list(sources.test_list)
    root = sources.kitti_root
    missing = [(f, f.camera) for f in listed if image_path(root, f) is None]
    if run.profile.data.has_truth:
        missing += [(f, "velodyne_points") for f in listed if not velodyne_path(root, f).is_file()]
    gone = {frame for frame, _ in missing}
    if missing and (not run.profile.data.allow_missing or len(gone) == len(set(listed))):
        raise name_missing("to score (`allow_missing: true` in the profile's `data` scores the rest)", root, missing)
    return [f for f in listed if f not in gone], len(listed)


def write_training_index(run: Run, sources: Sources, targets: Sequence[Frame]) -> Path:
    """Write `prepared/triplets.csv`."""
    path = run.prepared / "triplets.csv"
    write_targets(path, sources.kitti_root, targets)
    return path


def laser_frames(sources: Sources, targets: Sequence[Frame], most: int) -> list[Frame]:
    """Up to `most` training-side left frames that have a laser scan, evenly spread, to fit the baselines without learning on."""
    scanned = [f for f in targets if f.camera == "image_02" and velodyne_path(sources.kitti_root, f).is_file()]
    chosen = np.unique(np.linspace(0, len(scanned) - 1, min(most, len(scanned))).round().astype(int))
    return [scanned[i] for i in chosen]


def write_identity(run: Run, sources: Sources, targets: Sequence[Frame]) -> Path:
    """Write `prepared/identity.json`: which world or which calibrations the triplets are of, since their names alone do not tell."""
    root, world = sources.kitti_root, sources.kitti_root.parent / "world.json"
    files = [world] if run.profile.world else [root / date / "calib_cam_to_cam.txt" for date in sorted({f.date for f in targets})]
    path = run.prepared / "identity.json"
    own = {} if run.profile.data.has_truth else {RECORD: file_digest(root / RECORD)}
    write_json(path, {file.parent.name: file_digest(file) for file in files} | own)
    return path


def write_no_truth(run: Run, sources: Sources, scored: Sequence[Frame]) -> None:
    """Write `prepared/ground_truth.npz` of an own camera: maps of the frames' sizes without a measurement (0) in them."""
    images = [path for frame in scored if (path := image_path(sources.kitti_root, frame))]
    save_ground_truth(run.prepared / "ground_truth.npz", (np.zeros(read_image(path).shape[:2], np.float32) for path in images))


def write_odometry(run: Run, sources: Sources) -> int:
    """Write `prepared/odometry.csv` with the odometry variants' triplets and return their number; nothing where there are no such.

    Raises:
        InputError: a sequence to train on or to score is not there, or is both.
    """
    path = run.prepared / "odometry.csv"
    path.unlink(missing_ok=True)
    if sources.odometry_root is None or not run.profile.trained_on("odometry"):
        return 0
    root, (train, test) = check_odometry_root(sources.odometry_root), run.profile.odometry_sequences()
    for entry in test:
        frame_files(root, entry)
        if not (path_of := poses_path(root, entry)).is_file():
            raise InputError(f"{path_of}: the true poses of sequence {entry}, which is to be scored, are missing; download them first")
    check_separate([sequence_of(e)[0] for e in train], [sequence_of(e)[0] for e in test], "sequences", sources.allow_leak)
    return write_odometry_index(path, root, train)


def check_labels_root(root: str | Path) -> Path:
    """The folder of label maps, checked to hold some.

    Raises:
        InputError: it is missing or empty.
    """
    if not any(Path(root).glob("*/*.png")):
        raise InputError(f"LABELS_ROOT {root}: holds no <drive>/<frame>.png; make the maps with python data_scripts/export_labels.py")
    return Path(root)


FOLDERS = {"odometry_root": check_odometry_root, "make3d_root": find_pairs, "labels_root": check_labels_root}
"""What tells at once that a folder of another benchmark is not what it should be."""


def check_labels(sources: Sources, scored: Sequence[Frame]) -> None:
    """Make sure that every scored frame has a label map, where there are label maps.

    Raises:
        InputError: some have none; the first is named.
    """
    root = sources.labels_root
    missing = [path for frame in scored if root and not (path := label_path(root, frame)).is_file()]
    if missing:
        raise InputError(
            f"{missing[0]}: no label map, nor have {len(missing) - 1} other scored frames; make them with data_scripts/export_labels.py"
        )


def check_separate(train: Iterable[str], test: Iterable[str], what: str, allow_leak: bool) -> None:
    """Refuse to score drives or sequences that are trained on, unless it is allowed.

    Raises:
        InputError: naming them.
    """
    shared = sorted(set(train) & set(test))
    if shared and not allow_leak:
        raise InputError(
            f"{what} {', '.join(shared)} are both trained on and scored: take them out of the training or of the test list,"
            " or give --allow-leak (make reproduce ALLOW_LEAK=1), which marks the results"
        )
