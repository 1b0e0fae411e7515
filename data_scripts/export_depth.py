"""Write the ground-truth depth of a list of KITTI raw frames to one npz file.

    python data_scripts/export_depth.py --kitti ROOT --list FILE --out G.npz

One plain float32 array per frame, in metres, 0 where there is no measurement; its key is the frame's place in the list (`%06d`).
The default is the laser's forward coordinate, as in all published numbers on the Eigen split.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from dualdepth.data.depth_maps import save_ground_truth
from dualdepth.data.kitti import Frame, check_root, read_frame_list, velodyne_path
from dualdepth.data.lidar import ground_truth, improved_ground_truth, improved_path
from dualdepth.errors import InputError, exit_on_input_error, reading


def present_frames(paths: Sequence[Path | None], frames: Sequence[Frame], allow_missing: bool) -> list[int]:
    """Places in the list of the frames whose file exists.

    Raises:
        InputError: files are missing and not allowed to be, or all are; the one message lists every missing file.
    """
    present = [number for number, path in enumerate(paths) if path is not None and path.is_file()]
    missing = [str(paths[number] or frames[number]) for number in sorted({*range(len(paths))} - {*present})]
    said = f"{len(missing)} of {len(frames)} files are missing"
    if missing and (not allow_missing or not present):
        mend = "" if allow_missing else "; download them, or pass --allow-missing to export the rest"
        raise InputError(f"{said}{mend}: {', '.join(missing)}")
    if missing:
        print(f"{said} and left out: {', '.join(missing)}")
    return present


def export_frames(
    frames: Sequence[Frame],
    out: str | Path,
    *,
    kitti: str | Path | None = None,
    camera_z: bool = False,
    improved: str | Path | None = None,
    allow_missing: bool = False,
) -> int:
    """Write the ground truth of frames to `out` and return the number of maps.

    Args:
        frames, out: in the order of the maps, and the npz file that they go to.
        kitti: folder of KITTI raw, for projected laser scans.
        camera_z: depth along the camera's axis instead of the laser's forward coordinate.
        improved: folder of the accumulated maps, which are then taken instead.
        allow_missing: leave out frames whose file is missing.

    Raises:
        InputError: files are missing (all are named in one message) or broken, or `out` cannot be written.
    """
    root = check_root(kitti) if improved is None else Path(improved)
    paths = [improved_path(root, frame) if improved else velodyne_path(root, frame) for frame in frames]
    present = present_frames(paths, frames, allow_missing)

    def maps() -> Iterator[np.ndarray]:
        # a bar in a pipe would break the one-line error
        for number in tqdm(present, "ground truth", unit="frame", disable=None):
            frame = frames[number]
            with reading(root / str(frame), "change its permissions"):  # an error of the system, else told as one of writing
                depth = improved_ground_truth(root, frame) if improved else ground_truth(root, frame, camera_z=camera_z)
            yield depth

    return save_ground_truth(out, maps(), (f"{number:06d}" for number in present))


def main(argv: list[str] | None = None) -> None:
    """Run the command line.

    Raises:
        SystemExit: code 2, after one line on stderr, for bad input.
    """
    parser = argparse.ArgumentParser(description="Write the ground-truth depth of KITTI raw frames to one npz file.")
    parser.add_argument("--kitti", metavar="ROOT", help="folder that holds 2011_09_26, 2011_09_28, …; needed unless --improved is given")
    parser.add_argument("--list", required=True, metavar="FILE", help="lines like `2011_09_26/2011_09_26_drive_0052_sync 0000000000 l`")
    parser.add_argument("--out", required=True, metavar="G.npz", help="file to write")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--camera-z", action="store_true", help="depth along the camera's axis instead of the laser's forward coordinate")
    kind.add_argument("--improved", metavar="ROOT", help="take KITTI's accumulated maps (data_depth_annotated) under this folder instead")
    parser.add_argument("--allow-missing", action="store_true", help="leave out frames whose file is missing; else they are an error")
    arguments = parser.parse_args(argv)
    with exit_on_input_error():
        if not (arguments.kitti or arguments.improved):
            raise InputError("give --kitti ROOT, the folder that holds 2011_09_26, 2011_09_28, …")
        options = vars(arguments)
        count = export_frames(read_frame_list(options.pop("list")), **options)
        print(f"{arguments.out}: {count} depth maps")


if __name__ == "__main__":
    main()
