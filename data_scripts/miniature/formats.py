"""KITTI's text files and Make3D's laser grids, and the rig that they describe.

The rig is KITTI's: a laser above and behind the camera. Camera 2 is the only camera; the
unrectified one differs from it by the small rotation R_rect_00.
"""

import io
from collections.abc import Sequence

import numpy as np
from scipy.io import savemat

DATE = "2019_10_27"  # The recording day of all drives; none of KITTI's, so that nobody takes one for the other.
R_RECT = [9.999239e-01, 9.837760e-03, -7.445048e-03, -9.869795e-03, 9.999421e-01, -4.278459e-03, 7.402527e-03, 4.351614e-03, 9.999631e-01]
LASER_R = [7.533745e-03, -9.999714e-01, -6.166020e-04, 1.480249e-02, 7.280733e-04, -9.998902e-01, 9.998621e-01, 7.523790e-03, 1.480755e-02]
LASER_T = [-4.069766e-03, -7.631618e-02, -2.717806e-01]
FARTHEST = 81.0  # Make3D's laser reports this distance where nothing is met, metres.


def rigid(rotation: Sequence[float], translation: Sequence[float]) -> np.ndarray:
    """(4, 4) from 9 and 3 numbers."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.reshape(rotation, (3, 3)), translation
    return matrix


LASER_TO_CAMERA = rigid(R_RECT, [0, 0, 0]) @ rigid(LASER_R, LASER_T)  # From the laser's frame to the rectified camera's.


def intrinsics(size: tuple[int, int]) -> np.ndarray:
    """(3, 3) camera of `size` = (H, W) pixels with KITTI's field of view and centre."""
    height, width = size
    return np.array([[0.58 * width, 0, 0.49 * width], [0, 0.58 * width, 0.46 * height], [0, 0, 1]]).round(6)


def _line(key: str, values: Sequence[float] | np.ndarray, form: str = "%.6e") -> str:
    return f"{key}: " + " ".join(form % value for value in np.ravel(values)) + "\n"


def calibration_texts(size: tuple[int, int]) -> dict[str, str]:
    """The calibration files of a recording day by name, for frames of `size` = (H, W)."""
    matrix = intrinsics(size)
    projection = np.hstack([matrix, np.zeros((3, 1))])
    cameras = _line("corner_dist", [9.95e-02])
    for camera in ("00", "02"):
        cameras += _line(f"S_{camera}", size[::-1]) + _line(f"K_{camera}", matrix, "%.9e") + _line(f"D_{camera}", np.zeros(5))
        cameras += _line(f"R_{camera}", np.eye(3)) + _line(f"T_{camera}", np.zeros(3)) + _line(f"S_rect_{camera}", size[::-1])
        cameras += _line(f"R_rect_{camera}", R_RECT) + _line(f"P_rect_{camera}", projection, "%.9e")
    stamp = "calib_time: 27-Oct-2019 09:00:00\n"
    laser = stamp + _line("R", LASER_R) + _line("T", LASER_T) + _line("delta_f", [0, 0]) + _line("delta_c", [0, 0])
    return {"calib_cam_to_cam.txt": stamp + cameras, "calib_velo_to_cam.txt": laser}


def odometry_calibration_text(size: tuple[int, int]) -> str:
    """`calib.txt` of an odometry sequence: P0 to P3, which are equal here, and Tr from the laser to the camera."""
    projection = np.hstack([intrinsics(size), np.zeros((3, 1))])
    lines = [_line(f"P{k}", projection, "%.12e") for k in range(4)]
    return "".join(lines) + _line("Tr", LASER_TO_CAMERA[:3], "%.12e")


def poses_text(poses: np.ndarray) -> str:
    """KITTI's `poses/NN.txt` for (N, 4, 4) camera poses: 12 numbers a frame, in the first camera's frame."""
    relative = np.linalg.inv(poses[0]) @ poses
    relative[0] = np.eye(4)
    return "".join(" ".join(f"{value:.9e}" for value in pose[:3].ravel()) + "\n" for pose in relative)


def laser_grid_bytes(depth: np.ndarray, x: np.ndarray, y: np.ndarray) -> bytes:
    """A Make3D laser grid as a `.mat` file, `Position3DGrid` (55, 305, 4): x, y, z in the camera's frame and the distance, metres.

    Args:
        depth: (55, 305) camera-z in metres, 0 where nothing is met.
        x: (1, 305) and
        y: (55, 1): the rays through (x, y, 1).
    """
    stretch = np.sqrt(1 + x**2 + y**2)
    distance = np.where(depth > 0, np.minimum(depth * stretch, FARTHEST), FARTHEST)
    z = distance / stretch
    buffer = io.BytesIO()
    savemat(buffer, {"Position3DGrid": np.stack([x * z, y * z, z, distance], -1).astype(np.float64)})
    header = b"MATLAB 5.0 MAT-file, Make3D layout".ljust(116)  # in place of scipy's, which holds the time of day
    return header + buffer.getvalue()[116:]
