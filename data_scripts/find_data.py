"""Where a profile's data are: the synthetic world is made, a user's folders are taken, or what is needed is downloaded (notebook 01)."""

from pathlib import Path

from data_scripts import make_miniature
from data_scripts.download import download
from data_scripts.own.dataset import read_record
from data_scripts.sources import KITTI_HOME, drive_archives, profile_drives, profile_lists
from dualdepth.data.kitti import check_root, numbered_lines
from dualdepth.errors import InputError
from dualdepth.run import RECORD, Run, Sources, check_roots

MOST_SQUEEZED = 1.3
"""Factor by which a profile may change the frames' shape; intrinsics follow, but what is seen looks strange to a network beyond it."""


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
        sources = Sources(
            kitti_root=root / "kitti_raw",
            test_list=root / "lists/test_files.txt",
            train_drives=tuple((root / "lists/train_drives.txt").read_text(encoding="utf-8").split()),
            static_frames=root / "lists/static_frames.txt",
            test_scenes=root / "lists/test_scenes.txt",
            odometry_root=root / "kitti_odometry",
            make3d_root=root / "make3d",
            labels_root=root / "labels",
        )
    else:
        sources = kitti_sources(run, kitti_root, test_list) if run.profile.data.has_truth else own_sources(run, kitti_root, test_list)
        check_roots(others)
        sources = sources._replace(**{name: Path(value).resolve() if value else None for name, value in others.items()})
    sources = sources._replace(allow_leak=allow_leak)
    sources.save(run)
    return sources


def own_sources(run: Run, root: str, test_list: str) -> Sources:
    """Sources of a data set that data_scripts/own_camera.py made.

    Raises:
        InputError: `root` is no such data set, or its frames are of quite another shape than the profile's hr_size.
    """
    record, data = read_record(root) if root else None, run.profile.data
    if record is None:
        what = f"KITTI_ROOT {root!r} is no data set of your own camera, with {RECORD}, which profile {run.profile.name} trains on"
        raise InputError(f"{what}; python data_scripts/own_camera.py VIDEO --out DIR makes one")
    camera, (height, width) = record["camera"], data.hr_size
    squeezed = camera["width"] / camera["height"] * height / width
    if not 1 / MOST_SQUEEZED < squeezed < MOST_SQUEEZED:
        what = f"hr_size {height}x{width} squeezes frames of {camera['width']}×{camera['height']}"
        fits = next(iter(sorted(Path(root).glob("*.yaml"))), "own.yaml")
        raise InputError(f"profile {run.profile.name}: {what}; give PROFILE={fits}, which was written for them, or another hr_size")
    kitti_root = check_root(root).resolve()
    drives = tuple(line for _, line in numbered_lines(kitti_root / "lists/train_drives.txt"))
    return Sources(kitti_root, Path(test_list).resolve() if test_list else kitti_root / "lists/test_files.txt", train_drives=drives)


def kitti_sources(run: Run, kitti_root: str, test_list: str) -> Sources:
    """Sources of real KITTI; without `kitti_root` the profile's drives are downloaded to `work/kitti`."""
    data, home = run.profile.data, run.root / "work" / "kitti"
    data = data.model_copy(update={"test_list": test_list}) if test_list else data
    if not data.test_list:
        raise InputError(f"profile {run.profile.name} names no frames to score: give data.test_list or TEST_LIST")
    lists = profile_lists(data, home / "lists")
    if not kitti_root:
        cameras = {"image_02", "image_03", *data.cameras, *(d.partition(":")[2] for d in data.train_drives if ":" in d)}
        download(drive_archives(profile_drives(data, lists)), home, KITTI_HOME, cameras=sorted(cameras))
    return Sources(kitti_root=check_root(kitti_root or home).resolve(), **lists)
