"""From footage to drives: which frames belong together, how many are skipped between two, and whether anything can be learned of them."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from data_scripts.own.motion import AIM, CLOSE, TRAVELS, USEFUL, Motion, MotionMeter, small_copy
from dualdepth.data.frames import Footage

FEWEST = 30
"""Frames, at least: what is learned from fewer is those frames."""
MOST_STRIDE = 30
NOISE = 0.0003
"""Flow, as a share of the width, that noise alone gives."""
MOST_CUTS = 0.2
"""Share of neighbours that may not show the same place."""
HELD_OUT = 0.1
"""Share of the frames that is kept for pictures, from the end."""
APART = 3
"""Frames left out between those that are trained on and those held out."""


class Neighbours(NamedTuple):
    """Two frames that follow each other."""

    footage: int
    """Place among the footages."""
    before: int
    after: int
    motion: Motion | None
    """None: frames between them are missing."""


class Drive(NamedTuple):
    """Frames that follow each other without a break."""

    footage: int
    numbers: tuple[int, ...]


class Check(NamedTuple):
    """One thing that had to be so."""

    name: str
    passed: bool
    said: str
    """What was found, and what to do."""


class Film(NamedTuple):
    """What was found in some footages."""

    stride: int
    drives: list[Drive]
    counts: dict[str, int]
    """read, used, standing, gaps, cuts, short."""
    medians: dict[str, float]
    """flow (share of the width), agrees, travels, of neighbours that moved."""
    checks: list[Check]


def examine(footages: Sequence[Footage], focal: float, stride: int | None = None) -> Film:
    """Measure the motion between neighbours and cut the footages into drives where it stands still, jumps or misses frames.

    Args:
        footages: of one camera.
        focal: focal length as a share of the frame's width.
        stride: take every n-th frame; None: so many that the median flow is about `AIM`.

    Raises:
        InputError: a frame cannot be read, or is of another size.
    """
    pairs = list(measured(footages, focal, stride or 1))
    if stride is None and (stride := fitting_stride(pairs)) > 1:
        pairs = list(measured(footages, focal, stride))
    drives, counts = cut_at_breaks(pairs)
    moved = [p.motion for p in pairs if p.motion and p.motion.same_place and not p.motion.static]
    values = np.array(moved, float).reshape(-1, 3)
    medians = {name: round(float(np.median(values[:, k])), 4) if moved else 0.0 for k, name in enumerate(Motion._fields)}
    medians["agrees"] = round(float(np.median([p.motion.agrees for p in pairs if p.motion and not p.motion.static] or [0.0])), 4)
    return Film(stride, drives, counts, medians, list(checks(pairs, drives, counts, medians, stride)))


def measured(footages: Sequence[Footage], focal: float, stride: int) -> Iterator[Neighbours]:
    """Motion between every `stride`-th frame and the next such."""
    meter = MotionMeter(focal)
    with tqdm(total=sum(f.length for f in footages) // stride, desc=f"motion, stride {stride}", unit="frame", disable=None) as bar:
        for place, footage in enumerate(footages):
            last, copy = None, None
            for still in footage.stills(range(0, 10**9, stride)):
                number, image = still.number, small_copy(still.image)
                if last is not None:
                    yield Neighbours(place, last, number, meter(copy, image) if number - last == stride else None)
                last, copy = number, image
                bar.update()


def fitting_stride(pairs: Sequence[Neighbours]) -> int:
    """Stride at which the median flow of neighbours that move comes to about `AIM`, but not above it."""
    flows = [p.motion.flow for p in pairs if p.motion and p.motion.same_place and p.motion.flow > NOISE]
    return int(np.clip(AIM / np.median(flows), 1, MOST_STRIDE)) if flows else 1


def cut_at_breaks(pairs: Sequence[Neighbours]) -> tuple[list[Drive], dict[str, int]]:
    """Drives of at least three frames between the breaks, and what was left out, counted in frames and breaks."""
    runs: list[list[tuple[int, int]]] = []
    standing: set[tuple[int, int]] = set()
    counts = {"gaps": 0, "cuts": 0}
    for pair in pairs:
        before, after = (pair.footage, pair.before), (pair.footage, pair.after)
        if not runs or runs[-1][-1] != before:
            runs.append([before])
        if pair.motion is None:
            counts["gaps"] += 1
        elif not pair.motion.same_place:
            counts["cuts"] += 1
        elif pair.motion.static:
            standing |= {before, after}
        else:
            runs[-1].append(after)
            continue
        runs.append([after])
    used = [run for run in runs if len(run) >= 3]
    left = [frame for run in runs if len(run) < 3 for frame in run]
    counts |= {"read": sum(map(len, runs)), "used": sum(map(len, used)), "standing": len(standing.intersection(left))}
    counts["short"] = len(left) - counts["standing"]
    return [Drive(run[0][0], tuple(number for _, number in run)) for run in used], counts


def checks(
    pairs: Sequence[Neighbours], drives: Sequence[Drive], counts: dict[str, int], medians: dict[str, float], stride: int
) -> Iterator[Check]:
    """The checks in the order in which a failure explains the next; each says what to do."""
    read, slower = counts["read"], f"lower --stride {stride}, " if stride > 1 else ""
    yield Check("frames", read >= FEWEST, f"{read} frames at stride {stride}, at least {FEWEST} are needed: {slower}film longer")
    still = sum(bool(p.motion and p.motion.static) for p in pairs)
    yield Check(
        "moves",
        still < len(pairs) or not pairs,
        f"the camera stands still in {still} of {len(pairs)} pairs of neighbours: film while driving",
    )
    jumps = counts["cuts"] / max(len(pairs) - still - counts["gaps"], 1)
    closer = f"{slower}take every frame of the video, film at more frames a second, or drive slower"
    yield Check("consecutive", jumps <= MOST_CUTS, f"{jumps:.0%} of the neighbours do not show the same place: {closer}")
    yield Check("close", medians["agrees"] >= CLOSE, f"only {medians['agrees']:.0%} of a median frame is found again in the next: {closer}")
    flow = f"the picture moves by {medians['flow']:.2%} of its width from frame to frame"
    yield Check("not too fast", medians["flow"] <= USEFUL[1], f"{flow}, at most {USEFUL[1]:.1%} can be learned from: {closer}")
    more = "leave --stride out, drive faster, or film what is nearer"
    yield Check("motion", medians["flow"] >= USEFUL[0], f"{flow}, at least {USEFUL[0]:.1%} is needed: {more}")
    yield Check(
        "travels",
        medians["travels"] >= TRAVELS,
        f"only {medians['travels']:.0%} of the motion is more than turning: drive or walk, do not pan, since a turn says nothing of depth",
    )
    used = sum(len(d.numbers) for d in drives)
    yield Check(
        "long drives",
        used >= FEWEST * 2 // 3,
        f"{used} of {read} frames are left in drives of three or more ({counts['standing']} stand still, {counts['gaps']} gaps,"
        f" {counts['cuts']} cuts): film longer without a stop",
    )


def hold_out(drives: Sequence[Drive], count: int | None = None) -> tuple[list[Drive], Drive]:
    """Drives to train on, and frames that are held out: the end of the last drive that is long enough, else of the longest.

    Args:
        drives: at least one, in order.
        count: frames to hold out; None: `HELD_OUT` of all, 3 to 40.
    """
    asked = count or int(np.clip(round(HELD_OUT * sum(len(d.numbers) for d in drives)), 3, 40))
    enough = [d for d in drives if len(d.numbers) >= 3 * (asked + APART)]
    chosen = enough[-1] if enough else max(reversed(drives), key=lambda d: len(d.numbers))
    held = max(1, min(asked, (len(chosen.numbers) - APART) // 2))
    kept = Drive(chosen.footage, chosen.numbers[: max(0, len(chosen.numbers) - held - APART)])
    train = [kept if d is chosen else d for d in drives]
    return [d for d in train if len(d.numbers) >= 3], Drive(chosen.footage, chosen.numbers[-held:])


def record(film: Film) -> dict[str, Any]:
    """Stride, counts, medians and checks as JSON."""
    values = {"stride": film.stride, "frames": film.counts, "median_motion": film.medians}
    return values | {"checks": {c.name: "passed" if c.passed else f"FAILED: {c.said}" for c in film.checks}}
