"""The paper's published numbers and its inner oddities, as data; its training recipe is the default of `settings.py`.

Every table has the paper's rows in its order with all columns; `source` is "paper". A number the paper does not give is NaN.
"""

import pandas as pd

DEPTH = ("abs_rel", "sq_rel", "rmse", "rmse_log", "a1", "a2", "a3")

# "-" in the paper's column Supervision: learned from video alone, or nothing learned
_MAIN = (
    ("Train set mean", "-", "-", 0.361, 4.826, 8.102, 0.377, 0.638, 0.804, 0.894),
    ("Eigen et al.", "K", "Depth", 0.203, 1.548, 6.307, 0.282, 0.702, 0.890, 0.890),
    ("Liu et al.", "K", "Depth", 0.201, 1.584, 6.471, 0.273, 0.680, 0.898, 0.967),
    ("Godard et al.", "K", "Stereo", 0.148, 1.344, 5.927, 0.247, 0.803, 0.922, 0.964),
    ("Godard et al.", "K+CS", "Stereo", 0.124, 1.076, 5.311, 0.219, 0.847, 0.942, 0.973),
    ("Kuznietsov et al.", "K", "Depth+Stereo", 0.113, 0.741, 4.621, 0.189, 0.862, 0.960, 0.986),
    ("DORN", "K", "Depth", 0.072, 0.307, 2.727, 0.120, 0.932, 0.984, 0.994),
    ("Yang et al.", "K+CS", "Stereo", 0.114, 1.074, 5.836, 0.208, 0.856, 0.939, 0.976),
    ("Casser et al.", "K", "Instance Label", 0.109, 0.825, 4.750, 0.187, 0.874, 0.958, 0.983),
    ("Zhou et al.", "K", "-", 0.183, 1.595, 6.709, 0.270, 0.734, 0.902, 0.959),
    ("GeoNet", "K", "-", 0.155, 1.296, 5.857, 0.233, 0.793, 0.931, 0.973),
    ("DDVO", "K", "-", 0.151, 1.257, 5.583, 0.228, 0.810, 0.936, 0.974),
    ("Godard et al. (V2)", "K", "-", 0.129, 1.112, 5.180, 0.205, 0.851, 0.952, 0.978),
    ("Yang et al.", "K", "-", 0.131, 1.254, 6.117, 0.220, 0.826, 0.931, 0.973),
    ("Ours", "K", "-", 0.121, 0.837, 4.945, 0.197, 0.853, 0.955, 0.982),
)
_MAKE3D = (
    ("Train set mean", "-", 0.893, 13.98, 12.27),
    ("Karsch et al.", "Depth", 0.428, 5.079, 8.389),
    ("Liu et al.", "Depth", 0.475, 6.562, 10.05),
    ("Laina et al.", "Depth", 0.204, 1.840, 5.683),
    ("Godard et al.", "Pose", 0.544, 10.94, 11.76),
    ("Zhou et al.", "-", 0.383, 5.321, 10.47),
    ("DDVO", "-", 0.387, 4.720, 8.090),
    ("Godard et al. (V2)", "-", 0.361, 4.170, 7.821),
    ("Ours", "-", 0.318, 2.288, 6.669),
)
_ABLATION = (
    ("Baseline (LR-Net only)", 0.132, 0.929, 5.208, 0.209, 0.833, 0.946, 0.979),
    ("LR-Net+HR-Net (w/o SA module)", 0.123, 0.881, 5.016, 0.198, 0.851, 0.955, 0.982),
    ("LR-Net+HR-Net (w/ SA module)", 0.121, 0.837, 4.945, 0.197, 0.853, 0.955, 0.982),
)
_DISTANCE = (
    ("w/o HR-Net", "<= 20 m", 0.108, 0.448, 2.107, 0.153, 0.901, 0.973, 0.990),
    ("w/o HR-Net", "> 20 m", 0.199, 2.685, 9.885, 0.310, 0.648, 0.865, 0.940),
    ("w/ HR-Net", "<= 20 m", 0.102, 0.391, 1.959, 0.146, 0.912, 0.977, 0.990),
    ("w/ HR-Net", "> 20 m", 0.187, 2.430, 9.695, 0.305, 0.662, 0.875, 0.946),
)
_SHARPNESS = (("w/o HR-Net", 20784.4), ("w/ HR-Net", 106987.2))
_SA_REGION = (("Road", "w/o SA", 0.085), ("Road", "w/ SA", 0.080), ("Tree & grass", "w/o SA", 0.190), ("Tree & grass", "w/ SA", 0.192))
_BACKBONE = (
    ("MobileNet V2", 5.37, 17.02, 0.147, 0.998, 5.185, 0.810, 0.940, 0.976),
    ("ResNet18", 16.43, 33.11, 0.138, 0.968, 5.281, 0.823, 0.947, 0.980),
    ("Dual-network (ResNet50)", 34.16, 25.80, 0.121, 0.837, 4.945, 0.853, 0.955, 0.982),
    ("w/ pt", None, None, 0.121, 0.837, 4.945, 0.853, 0.955, 0.982),
    ("w/o pt", None, None, 0.135, 0.973, 5.235, 0.823, 0.947, 0.980),
)
_ODOMETRY = (
    ("ORB-Slam (full)", 0.014, 0.008, 0.012, 0.011, None),
    ("ORB-Slam (short)", 0.064, 0.141, 0.064, 0.130, None),
    ("Zhou et al.", 0.021, 0.017, 0.020, 0.015, 5),
    ("GeoNet", 0.012, 0.007, 0.012, 0.009, 5),
    ("DF-Net", 0.017, 0.007, 0.015, 0.009, 5),
    ("DDVO", 0.045, 0.108, 0.033, 0.074, 3),
    ("Ours (LR-Net)", 0.017, 0.008, 0.016, 0.009, 3),
    ("Ours (LR-Net+HR-Net)", 0.015, 0.007, 0.015, 0.009, 3),
)
_ATE = ("snippet_ate_mean_09", "snippet_ate_std_09", "snippet_ate_mean_10", "snippet_ate_std_10")

