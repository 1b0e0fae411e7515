"""Good input for each command in a folder of its own, and the call that reads it; a bad input is one of these, damaged.

`WORLDS[name](folder)` writes the files below `folder`, which is the working directory, and gives the call.
"""

import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from loopback import Loopback, tar_of, zip_of
from PIL import Image
from scipy.io import savemat
from small_encoder import save_encoder
from small_kitti import write_calibration, write_drive

from data_scripts import download_kitti, download_make3d, export_depth
from dualdepth.cli import main
from dualdepth.data.depth_maps import save_ground_truth
from dualdepth.data.label_maps import read_label_map
from dualdepth.errors import exit_on_input_error
from dualdepth.files import write_text
from dualdepth.training.variants import make_stage
from dualdepth.training.weights import save_weights
from tests.small_checkout import checkout_of, prepare

Call = Callable[[], int]
DAY = "2011_09_26"
DRIVE = f"{DAY}/{DAY}_drive_0001_sync"
FRAME = "kitti/" + DRIVE + "/image_02/data/0000000001"
SCAN = "kitti/" + DRIVE + "/velodyne_points/data/0000000001.bin"
CAMERAS, LASER = f"kitti/{DAY}/calib_cam_to_cam.txt", f"kitti/{DAY}/calib_velo_to_cam.txt"
IMPROVED = f"improved/val/{DAY}_drive_0001_sync/proj_depth/groundtruth/image_02/0000000001.png"
WEIGHTS = "work/own/runs/lr/seed0/model.safetensors"
ZIP = f"raw_data/{DAY}_calib.zip"
PHOTOS, GRIDS = "Test134.tar.gz", "Test134Depth.tar.gz"


def depth(folder: Path) -> Call:
    """`evaluate depth`, with the guard against leaks."""
    rng = np.random.default_rng(0)
    np.save("P.npy", rng.uniform(1, 9, (2, 10, 16)).astype(np.float32))
    save_ground_truth("G.npz", [rng.uniform(1, 80, (40, 60)).astype(np.float32)] * 2)
    write_text("list.txt", f"{DRIVE} 0000000000 l\n{DRIVE} 0000000001 l\n")
    write_text("w.json", json.dumps({"drives": ["another"]}))
    Path("w.safetensors").touch()
    arguments = ["--pred", "P.npy", "--gt", "G.npz", "--weights", "w.safetensors", "--list", "list.txt", "--json", "out.json"]
    return lambda: main(["evaluate", "depth", *arguments])


def odometry(folder: Path) -> Call:
    """`evaluate odometry`."""
    for name in ("pred.txt", "gt.txt"):
        write_text(name, "".join(f"1 0 0 {k} 0 1 0 0 0 0 1 {k}\n" for k in range(8)))
    return lambda: main(["evaluate", "odometry", "--pred", "pred.txt", "--gt", "gt.txt", "--json", "out.json"])


def scans(folder: Path) -> Call:
    """`export_depth.py` of laser scans; the first frame has an image as well."""
    write_calibration("kitti")
    write_text(CAMERAS, Path(CAMERAS).read_text() + "R_rect_00: 1 0 0 0 1 0 0 0 1\nS_rect_02: 80 40\n")
    write_text(LASER, "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 -0.27\n")
    write_drive("kitti", [0])
    Path(SCAN).parent.mkdir(parents=True)
    for index in range(2):
        points = np.random.default_rng(index).uniform(1, 20, (501, 4))  # quarters of it end within a point
        points.astype("<f4").tofile(Path(SCAN).with_name(f"{index:010d}.bin"))
    write_text("list.txt", f"{DRIVE} 0000000000 l\n{DRIVE} 0000000001 l\n")
    return lambda: export_depth.main(["--kitti", "kitti", "--list", "list.txt", "--out", "out.npz"])


