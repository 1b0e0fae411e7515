"""Make the embedded synthetic street world, in KITTI's own formats.

    python data_scripts/make_miniature.py --profile miniature [--out DIR]

Below `work/<profile>/miniature/`: `kitti_raw`, `kitti_odometry` and `make3d` as those data sets unpack, `lists` in the
field's formats, `dense_depth` and `labels` of the test frames. Size, length and seeds are the profile's section `world`.
Nothing is done where the folder holds this very world already; a run that was stopped leaves nothing half-written.
"""

import argparse
import functools
import hashlib
import json
import multiprocessing
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
from tqdm import tqdm

from data_scripts.miniature.plan import plan_world
from data_scripts.miniature.render import Shot, write_shot
from dualdepth.errors import InputError, exit_on_input_error
from dualdepth.files import locked, write_json, write_text
from dualdepth.profile import load_profile
from dualdepth.settings import World

REPOSITORY = Path(__file__).resolve().parents[1]
STAMP = "world.json"  # Written last; says which settings and sources a folder was made from.


def make_world(world: World, out: str | Path, processes: int | None = None) -> bool:
    """Make a world in the folder `out`, unless it is there.

    Args:
        world, out: the settings, and the folder; a world in it that was made otherwise is replaced.
        processes: number of worker processes, None for one a core; 1 works in this one. The result is the same.

    Returns:
        Whether it had to be made.

    Raises:
        InputError: `out` is a file, a folder that holds something else than a world, or one that another process is making.
    """
    out = Path(out).absolute()
    stamp = {"digest": world_digest(world), "settings": world.model_dump(mode="json")}
    partial, there = out.with_name(f".{out.name}.part"), out / STAMP
    with locked(out.with_name(f".{out.name}.lock")):
        if out.exists() and not there.is_file() and not (out.is_dir() and not any(out.iterdir())):
            raise InputError(f"{out}: is there and is no world that this script made; give another --out or remove it")
        if there.is_file() and stamp["digest"].encode() in there.read_bytes():
            print(f"the world is there already, in {out.name}")
            return False
        shutil.rmtree(partial, ignore_errors=True)  # of a killed run
        try:
            work = plan_world(world, partial)
            for name, text in work.texts.items():
                write_text(partial / name, text)
            _render(work.shots, processes)
            write_json(partial / STAMP, stamp)
            if out.exists():
                shutil.rmtree(out)
            os.replace(partial, out)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    return True


def world_digest(world: World) -> str:
    """Content hash of the settings and of the sources that make the world."""
    digest = hashlib.sha256(json.dumps(world.model_dump(mode="json"), sort_keys=True).encode())
    for source in (Path(__file__), *sorted((Path(__file__).parent / "miniature").glob("*.py"))):
        digest.update(source.read_bytes())
    return digest.hexdigest()


def _render(shots: list[Shot], processes: int | None) -> None:
    """Write all shots; neighbours go to the same process, which keeps their street."""
    bar = functools.partial(tqdm, total=len(shots), desc="rendering the world", unit="frame")
    if processes == 1:
        for shot in bar(shots):
            write_shot(shot)
        return
    processes = processes or (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count())
    # A fresh interpreter each: a notebook's process may hold threads and a GPU, which must not be forked.
    with multiprocessing.get_context("spawn").Pool(processes, initializer=cv2.setNumThreads, initargs=(1,)) as pool:
        for _ in bar(pool.imap(write_shot, shots, chunksize=8)):
            pass


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--profile", default="miniature", help="profile with a section `world`: tiny, miniature, or a YAML file")
    parser.add_argument("--out", type=Path, help="folder to write (default: work/<profile>/miniature)")
    with exit_on_input_error():
        given = parser.parse_args(arguments)
        settings = load_profile(given.profile)
        if settings.world is None:
            raise InputError(f"profile {given.profile}: has no section `world`; choose tiny or miniature")
        out = given.out or REPOSITORY / "work" / settings.name / "miniature"
        make_world(settings.world, out)
        print(f"world: {out}")


if __name__ == "__main__":
    main()
