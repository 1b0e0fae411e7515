"""What the world consists of: every drive, sequence and photo of the settings, as shots to render and texts to write."""

import collections
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from data_scripts.miniature import formats
from data_scripts.miniature.drives import CAMERA_HEIGHT, PERIOD, Drive, camera_pose, drive
from data_scripts.miniature.render import Shot
from data_scripts.miniature.street import Plan, build_street
from dualdepth.settings import World

RAW, ODOMETRY, MAKE3D = range(3)  # Kinds of streets: part of their seeds, so that no two share a street.
FIRST_TEST_DRIVE = 101
SPACING = 1.05  # Mean metres between raw frames, as KITTI at 40 km/h.
TEST_STEP = 5  # Frames between scored frames, as far apart as in the field's list.
FIRST_TEST_SEQUENCE = 9
BEND, ODOMETRY_BEND = (0.45, 180.0), (0.85, 210.0)
"""How much a street winds, in radians, and the length of a full left-right bend, in metres: of scored drives, of odometry sequences."""
TRAIN_BENDS = (0.2, 90.0), (0.5, 90.0)
"""The same of training drives, in turns. They are short: with longer bends each would show one turn alone."""


@dataclass
class Work:
    """All that has to be done below one folder."""

    world: World
    root: Path
    shots: list[Shot] = field(default_factory=list)
    texts: dict[str, str] = field(default_factory=dict)  # Content by path below `root`.
    lists: dict[str, list[str]] = field(default_factory=lambda: collections.defaultdict(list))
    """Lines by the names of the lists in `lists/`, in the field's formats."""

    def shoot(self, ride: Drive, k: int, image: str, **files: Path | None) -> None:
        """Add frame `k` of a drive, seen by the rig's camera: its image, a path below `root`, and other files of it."""
        view = (formats.intrinsics(self.world.size), self.world.size, self.world.supersample)
        shot = Shot(ride.plan, ride.poses[k], ride.times[k], *view, self.root / image, azimuth_step=self.world.azimuth_step)
        self.shots.append(shot._replace(**files))


def plan_world(world: World, root: Path, step: int = TEST_STEP) -> Work:
    """List all shots and texts of a world that is written below `root`; each `step`-th frame of a test drive is scored."""
    work = Work(world, root)
    for name, text in formats.calibration_texts(world.size).items():
        work.texts[f"kitti_raw/{formats.DATE}/{name}"] = text
    for number in range(world.train_drives):
        _train_drive(work, number)
    for number in range(world.test_drives):
        _test_drive(work, number, step)
    for number in range(world.odometry_train):
        _sequence(work, f"{number:02d}", (world.train_seed, ODOMETRY, number), frames=world.odometry_frames)
    for number in range(world.odometry_test):
        _sequence(work, f"{FIRST_TEST_SEQUENCE + number:02d}", (world.test_seed, ODOMETRY, number), path=world.odometry_path)
    _photos(work)
    for name, lines in work.lists.items():
        work.texts[f"lists/{name}.txt"] = "".join(f"{line}\n" for line in lines)
    return work


def _raw_drive(seed: tuple[int, ...], frames: int, bend: tuple[float, float], still: tuple[int, int] = (0, 0)) -> Drive:
    """A drive of KITTI raw, of as many frames, with a stretch of `still` ones."""
    plan = Plan(seed, 1.3 * frames * SPACING + 10, *bend, pace=SPACING / PERIOD)
    return drive(plan, build_street(plan), SPACING, frames, still=still)


def _train_drive(work: Work, number: int) -> None:
    """Consecutive frames, a few with a laser scan; in the first drive the camera stands still for a while."""
    day, world, frames = formats.DATE, work.world, work.world.frames_per_drive
    name = f"{day}_drive_{number + 1:04d}_sync"
    folder = f"kitti_raw/{day}/{name}"
    still = (max(0, frames // 2 - world.static_frames // 2), world.static_frames) if number == 0 else (0, 0)
    scanned = set(np.linspace(0, frames - 1, world.laser_train_frames + 2)[1:-1].astype(int).tolist())
    ride = _raw_drive((world.train_seed, RAW, number), frames, TRAIN_BENDS[number % 2], still)
    for k in range(frames):
        scan = work.root / folder / f"velodyne_points/data/{k:010d}.bin" if k in scanned else None
        work.shoot(ride, k, f"{folder}/image_02/data/{k:010d}.png", scan=scan)
    work.lists["train_drives"].append(f"{day}/{name}")
    work.lists["static_frames"] += [f"{day} {name} {k:010d}" for k in np.flatnonzero(ride.standing)]


def _test_drive(work: Work, number: int, step: int) -> None:
    """Scored frames in a street of their own, each with scan, exact depth and labels."""
    day, world, root = formats.DATE, work.world, work.root
    name = f"{day}_drive_{FIRST_TEST_DRIVE + number:04d}_sync"
    folder = f"kitti_raw/{day}/{name}"
    frames = [k * step for k in range(world.test_frames)]
    ride = _raw_drive((world.test_seed, RAW, number), frames[-1] + 1, BEND)
    for k in frames:
        depth, labels = root / "dense_depth" / name / f"{k:010d}.npy", root / "labels" / name / f"{k:010d}.png"
        scan = root / folder / f"velodyne_points/data/{k:010d}.bin"
        work.shoot(ride, k, f"{folder}/image_02/data/{k:010d}.png", scan=scan, depth=depth, labels=labels)
    work.lists["test_scenes"].append(name.removesuffix("_sync"))
    work.lists["test_files"] += [f"{day}/{name} {k:010d} l" for k in frames]


def _sequence(work: Work, name: str, seed: tuple[int, ...], frames: int = 0, path: float = 0.0) -> None:
    """An odometry sequence on a winding road, of a number of frames or longer than a path in metres."""
    spacing, folder = work.world.odometry_spacing, f"kitti_odometry/sequences/{name}"
    plan = Plan(seed, 1.15 * path + 20 if path else 1.3 * frames * spacing + 10, *ODOMETRY_BEND, movers=1)
    ride = drive(plan, build_street(plan), spacing, frames, path)
    for k in range(len(ride.poses)):
        work.shoot(ride, k, f"{folder}/image_2/{k:06d}.png")
    work.texts[f"{folder}/calib.txt"] = formats.odometry_calibration_text(work.world.size)
    work.texts[f"kitti_odometry/poses/{name}.txt"] = formats.poses_text(ride.poses)


def _photos(work: Work) -> None:
    """Upright photos from the sidewalk of one more street, looking here and there."""
    world, folder = work.world, work.root / "make3d"
    plan = Plan((world.test_seed, MAKE3D), length=20.0 * world.make3d_images, movers=1)
    street, rng = build_street(plan), np.random.default_rng((world.test_seed, MAKE3D, 2))
    height, width = world.make3d_size
    matrix = np.array([[1.2 * width, 0, (width - 1) / 2], [0, 1.2 * width, (height - 1) / 2], [0, 0, 1]])
    for k in range(world.make3d_images):
        angles = (rng.uniform(-0.5, 0.5), rng.uniform(-0.05, 0.1), rng.uniform(-0.02, 0.02))
        pose = camera_pose(street, 20.0 * k, rng.uniform(-3, 7), CAMERA_HEIGHT - rng.uniform(0, 0.2), angles)
        photo, grid = (
            folder / name.format(f"mini-p-{k:03d}t000") for name in ("Test134/img-{}.jpg", "Gridlaserdata/depth_sph_corr-{}.mat")
        )
        work.shots.append(Shot(plan, pose, 0.0, matrix, world.make3d_size, world.supersample, photo, grid=grid))
