"""Write the ground-truth depth of a list of KITTI raw frames to one npz file.

    python data_scripts/export_depth.py --kitti ROOT --list FILE --out G.npz

One plain float32 array per frame, in metres, 0 where there is no measurement; its key is the frame's place in the list (`%06d`).
The default is the laser's forward coordinate, as in all published numbers on the Eigen split.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from functools import partial
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


def depth_maps(frames: Sequence[Frame], read: Callable[[Frame], np.ndarray]) -> Iterator[np.ndarray]:
    """What `read` gives of each frame: (H, W) float32 in metres, 0 where there is no measurement."""
    for frame in tqdm(frames, "ground truth", unit="frame", disable=None):  # a bar in a pipe would break the one-line error
        with reading(str(frame), "change its permissions"):  # an error of the system, else told as one of writing
            depth = read(frame)
        yield depth


def main(argv: list[str] | None = None) -> None:
    """Run the command line; bad input is one line on stderr and exit code 2."""
    parser = argparse.ArgumentParser(description="Write the ground-truth depth of KITTI raw frames to one npz file.")
    parser.add_argument("--kitti", metavar="ROOT", help="folder that holds 2011_09_26, 2011_09_28, …; needed unless --improved is given")
    parser.add_argument("--list", required=True, metavar="FILE", help="lines like `2011_09_26/2011_09_26_drive_0052_sync 0000000000 l`")
    parser.add_argument("--out", required=True, metavar="G.npz", help="file to write")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--camera-z", action="store_true", help="depth along the camera's axis instead of the laser's forward coordinate")
    kind.add_argument("--improved", metavar="ROOT", help="take KITTI's accumulated maps (data_depth_annotated) under this folder instead")
    parser.add_argument("--allow-missing", action="store_true", help="leave out frames whose file is missing; else they are an error")
    with exit_on_input_error():
        given = parser.parse_args(argv)
        if not (given.kitti or given.improved):
            raise InputError("give --kitti ROOT, the folder that holds 2011_09_26, 2011_09_28, …")
        frames = read_frame_list(given.list)
        if given.improved:
            find, read = partial(improved_path, given.improved), partial(improved_ground_truth, given.improved)
        else:
            root = check_root(given.kitti)
            find, read = partial(velodyne_path, root), partial(ground_truth, root, camera_z=given.camera_z)
        present = present_frames([find(frame) for frame in frames], frames, given.allow_missing)
        maps = depth_maps([frames[number] for number in present], read)
        count = save_ground_truth(given.out, maps, (f"{number:06d}" for number in present), len(frames))
        print(f"{given.out}: {count} depth maps")


if __name__ == "__main__":
    main()
