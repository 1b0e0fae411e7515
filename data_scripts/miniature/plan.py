"""What the world consists of: every drive, sequence and photo of the settings, as shots to render and texts to write."""

import collections
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from data_scripts.miniature import formats
from data_scripts.miniature.drives import CAMERA_HEIGHT, PERIOD, Drive, camera_pose, drive
from data_scripts.miniature.render import Shot
from data_scripts.miniature.street import Plan, build_street
from dualdepth.settings import World

RAW, ODOMETRY, MAKE3D = range(3)
"""Kinds of streets: part of their seeds, so that no two share a street."""
FIRST_TEST_DRIVE = 101
FIRST_TEST_SEQUENCE = 9
BEND, ODOMETRY_BEND = (0.45, 180.0), (0.85, 210.0)
"""How much a street winds, in radians, and the length of a full left-right bend, in metres: of scored drives, of odometry sequences."""
TRAIN_BENDS = (0.2, 90.0), (0.5, 90.0)
"""The same of training drives, in turns. They are short: with longer bends each would show one turn alone."""


@dataclass
class Work:
    """All that has to be done below one folder."""

    root: Path
    shots: list[Shot] = field(default_factory=list)
    texts: dict[str, str] = field(default_factory=dict)
    """Content by path below `root`."""
    lists: dict[str, list[str]] = field(default_factory=lambda: collections.defaultdict(list))
    """Lines by the names of the lists in `lists/`, in the field's formats."""


def plan_world(world: World, root: Path) -> Work:
    """List all shots and texts of a world that is written below `root`."""
    work = Work(root)
    for name, text in formats.calibration_texts(world.size).items():
        work.texts[f"kitti_raw/{formats.DATE}/{name}"] = text
    for number in range(world.train_drives):
        _train_drive(world, work, number)
    for number in range(world.test_drives):
        _test_drive(world, work, number)
    for number in range(world.odometry_train):
        _sequence(world, work, f"{number:02d}", (world.train_seed, ODOMETRY, number), frames=world.odometry_frames)
    for number in range(world.odometry_test):
        _sequence(world, work, f"{FIRST_TEST_SEQUENCE + number:02d}", (world.test_seed, ODOMETRY, number), path=world.odometry_path)
    _photos(world, work)
    for name, lines in work.lists.items():
        work.texts[f"lists/{name}.txt"] = "".join(f"{line}\n" for line in lines)
    return work


def _drive_shots(
    world: World,
    work: Work,
    name: str,
    seed: tuple[int, ...],
    numbers: Sequence[int],
    scanned: Collection[int],
    bend: tuple[float, float] = BEND,
    still: tuple[int, int] = (0, 0),
) -> tuple[Drive, list[Shot]]:
    """A drive, and shots of the frames with these `numbers`, those `scanned` with a laser scan."""
    frames = numbers[-1] + 1
    plan = Plan(seed, 1.3 * frames * world.frame_spacing + 10, *bend, pace=world.frame_spacing / PERIOD)
    ride = drive(plan, build_street(plan), world.frame_spacing, frames, still=still)
    view, shots = (formats.intrinsics(world.size), world.size, world.supersample), []
    for k in numbers:
        image, scan = (work.root / "kitti_raw" / formats.DATE / name / f"{kind}/data/{k:010d}" for kind in ("image_02", "velodyne_points"))
        shot = Shot(plan, ride.poses[k], ride.times[k], *view, image.with_suffix(".png"), azimuth_step=world.azimuth_step)
        shots.append(shot._replace(scan=scan.with_suffix(".bin") if k in scanned else None))
    return ride, shots


def _train_drive(world: World, work: Work, number: int) -> None:
    """Consecutive frames, a few with a laser scan; in the first drive the camera stands still for a while."""
    day, frames = formats.DATE, world.frames_per_drive
    name = f"{day}_drive_{number + 1:04d}_sync"
    still = (max(0, frames // 2 - world.static_frames // 2), world.static_frames) if number == 0 else (0, 0)
    scanned = set(np.linspace(0, frames - 1, world.laser_train_frames + 2)[1:-1].astype(int).tolist())
    ride, shots = _drive_shots(world, work, name, (world.train_seed, RAW, number), range(frames), scanned, TRAIN_BENDS[number % 2], still)
    work.shots += shots
    work.lists["train_drives"].append(f"{day}/{name}")
    work.lists["static_frames"] += [f"{day} {name} {k:010d}" for k in np.flatnonzero(ride.standing)]


def _test_drive(world: World, work: Work, number: int) -> None:
    """Scored frames in a street of their own, each with scan, exact depth and labels."""
    day = formats.DATE
    name = f"{day}_drive_{FIRST_TEST_DRIVE + number:04d}_sync"
    frames = [k * world.test_step for k in range(world.test_frames)]
    for k, shot in zip(frames, _drive_shots(world, work, name, (world.test_seed, RAW, number), frames, frames)[1]):
        depth, labels = work.root / "dense_depth" / name / f"{k:010d}.npy", work.root / "labels" / name / f"{k:010d}.png"
        work.shots.append(shot._replace(depth=depth, labels=labels))
    work.lists["test_scenes"].append(name.removesuffix("_sync"))
    work.lists["test_files"] += [f"{day}/{name} {k:010d} l" for k in frames]


def _sequence(world: World, work: Work, name: str, seed: tuple[int, ...], frames: int = 0, path: float = 0.0) -> None:
    """An odometry sequence on a winding road, of a number of frames or longer than a path in metres."""
    length = 1.15 * path + 20 if path else 1.3 * frames * world.odometry_spacing + 10
    plan = Plan(seed, length, *ODOMETRY_BEND, movers=1)
    ride = drive(plan, build_street(plan), world.odometry_spacing, frames, path)
    folder = f"kitti_odometry/sequences/{name}"
    matrix = formats.intrinsics(world.size)
    for k, (pose, time) in enumerate(zip(ride.poses, ride.times)):
        image = work.root / folder / "image_2" / f"{k:06d}.png"
        work.shots.append(Shot(plan, pose, time, matrix, world.size, world.supersample, image))
    work.texts[f"{folder}/calib.txt"] = formats.odometry_calibration_text(world.size)
    work.texts[f"kitti_odometry/poses/{name}.txt"] = formats.poses_text(ride.poses)


def _photos(world: World, work: Work) -> None:
    """Upright photos from the sidewalk of one more street, looking here and there."""
    plan = Plan((world.test_seed, MAKE3D), length=20.0 * world.make3d_images, movers=1)
    street, rng = build_street(plan), np.random.default_rng((world.test_seed, MAKE3D, 2))
    height, width = world.make3d_size
    matrix = np.array([[1.2 * width, 0, (width - 1) / 2], [0, 1.2 * width, (height - 1) / 2], [0, 0, 1]])
    for k in range(world.make3d_images):
        angles = (rng.uniform(-0.5, 0.5), rng.uniform(-0.05, 0.1), rng.uniform(-0.02, 0.02))
        pose = camera_pose(street, 20.0 * k, rng.uniform(-3, 7), CAMERA_HEIGHT - rng.uniform(0, 0.2), angles)
        name = f"mini-p-{k:03d}t000"
        photo, grid = work.root / "make3d/Test134" / f"img-{name}.jpg", work.root / "make3d/Gridlaserdata" / f"depth_sph_corr-{name}.mat"
        work.shots.append(Shot(plan, pose, 0.0, matrix, world.make3d_size, world.supersample, photo, grid=grid))