_TABLES = {  # by name, as of the files in `results/<profile>/tables`
    "main": (("method", "dataset", "supervision", *DEPTH), _MAIN),
    "make3d": (("method", "supervision", "abs_rel", "sq_rel", "rmse"), _MAKE3D),
    "ablation": (("method", *DEPTH), _ABLATION),
    "distance": (("method", "distance", *DEPTH), _DISTANCE),
    "sharpness": (("method", "tenengrad"), _SHARPNESS),
    "sa_region": (("region", "method", "abs_rel"), _SA_REGION),
    "backbone": (("backbone", "params_m", "gmacs", "abs_rel", "sq_rel", "rmse", "a1", "a2", "a3"), _BACKBONE),
    "odometry": (("method", *_ATE, "frames"), _ODOMETRY),
}

HR_SIZE, LR_SIZE = (384, 1248), (128, 416)  # (height, width) of the networks' inputs (section "Dual Network Architecture").

ODDITIES = (
    "The ResNet18 row and the row without ImageNet pretraining share all three δ values to the last digit although their errors differ:"
    " probably a copying slip in one of them.",
    "The near and far values are no plain pixel mixture of the overall ones: the far share would be 0.26 for LR-Net, 0.25 for the dual"
    " network without SA and 0.22 with SA, on the same pixels; they are means of per-image means, and it is not said whether the row with"
    " HR-Net has SA.",
    "The rows of Godard et al. (V2) match an early preprint, not the released monodepth2 (KITTI 0.115/0.903/4.863/0.193/0.877/0.959/0.981,"
    " Make3D 0.322/3.589/7.417), so the paper does not outperform the released model on KITTI depth.",
    "The row of Eigen et al. has the same value, 0.890, for δ<1.25² and δ<1.25³, which no other row does.",
    "What the overhead table calls GFLOPs are multiply-accumulates: at two operations each, ResNet18's encoder alone (34.6) would exceed"
    " its row (33.11).",
)
"""What does not fit together inside the paper, a sentence each (docs/protocols.md, "Oddities of the paper")."""


def table(name: str) -> pd.DataFrame:
    """A table of the paper, with the columns of `results/<profile>/tables/<name>.csv` that it has, and `source`.

    Depth errors are in metres where they have a unit, δ shares in [0, 1], `params_m` in millions, `gmacs` in 10⁹ multiply-accumulates,
    trajectory errors in metres; `frames` is the number of frames PoseNet takes.
    """
    columns, rows = _TABLES[name]
    return pd.DataFrame(list(rows), columns=list(columns)).assign(source="paper")
