"""How does PoseNet explain a turn: by turning, or by sliding sideways?

    python experiments/turns.py [--profile miniature] [--seed 0]      # seconds, once notebook 12 has run with that profile

For each scored sequence: how much of the true yaw from frame to frame the prediction has (slope of its regression on the true one, 1 is
right) and how the two correlate; and how far the car moves sideways for each metre forward (root mean square), as predicted and in truth,
with the correlation of the predicted sideways motion and the true yaw.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dualdepth.data.odometry import sequence_of
from dualdepth.data.trajectories import read_trajectory
from dualdepth.errors import exit_on_input_error
from dualdepth.odometry_scoring import true_trajectory
from dualdepth.results import Run
from dualdepth.tables.odometry import scored_variants, sequences


def steps(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Yaw in radians (N - 1) and translation (N - 1, 3) from each frame to the next, in the first's axes, of poses (N, 4, 4)."""
    motion = np.linalg.inv(poses[:-1]) @ poses[1:]
    return Rotation.from_matrix(motion[:, :3, :3]).as_rotvec()[:, 1], motion[:, :3, 3]


def main() -> int:
    """Print a line for each training and sequence."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--profile", default="miniature")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with exit_on_input_error():
        run = Run(arguments.profile)
        for entry in sequences(run):
            true_yaw, true_move = steps(true_trajectory(run, entry).poses)
            for name in scored_variants(run):
                file = run.results / "trajectories" / f"{name}_seed{arguments.seed}_{sequence_of(entry)[0]}.txt"
                yaw, move = steps(read_trajectory(run.require(file, "12_table_odometry")).poses)
                true_slide, slide = (m[:, 0] / m[:, 2] for m in (true_move, move))
                share, turns = np.polyfit(true_yaw, yaw, 1)[0], np.corrcoef(true_yaw, yaw)[0, 1]
                sideways, true_sideways = (np.sqrt((x**2).mean()) for x in (slide, true_slide))
                print(
                    f"{name} on {entry}: {share:.3f} of the true yaw, correlation {turns:.2f}; sideways {sideways:.2f} m a metre,"
                    f" in truth {true_sideways:.3f}, correlation with the true yaw {np.corrcoef(true_yaw, slide)[0, 1]:.2f}"
                )
    return 0


if __name__ == "__main__":
    sys.exit(main())
