"""Find or make a profile's data, and prepare them: training triplets, frames to score, their ground truth.

python data_scripts/prepare_data.py --profile sample --kitti-root DIR
"""

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

from data_scripts import download_kitti, export_depth, make_miniature
from dualdepth.atomic import write_json, write_text
from dualdepth.commands.reproduce import ROOTS, add_roots
from dualdepth.data import own
from dualdepth.data.kitti import CAMERA_OF_SIDE, Frame, check_root, numbered_lines, read_frame_list
from dualdepth.data.sources import drive_archives, named_list
from dualdepth.errors import InputError, exit_on_input_error
from dualdepth.preparation import (
    FOLDERS,
    Sources,
    check_labels,
    check_separate,
    laser_frames,
    test_frames,
    training_targets,
    write_identity,
    write_no_truth,
    write_odometry,
    write_training_index,
)
from dualdepth.results import Run

MOST_SQUEEZED = 1.3
"""Factor by which a profile may change the frames' shape; intrinsics follow, but what is seen looks strange to a network beyond it."""


class Prepared(NamedTuple):
    """What `prepare` wrote, counted."""

    triplets: int
    scored: int
    listed: int
    baseline: int
    """Training-side laser frames for the baselines; 0: each scored drive is predicted from the others."""
    odometry: int = 0
    """Triplets of odometry sequences."""


def find_data(
    run: Run,
    kitti_root: str = "",
    test_list: str = "",
    odometry_root: str = "",
    make3d_root: str = "",
    labels_root: str = "",
    allow_leak: bool = False,
) -> Sources:
    """Make the synthetic world, or take the user's KITTI, or download what the profile needs; remember where it is.

    The other benchmarks' folders are taken where they are given; without one its table says how to get it.

    Raises:
        InputError: a folder is not what it should be, or a list or download cannot be had.
    """
    others = {"odometry_root": odometry_root, "make3d_root": make3d_root, "labels_root": labels_root}
    if run.profile.world:
        given = [name.upper() for name, value in {"kitti_root": kitti_root, "test_list": test_list, **others}.items() if value]
        if given:
            raise InputError(f"profile {run.profile.name} makes its own data: {' and '.join(given)} belong to sample, paper or your own")
        root = run.work / "miniature"
        make_miniature.make_world(run.profile.world, root)
        sources = world_sources(root)
    else:
        sources = kitti_sources(run, kitti_root, test_list) if run.profile.data.has_truth else own_sources(run, kitti_root, test_list)
        for name, check in FOLDERS.items():
            if others[name]:
                check(others[name])
        sources = sources._replace(**{name: Path(value).resolve() if value else None for name, value in others.items()})
    sources = sources._replace(allow_leak=allow_leak)
    sources.save(run)
    return sources


def world_sources(root: Path) -> Sources:
    """Sources of a synthetic world."""
    lists = root / "lists"
    drives = tuple((lists / "train_drives.txt").read_text(encoding="utf-8").split())
    return Sources(
        kitti_root=root / "kitti_raw",
        test_list=lists / "test_files.txt",
        train_drives=drives,
        static_frames=lists / "static_frames.txt",
        test_scenes=lists / "test_scenes.txt",
        odometry_root=root / "kitti_odometry",
        make3d_root=root / "make3d",
        labels_root=root / "labels",
    )


def own_sources(run: Run, root: str, test_list: str) -> Sources:
    """Sources of a data set that data_scripts/own_camera.py made.

    Raises:
        InputError: `root` is no such data set, or its frames are of quite another shape than the profile's hr_size.
    """
    make = "python data_scripts/own_camera.py VIDEO --out DIR makes one"
    if not root:
        raise InputError(f"profile {run.profile.name} trains on a data set of your own camera: give KITTI_ROOT=DIR; {make}")
    record, data = own.read_record(root), run.profile.data
    if record is None:
        raise InputError(f"KITTI_ROOT {root}: holds no {own.RECORD}, so it is no data set of your own camera; {make}")
    camera, (height, width) = record["camera"], data.hr_size
    squeezed = camera["width"] / camera["height"] * height / width
    if not 1 / MOST_SQUEEZED < squeezed < MOST_SQUEEZED:
        raise InputError(
            f"profile {run.profile.name}: hr_size {height}x{width} squeezes frames of {camera['width']}×{camera['height']}; give"
            f" PROFILE={next(iter(sorted(Path(root).glob('*.yaml'))), 'own.yaml')}, which was written for them, or another hr_size"
        )
    lists = Path(root).resolve() / "lists"
    drives = [line for _, line in numbered_lines(lists / "train_drives.txt")]
    return Sources(
        kitti_root=check_root(root).resolve(),
        test_list=Path(test_list).resolve() if test_list else lists / "test_files.txt",
        train_drives=tuple(drives),
    )


