"""Find or make a profile's data, and prepare them: training triplets, frames to score, their ground truth (notebook 02).

    python data_scripts/prepare_data.py --profile sample --kitti-root DIR

Every frame is decoded once, so that a broken one is known before a training begins.
"""

import argparse
import itertools
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from data_scripts.export_depth import depth_maps
from data_scripts.find_data import find_data
from dualdepth.data.depth_maps import save_ground_truth
from dualdepth.data.kitti import Frame, image_path, read_frame_list, read_image, read_static_frames, read_test_scenes, velodyne_path
from dualdepth.data.label_maps import label_path
from dualdepth.data.lidar import ground_truth
from dualdepth.data.odometry import (
    check_odometry_root,
    frame_files,
    odometry_triplets,
    poses_path,
    sequence_of,
    true_trajectory,
)
from dualdepth.data.triplets import drive_triplets, missing_files_error, missing_neighbours, raw_triplets, write_triplets
from dualdepth.errors import InputError, exit_on_input_error
from dualdepth.files import file_digest, short_digest, write_json
from dualdepth.run import RECORD, ROOTS, Run, Sources, add_roots


class Prepared(NamedTuple):
    """What `prepare` wrote, counted; `baseline` are laser frames of training drives, 0: each scored drive is predicted from the others."""

    triplets: int
    scored: int
    listed: int
    baseline: int
    odometry: int


def prepare(run: Run) -> Prepared:
    """Write `work/<profile>/prepared`: triplets.csv, test_frames.json, ground_truth.npz, from training frames baseline_truth.npz, and
    odometry.csv where odometry is trained.

    Every frame is decoded once. Triplets with a broken one are left out, and all broken frames are named in one message.

    Raises:
        InputError: files are missing (all in one message), a frame to score is broken, a drive is both trained on and scored, or no triplet
            is left.
    """
    sources, data, out = Sources.load(run), run.profile.data, run.prepared
    root, targets = sources.kitti_root, training_targets(run, sources)
    scored, listed = test_frames(run, sources)
    if sources.labels_root and len({label_path(sources.labels_root, frame) for frame in scored}) < len({*scored}):
        raise InputError(f"{sources.test_list}: lists both cameras of a frame, but there is one label map a frame; score one camera")
    unlabelled = [path for frame in scored if sources.labels_root and not (path := label_path(sources.labels_root, frame)).is_file()]
    if unlabelled:
        others = f"nor have {len(unlabelled) - 1} other scored frames; make them with data_scripts/export_labels.py"
        raise InputError(f"{unlabelled[0]}: no label map, {others}")
    check_separate([f.drive for f in targets], [f.drive for f in scored], "drives", sources.allow_leak)
    sequences, scored_sequences = odometry_sequences(run, sources)
    triplets = raw_triplets(root, targets)
    shown = [path for frame in scored if (path := image_path(root, frame))]
    along, followed = ([f for e in some for f in frame_files(sources.odometry_root, e).values()] for some in (sequences, scored_sequences))
    broken = broken_frames([*(path for triplet in triplets for path in triplet.paths), *along], [*shown, *followed])
    named = "; ".join(broken.values())
    if to_score := len(broken.keys() & {*shown, *followed}):
        raise InputError(f"{to_score} frames to score are broken, and {len(broken) - to_score} others: {named}")
    if broken:
        print(f"{len(broken)} frames are broken and left out with their triplets: {named}")
    whole = [(target, triplet) for target, triplet in zip(targets, triplets) if broken.keys().isdisjoint(triplet.paths)]
    if not whole:
        raise InputError(f"{root}: all {len(targets)} triplets have broken frames; copy or download them again")
    kept = [target for target, _ in whole]
    fitted = laser_frames(sources, kept, data.baseline_frames)
    write_triplets(out / "triplets.csv", root, [triplet for _, triplet in whole])
    write_identity(run, sources, kept, [path for _, triplet in whole for path in triplet.paths])
    measured = partial(ground_truth, root)
    unmeasured = (np.zeros(read_image(path).shape[:2], np.float32) for path in shown)  # of an own camera
    save_ground_truth(out / "ground_truth.npz", depth_maps(scored, measured) if data.has_truth else unmeasured)
    for name in ("baseline_truth.npz", "odometry.csv"):  # of an earlier preparation
        (out / name).unlink(missing_ok=True)
    if fitted:
        save_ground_truth(out / "baseline_truth.npz", depth_maps(fitted, measured))
    write_json(out / "test_frames.json", {"listed": listed, "frames": scored, "files": files_digest(shown)})
    odometry = odometry_triplets(sources.odometry_root, sequences, broken)
    if odometry:
        write_triplets(out / "odometry.csv", sources.odometry_root, odometry)
    return Prepared(len(whole), len(scored), listed, len(fitted), len(odometry))


