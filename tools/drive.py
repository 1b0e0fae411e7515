"""README's moving picture: a drive through a synthetic street that no training saw, with laser and learned depth."""

import argparse
import io
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from data_scripts.miniature.plan import TEST_STEP, plan_world
from data_scripts.miniature.render import write_shot
from dualdepth.data.kitti import read_frame_list, read_image
from dualdepth.data.lidar import ground_truth
from dualdepth.errors import exit_on_input_error
from dualdepth.model import load
from dualdepth.run import Run
from dualdepth.tables.plots import Picture, show_depth, show_image, thicken

MILLISECONDS = 150  # Of each frame; the drive has ten frames a second, which is too fast to look at.


def drive(profile: str, target: Path) -> None:
    """Draw the first test street of a synthetic profile, frame by frame, with depth by the dual network of its first seed.

    Depth is scaled by the median, image by image, as in the tables. `target` is an animated WebP.
    """
    run = Run(profile)
    model = load(run.weights("dual", run.profile.seeds[0]))
    world = run.profile.world
    # all frames of the street, of which the tables score each fifth
    every = world.model_copy(update={"test_frames": (world.test_frames - 1) * TEST_STEP + 1, "test_drives": 1})
    pages = []
    with tempfile.TemporaryDirectory() as folder:
        work = plan_world(every, Path(folder), step=1)
        for name, text in work.texts.items():
            path = work.root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        frames = read_frame_list(work.root / "lists" / "test_files.txt")
        shots = [shot for shot in work.shots if shot.scan and shot.labels]  # of the test street alone
        for frame, shot in zip(tqdm(frames, "drawing", unit="frame"), shots, strict=True):
            write_shot(shot)
            image, laser = read_image(shot.image), ground_truth(work.root / "kitti_raw", frame)
            depth = model.predict(image)
            seen = laser > 0
            pages.append(_page(image, thicken(laser), depth * np.median(laser[seen]) / np.median(depth[seen])))
    pages[0].save(target, save_all=True, append_images=pages[1:], duration=MILLISECONDS, loop=0, quality=60, method=6)
    print(f"{target}: {len(pages)} frames, {target.stat().st_size / 1e6:.1f} MB")


def _page(image: np.ndarray, laser: np.ndarray, depth: np.ndarray) -> Image.Image:
    """Three pictures, one below the other."""
    figure = Picture(figsize=(6.4, 6.2), layout="constrained")
    first, second, third = figure.subplots(3)
    show_image(first, image, "frame of a street that no training saw")
    show_depth(second, laser, "simulated laser")
    show_depth(third, depth, "depth by the dual network, learned from video alone")
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=100)
    return Image.open(buffer).convert("RGB")


if __name__ == "__main__":
    with exit_on_input_error():
        parser = argparse.ArgumentParser(description=__doc__)
        parser.add_argument("--profile", default="miniature", help="a synthetic profile that was run (default: %(default)s)")
        parser.add_argument("--out", default="docs/drive.webp", type=Path, help="file to write (default: %(default)s)")
        given = parser.parse_args()
        drive(given.profile, given.out)