def kitti_sources(run: Run, kitti_root: str, test_list: str) -> Sources:
    """Sources of real KITTI; without `kitti_root` the profile's drives are downloaded to `work/kitti`."""
    data, home = run.profile.data, run.root / "work" / "kitti"

    def listed(name: str | None) -> Path | None:
        return named_list(name, home / "lists") if name else None

    if not (test_list or data.test_list):
        raise InputError(f"profile {run.profile.name} names no frames to score: give data.test_list or TEST_LIST")
    own = Path(test_list or data.test_list)
    scored = own if test_list or own.is_file() else named_list(data.test_list, home / "lists")
    train_list = listed(f"{data.train_list}_train" if data.train_list else None)
    if not kitti_root:
        needed = {frame.drive for path in (scored, train_list) if path for frame in read_frame_list(path)}
        needed |= {drive.partition(":")[0] for drive in data.train_drives}
        cameras = {"image_02", "image_03", *data.cameras, *(d.partition(":")[2] for d in data.train_drives if ":" in d)}
        download_kitti.download(drive_archives(sorted(needed)), home, cameras=sorted(cameras))
    return Sources(
        kitti_root=check_root(kitti_root or home).resolve(),
        test_list=scored.resolve(),
        train_list=train_list,
        static_frames=listed(data.static_frames),
        test_scenes=listed(data.test_scenes),
    )


def prepare(run: Run) -> Prepared:
    """Write `work/<profile>/prepared`: triplets.csv, test_frames.json, ground_truth.npz, from training frames baseline_truth.npz, and
    odometry.csv where odometry is trained.

    Raises:
        InputError: files are missing (all in one message), or a drive is both trained on and scored.
    """
    sources = Sources.load(run)
    targets = training_targets(run, sources)
    scored, listed = test_frames(run, sources)
    check_labels(sources, scored)
    check_separate({f.drive for f in targets}, {f.drive for f in scored}, "drives", sources.allow_leak)
    fitted = laser_frames(sources, targets, run.profile.data.baseline_frames)
    write_training_index(run, sources, targets)
    write_identity(run, sources, targets)
    if run.profile.data.has_truth:
        _export(run, sources, scored, "ground_truth.npz")
    else:
        write_no_truth(run, sources, scored)
    (run.prepared / "baseline_truth.npz").unlink(missing_ok=True)
    if fitted:
        _export(run, sources, fitted, "baseline_truth.npz")
    write_json(run.prepared / "test_frames.json", {"listed": listed, "frames": [list(frame) for frame in scored]})
    return Prepared(len(targets), len(scored), listed, len(fitted), write_odometry(run, sources))


def _export(run: Run, sources: Sources, frames: list[Frame], name: str) -> None:
    sides = {camera: side for side, camera in CAMERA_OF_SIDE.items()}
    frame_list = run.prepared / Path(name).with_suffix(".txt")
    write_text(frame_list, "".join(f"{f.drive} {f.index:010d} {sides[f.camera]}\n" for f in frames))
    export_depth.export(sources.kitti_root, frame_list, run.prepared / name, camera_z=False, improved=None, allow_missing=False)


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Find or make a profile's data and prepare them.")
    parser.add_argument("--profile", default="tiny", help="tiny, miniature, sample, paper, own, or a YAML file (default: %(default)s)")
    add_roots(parser)
    arguments = parser.parse_args(argv)
    with exit_on_input_error():
        run = Run(arguments.profile)
        find_data(run, **{name: getattr(arguments, name) for name in (*ROOTS, "allow_leak")})
        done = prepare(run)
        print(f"{run.prepared}: {done.triplets} triplets, {done.scored} of {done.listed} frames to score")
    return 0


if __name__ == "__main__":
    sys.exit(main())