def improved(folder: Path) -> Call:
    """`export_depth.py --improved`."""
    Path(IMPROVED).parent.mkdir(parents=True)
    for index in range(2):
        Image.fromarray(np.full((12, 16), 2560, np.uint16)).save(Path(IMPROVED).with_name(f"{index:010d}.png"))
    write_text("list.txt", f"{DRIVE} 0000000000 l\n{DRIVE} 0000000001 l\n")
    return lambda: export_depth.main(["--improved", "improved", "--list", "list.txt", "--out", "out.npz"])


def training(folder: Path, suffix: str = ".png", variant: str = "lr") -> Call:
    """`train`, one step of a small network on one triplet."""
    write_calibration("kitti")
    write_drive("kitti", range(3), suffix=suffix)
    stage = {"batch_size": 1, "max_steps": 1}
    run = checkout_of(folder, save_encoder(folder / "small"), {"lr": stage, "hr": stage}, train={"lr": None, "dual": None})
    prepare(run)
    if variant == "dual":
        # weights of stage 1 as a training writes them, without the training
        card = run.profile.architecture("lr").model_dump() | {"hr_size": [192, 192], "variant": "lr", "seed": 0, "steps": 1}
        save_weights(run.weights("lr", 0), make_stage(run.profile, "lr"), card | {"pretrained": False, "drives": [DRIVE]})
    return lambda: main(["train", "--profile", "own.yaml", "--variant", variant])


def labels(folder: Path) -> Call:
    """The reader of label maps, which notebooks alone call, as a command would end."""
    Image.fromarray(np.tile(np.arange(16, dtype=np.uint8), (12, 1))).save("labels.png")

    def read() -> int:
        with exit_on_input_error():
            read_label_map("labels.png")
        return 0

    return read


def written(save: Callable[..., object], *arguments: object, **settings: object) -> bytes:
    """What `save(file, …)` of a library writes."""
    buffer = io.BytesIO()
    save(buffer, *arguments, **settings)
    return buffer.getvalue()


def photo() -> bytes:
    """A photo as Make3D has them, small."""
    return written(Image.fromarray(np.random.default_rng(0).integers(0, 255, (40, 30, 3), np.uint8)).save, "jpeg")


def grid(name: str = "Position3DGrid", shape: tuple[int, ...] = (55, 305, 4), kind: type = float, **settings: object) -> bytes:
    """A laser grid as Make3D has them."""
    return written(savemat, {name: np.random.default_rng(0).uniform(1, 80, shape).astype(kind)}, **settings)


def kitti_archive(folder: Path, server: Loopback) -> Call:
    """`download_kitti.py` of one drive, from a server on loopback; a damage is one of what it serves."""
    server.files[ZIP] = zip_of({f"{DAY}/calib_cam_to_cam.txt": b"P_rect_02: 1 0 0\n"})
    name = f"{DAY}_drive_0001"
    server.files[f"raw_data/{name}/{name}_sync.zip"] = zip_of({f"{DRIVE}/image_02/data/0000000000.png": b"image"})
    return lambda: download_kitti.main(["--root", str(folder / "kitti"), DRIVE], kitti_home=server.home)


def make3d_archive(folder: Path, server: Loopback) -> Call:
    """`download_make3d.py`, likewise, of one photo and its grid."""
    server.files[PHOTOS] = tar_of({"img-a.jpg": photo()})
    server.files[GRIDS] = tar_of({"Gridlaserdata/depth_sph_corr-a.mat": grid()})
    return lambda: download_make3d.main(["--root", str(folder / "make3d")], home=server.home)


WORLDS = {
    "depth": depth,
    "odometry": odometry,
    "scans": scans,
    "improved": improved,
    "PNG frames": training,
    "JPEG frames": lambda folder: training(folder, ".jpg"),
    "stage 2": lambda folder: training(folder, variant="dual"),
    "labels": labels,
}
SERVED = {"KITTI archive": kitti_archive, "Make3D archive": make3d_archive}