def broken_frames(trained: Sequence[Path], scored: Sequence[Path]) -> dict[Path, str]:
    """Why, of the image files that cannot be used: they cannot be decoded, or, to train on, are of another size than most of their folder.

    Each is decoded once, several at a time.
    """
    paths = list(dict.fromkeys([*trained, *scored]))

    def look(path: Path) -> tuple[int, ...] | str:
        try:
            return read_image(path).shape
        except InputError as error:
            return str(error)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        # a bar in a pipe would break the one-line error; of many frames it is worth it
        bar = tqdm(pool.map(look, paths), "decoding", len(paths), unit="frame", disable=None if len(paths) < 2000 else False)
        found = dict(zip(paths, bar))
    broken = {path: why for path, why in found.items() if isinstance(why, str)}
    for _, folder in itertools.groupby(sorted(set(trained) - broken.keys()), key=lambda path: path.parent):
        sizes = {path: found[path] for path in folder}
        usual = Counter(sizes.values()).most_common(1)[0][0]
        words = f"pixels, most of its folder {usual[1]}×{usual[0]}; put one camera's frames in a folder"
        broken |= {path: f"{path}: has {size[1]}×{size[0]} {words}" for path, size in sizes.items() if size != usual}
    return broken


def training_targets(run: Run, sources: Sources) -> list[Frame]:
    """Targets of the training triplets: a field's list unchanged, or the drives of the profile.

    Raises:
        InputError: frames are missing (all in one message), a training drive is a test drive, or nothing is left.
    """
    data, root = run.profile.data, sources.kitti_root
    if not sources.train_list:
        static = read_static_frames(sources.static_frames) if sources.static_frames else set()
        scenes = read_test_scenes(sources.test_scenes) if sources.test_scenes else set()
        return drive_triplets(root, data.train_drives or sources.train_drives, data.cameras, static, scenes)
    targets = read_frame_list(sources.train_list)
    if missing := missing_neighbours(root, targets):
        raise missing_files_error("to train on", root, [(frame, frame.camera) for frame in missing])
    return targets


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
        raise missing_files_error("to score (`allow_missing: true` in the profile's `data` scores the rest)", root, missing)
    return [f for f in listed if f not in gone], len(listed)


def laser_frames(sources: Sources, targets: Sequence[Frame], most: int) -> list[Frame]:
    """Up to `most` training-side left frames that have a laser scan, evenly spread, to fit the baselines without learning on."""
    scanned = [f for f in targets if f.camera == "image_02" and velodyne_path(sources.kitti_root, f).is_file()]
    chosen = np.unique(np.linspace(0, len(scanned) - 1, min(most, len(scanned))).round().astype(int))
    return [scanned[i] for i in chosen]


def files_digest(paths: Sequence[Path]) -> str:
    """Of image files' names and sizes, which tell another folder's images or another compression."""
    return short_digest(*(f"{path.name} {path.stat().st_size}" for path in dict.fromkeys(paths)))


def write_identity(run: Run, sources: Sources, targets: Sequence[Frame], images: Sequence[Path]) -> None:
    """Write `prepared/identity.json`: which world or calibrations, and which images, the triplets are of; their names alone do not tell."""
    root = sources.kitti_root
    days = [root / date / "calib_cam_to_cam.txt" for date in sorted({f.date for f in targets})]
    files = [root.parent / "world.json"] if run.profile.world else days
    facts = {file.parent.name: file_digest(file) for file in files} | {"images": files_digest(images)}
    facts |= {} if run.profile.data.has_truth else {RECORD: file_digest(root / RECORD)}
    write_json(run.prepared / "identity.json", facts)


def odometry_sequences(run: Run, sources: Sources) -> tuple[list[str], list[str]]:
    """Odometry sequences to train on and to score; none where there are no such variants or frames.

    Raises:
        InputError: a sequence to train on or to score is not there, or is both, or one to score has a gap or too few true poses.
    """
    used = run.profile.trained_on("odometry") or (not run.profile.world and set(run.profile.pose_variants) & set(run.profile.train))
    if sources.odometry_root is None or not used:
        return [], []
    root, (train, test) = check_odometry_root(sources.odometry_root), run.profile.odometry_sequences()
    for entry in test:
        frame_files(root, entry, whole=True)
        if not (path := poses_path(root, entry)).is_file():
            raise InputError(f"{path}: the true poses of sequence {entry}, which is to be scored, are missing; download them first")
        true_trajectory(root, entry)
    check_separate([sequence_of(e)[0] for e in train], [sequence_of(e)[0] for e in test], "sequences", sources.allow_leak)
    return train, test


def check_separate(train: Iterable[str], test: Iterable[str], what: str, allow_leak: bool) -> None:
    """Refuse to score drives or sequences that are trained on, unless it is allowed.

    Raises:
        InputError: naming them.
    """
    shared = sorted(set(train) & set(test))
    if shared and not allow_leak:
        mend = "take them out of one, or give --allow-leak (make reproduce ALLOW_LEAK=1), which marks the results"
        raise InputError(f"{what} {', '.join(shared)} are both trained on and scored: {mend}")


def main(argv: list[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Find or make a profile's data and prepare them.")
    parser.add_argument("--profile", default="miniature", help="such as tiny or paper, or a YAML file (default: %(default)s)")
    add_roots(parser)
    with exit_on_input_error():
        arguments = parser.parse_args(argv)
        run = Run(arguments.profile)
        find_data(run, **{name: getattr(arguments, name) for name in (*ROOTS, "allow_leak")})
        done = prepare(run)
        print(f"{run.prepared}: {done.triplets} triplets, {done.scored} of {done.listed} frames to score")


if __name__ == "__main__":
    main()
