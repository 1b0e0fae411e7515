"""Ground-truth depth of KITTI raw frames: projected laser scans and the improved, accumulated maps.

The projection is the one that the published Eigen-split numbers were scored with, quirks included (SfMLearner
`kitti_eval/depth_evaluation_utils.py`, monodepth2 `kitti_utils.py`; docs/protocols.md, "Depth on the Eigen split"). A pixel of 0 has no
measurement.
"""

from pathlib import Path

import cv2
import numpy as np
import PIL.Image

from dualdepth.data.kitti import AGAIN, Frame, calibration_entry, image_path, read_calibration, velodyne_path, whole_image
from dualdepth.errors import InputError, reading

LARGEST_SIDE = 20_000  # Pixels of an image's side that a calibration may announce.


def read_scan(path: str | Path) -> np.ndarray:
    """Read a Velodyne scan, (N, 4) float32 in the laser's frame: forward, left, up in metres, and reflectance. An `InputError` says that it
    is missing, empty, of a size that is no multiple of 16 bytes, or not finite."""
    with reading(path, AGAIN):
        data = Path(path).read_bytes()
    if not data or len(data) % 16:
        raise InputError(f"{path}: {len(data)} bytes are not a laser scan (4 float32 = 16 bytes a point); {AGAIN}")
    scan = np.frombuffer(data, "<f4").reshape(-1, 4)
    if not np.isfinite(scan).all():
        raise InputError(f"{path}: holds values that are not finite, so it is not a laser scan; {AGAIN}")
    return scan


def velodyne_projection(root: str | Path, date: str, camera: str = "image_02") -> np.ndarray:
    """Matrix from laser points to pixels of a rectified camera: P_rect · R_rect_00 · (R, T of velo→cam).

    It is (3, 4) float64 and maps homogeneous laser points in metres to (u·z, v·z, z), z the camera's depth in metres. An `InputError` says
    that a calibration file or one of its entries is missing or malformed.
    """
    cameras_path, laser_path = (Path(root) / date / name for name in ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt"))
    cameras, laser = read_calibration(cameras_path), read_calibration(laser_path)
    to_camera, to_rectified = np.eye(4), np.eye(4)
    to_camera[:3, :3] = calibration_entry(laser, "R", 9, laser_path).reshape(3, 3)
    to_camera[:3, 3] = calibration_entry(laser, "T", 3, laser_path)
    to_rectified[:3, :3] = calibration_entry(cameras, "R_rect_00", 9, cameras_path).reshape(3, 3)
    to_pixels = calibration_entry(cameras, f"P_rect_{camera[-2:]}", 12, cameras_path).reshape(3, 4)
    return to_pixels @ to_rectified @ to_camera


def depth_from_scan(scan: np.ndarray, projection: np.ndarray, size: tuple[int, int], *, camera_z: bool = False) -> np.ndarray:
    """Project a laser scan to a sparse depth map (H, W) float32 in metres, 0 for none, equal to the field's code bit for bit.

    Of points (N, 4) in the laser's frame, metres; `projection` (3, 4), see `velodyne_projection`; `size` (height, width) in pixels.
    `camera_z` stores the depth along the camera's axis; else the laser's forward coordinate, as in all published numbers of this lineage
    (the two differ by the lever arm of about 0.27 m).
    """
    height, width = size
    points = scan[scan[:, 0] >= 0].astype(np.float64)
    points[:, 3] = 1.0
    u, v, z = projection @ points.T
    with np.errstate(divide="ignore", invalid="ignore"):
        # rint is half-to-even; the −1 comes from the 1-based MATLAB kit
        column, row = np.rint(u / z) - 1, np.rint(v / z) - 1
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    column, row = column[inside].astype(np.intp), row[inside].astype(np.intp)
    value = (z if camera_z else points[:, 0])[inside]

    depth = np.zeros(size)
    depth[row, column] = value
    if value.size:
        # The field groups points by row·(W−1) + column − 1, which joins a row's last cell with the next row's first:
        # the nearest depth of a group goes to the cell of its first point, other cells keep their last point.
        group = row * (width - 1) + column - 1
        order = np.argsort(group, kind="stable")
        starts = np.flatnonzero(np.diff(group[order], prepend=-2))
        first = order[starts]
        depth[row[first], column[first]] = np.minimum.reduceat(value[order], starts)
    return np.maximum(depth, 0).astype(np.float32)


def ground_truth(root: str | Path, frame: Frame, *, camera_z: bool = False) -> np.ndarray:
    """Sparse depth (H, W) float32 of a frame in metres, 0 for none, from the laser scan of the same number, at the size of its image.

    Without the image the size is the calibration's `S_rect`, which is the same on KITTI raw. An `InputError` says that scan, image or
    calibration is missing or broken. For `camera_z` see `depth_from_scan`.
    """
    scan = read_scan(velodyne_path(root, frame))
    projection = velodyne_projection(root, frame.date, frame.camera)
    return depth_from_scan(scan, projection, map_size(root, frame), camera_z=camera_z)


def map_size(root: str | Path, frame: Frame) -> tuple[int, int]:
    """(height, width) of a frame in pixels: of its image, read from the header alone, or else the calibration's `S_rect`. An `InputError`
    says that the image has no readable header, or that there is neither an image nor a usable calibration."""
    path = image_path(root, frame)
    if path is None:
        calibration, key = Path(root) / frame.date / "calib_cam_to_cam.txt", f"S_rect_{frame.camera[-2:]}"
        width, height = calibration_entry(read_calibration(calibration), key, 2, calibration)
        if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
            raise InputError(f"{calibration}: {key} is {width:g} x {height:g}, which is no size of an image; {AGAIN}")
        return int(height), int(width)
    with reading(path, AGAIN), PIL.Image.open(path) as image:
        return image.height, image.width


def improved_path(root: str | Path, frame: Frame) -> Path | None:
    """Path of a frame's accumulated depth map in KITTI's `data_depth_annotated` (with or without `train`, `val` or dates), or None."""
    drive = frame.drive.split("/")[-1]
    for folder in (f"train/{drive}", f"val/{drive}", frame.drive, drive):
        path = Path(root) / folder / "proj_depth" / "groundtruth" / frame.camera / f"{frame.index:010d}.png"
        if path.is_file():
            return path
    return None


def improved_ground_truth(root: str | Path, frame: Frame) -> np.ndarray:
    """Accumulated, filtered laser depth (H, W) float32 of a frame, in metres along the camera's axis, 0 for none (Uhrig et al. 2017).

    652 of the 697 Eigen test frames have it; an `InputError` says that there is none, or no 16-bit PNG with one channel.
    """
    path = improved_path(root, frame)
    if path is None:
        raise InputError(f"{root}: has no proj_depth/groundtruth map of {frame}; give the folder that data_depth_annotated.zip unpacks to")
    values = cv2.imdecode(whole_image(path), cv2.IMREAD_UNCHANGED)
    if values is None or values.dtype != np.uint16 or values.ndim != 2:
        raise InputError(f"{path}: not a 16-bit depth PNG; {AGAIN}")
    return values.astype(np.float32) / 256
