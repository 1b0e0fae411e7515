"""From footage to drives: which frames belong together, how many are skipped between two, and whether anything can be learned of them.

Motion is optical flow on small copies (T. Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016, by OpenCV). The
bounds were set on KITTI at 10 Hz: drive 0095 and another in grey, sequences 02 and 06.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import pandas as pd
from tqdm import tqdm

from data_scripts.own.footage import Footage

FEWEST, FEWEST_USED = 30, 20  # Frames, at least, and of these in drives: what is learned from fewer is those frames.
MOST_STRIDE = 30
MOST_CUTS = 0.2  # share of neighbours that may not show the same place
HELD_OUT = 0.1  # share of the frames that is kept for pictures, from the end
APART = 3  # frames left out between those that are trained on and those held out
WIDTH = 256  # pixels of the small copies
STATIC = 0.001  # flow, as a share of the width, below which the camera stands still: a quarter of a small pixel
NOISE = 0.0003  # flow, as a share of the width, that noise alone may give; it gives 0.0002
USEFUL = (0.004, 0.03)
"""Median flow that a data set may have. KITTI's drives have 0.008 to 0.013, with 0.004 and 0.03 as their slowest and fastest pairs."""
AIM = 0.012  # median flow that a stride is chosen for: KITTI's at 10 Hz
SAME_PLACE = 0.3
"""Share of pixels whose flow forth and back agrees, below which two frames are no neighbours: KITTI's have at least 0.5, frames that do
not belong together at most 0.27."""
CLOSE = 0.45  # The same of a data set's median pair, at least: KITTI has 0.8, every second frame of it 0.6, every fourth 0.35 to 0.43.
TRAVELS = 0.15  # Share of the median flow that no turn of the camera explains, at least: KITTI has 0.8, a camera that only turns 0.04.
LINKS = {"moving": "moves", "still": "still", "cuts": "cut", "gaps": "gap"}
"""Names of the counts of pairs of neighbours, and the links that they count."""


class Motion(NamedTuple):
    """From one frame to another."""

    flow: float  # median length of the flow, as a share of the width
    agrees: float  # share of pixels whose flow forth and back agrees
    travels: float  # median length of what no turn of the camera explains, as a share of the median flow; NaN where nothing agrees

    @property
    def link(self) -> str:
        """`cut` (the two do not show the same place), `still` (the camera stood between them) or `moves`."""
        return "cut" if self.agrees < SAME_PLACE else "still" if self.flow < STATIC else "moves"


def small_copy(image: np.ndarray) -> np.ndarray:
    """Grey copy (h, WIDTH) uint8 of an image (H, W, 3)."""
    height = max(16, round(image.shape[0] * WIDTH / image.shape[1]))
    return cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (WIDTH, height), interpolation=cv2.INTER_AREA)


def motion(before: np.ndarray, after: np.ndarray, focal: float) -> Motion:
    """Motion from one small copy to the next of the same size; `focal` is the focal length as a share of the frame's width."""
    meter = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    forth, back = meter.calc(before, after, None), meter.calc(after, before, None)
    rows, columns = np.mgrid[: before.shape[0], : before.shape[1]].astype(np.float32)
    target = columns + forth[..., 0], rows + forth[..., 1]
    returned = cv2.remap(back, *target, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1e3, 1e3))
    length = np.linalg.norm(forth, axis=-1)
    agreeing = np.linalg.norm(forth + returned, axis=-1) < 0.5 + 0.1 * length
    if agreeing.sum() < 64:
        return Motion(float(np.median(length)) / WIDTH, float(agreeing.mean()), float("nan"))
    flow = float(np.median(length[agreeing]))
    x, y = (columns[agreeing] - before.shape[1] / 2) / (focal * WIDTH), (rows[agreeing] - before.shape[0] / 2) / (focal * WIDTH)
    left = _not_turned(x, y, forth[agreeing], focal * WIDTH)
    return Motion(flow / WIDTH, float(agreeing.mean()), left / max(flow, 1e-6))


def _not_turned(x: np.ndarray, y: np.ndarray, flow: np.ndarray, focal: float) -> float:
    """Median length, in pixels, of flow (N, 2) along rays (x, y, 1) that is left without the small rotation that explains most of it.

    A rotation's flow does not depend on depth (H. C. Longuet-Higgins and K. Prazdny, 1980); fitted by reweighted least squares.
    """
    chosen = slice(None, None, max(1, len(flow) // 2000))
    x, y, target = x[chosen], y[chosen], flow[chosen]
    # (N, 2, 3): flow per unit of the rotation vector
    turning = focal * np.stack([np.stack([x * y, -(1 + x**2), y], -1), np.stack([1 + y**2, -x * y, -x], -1)], -2)
    left, weight = target, np.ones(len(target), np.float32)
    for _ in range(5):
        weighted = (turning * weight[:, None, None]).reshape(-1, 3)
        rotation = np.linalg.lstsq(weighted, (target * weight[:, None]).ravel(), rcond=None)[0]
        left = target - turning @ rotation
        weight = 1 / np.sqrt(np.maximum(np.linalg.norm(left, axis=-1), 0.05))
    return float(np.median(np.linalg.norm(left, axis=-1)))


class Drive(NamedTuple):
    """Frames that follow each other without a break."""

    footage: int
    numbers: tuple[int, ...]


class Film(NamedTuple):
    """What was found in some footages."""

    stride: int
    drives: list[Drive]
    counts: dict[str, int]  # frames: read, used, standing, short (in pieces of fewer than three); pairs of neighbours: those of `LINKS`
    medians: dict[str, float]  # flow (share of the width), agrees, travels, of neighbours that moved
    checks: dict[str, str]
    """By the names of the checks, in the order in which a failure explains the next: what was found and what to do; empty: passed."""


def examine(footages: Sequence[Footage], focal: float, stride: int | None = None) -> Film:
    """Measure the motion between neighbours and cut the footages into drives where it stands still, jumps or misses frames.

    Args:
        footages, focal: of one camera, and its focal length as a share of the frame's width.
        stride: take every n-th frame; None: so many that the median flow comes to about `AIM`, but not above it.

    Raises:
        InputError: a frame cannot be read, or is of another size.
    """
    frames, given = measured(footages, focal, stride or 1), stride is not None
    if not given:
        flows = frames.flow[(frames.agrees >= SAME_PLACE) & (frames.flow > NOISE)]
        stride = int(np.clip(AIM / flows.median(), 1, MOST_STRIDE)) if len(flows) else 1
        frames = measured(footages, focal, stride) if stride > 1 else frames
    drives, counts = cut_at_breaks(frames)
    medians = frames[frames.link == "moves"][list(Motion._fields)].median()
    medians["agrees"] = frames.agrees[frames.link.isin(["moves", "cut"])].median()
    medians = medians.fillna(0.0).round(4).to_dict()
    return Film(stride, drives, counts, medians, checks(counts, medians, stride, given))


def measured(footages: Sequence[Footage], focal: float, stride: int) -> pd.DataFrame:
    """Every `stride`-th frame, a row each: its `footage`'s place, its `number`, its `link` to the frame before and the motion since then.

    A link is one of `Motion`'s, or `first`, or `gap` where frames between the two are missing; these two have no motion (NaN).
    """
    rows = []
    with tqdm(total=sum(f.length for f in footages) // stride, desc=f"motion, stride {stride}", unit="frame", disable=None) as bar:
        for place, footage in enumerate(footages):
            last, copy = None, None
            for still in footage.stills(range(0, 10**9, stride)):
                number, image = still.number, small_copy(still.image)
                moved = motion(copy, image, focal) if last is not None and number - last == stride else None
                link = moved.link if moved else "first" if last is None else "gap"
                rows.append((place, number, link, *(moved or [np.nan] * 3)))
                last, copy = number, image
                bar.update()
    return pd.DataFrame(rows, columns=["footage", "number", "link", *Motion._fields])


def cut_at_breaks(frames: pd.DataFrame) -> tuple[list[Drive], dict[str, int]]:
    """Drives of at least three frames between the breaks of `measured` frames, and `Film.counts`."""
    run = (frames.link != "moves").cumsum()
    used = run.groupby(run).transform("size") >= 3
    drives = [Drive(int(d.footage.iloc[0]), tuple(d.number.tolist())) for _, d in frames[used].groupby(run[used])]
    still = frames.link == "still"
    standing = int(((still | still.shift(-1, fill_value=False)) & ~used).sum())
    counts = {"read": len(frames), "used": int(used.sum()), "standing": standing, "short": int((~used).sum()) - standing}
    return drives, counts | {name: int((frames.link == link).sum()) for name, link in LINKS.items()}


def checks(counts: dict[str, int], medians: dict[str, float], stride: int, given: bool) -> dict[str, str]:
    """`Film.checks`; `given` says whether the user chose the stride."""
    flow, agrees, travels, found = medians["flow"], medians["agrees"], medians["travels"], {}
    slower = f"lower --stride {stride}, " if given and stride > 1 else ""
    closer = f"{slower}take every frame of the video, film at more frames a second, or drive slower"
    if pairs := sum(counts[name] for name in LINKS):
        said = f"the camera stands still in {counts['still']} of {pairs} pairs of neighbours: film while driving"
        found["moves"] = counts["still"] == pairs, said
        jumps = counts["cuts"] / max(counts["cuts"] + counts["moving"], 1)
        said = f"{jumps:.0%} of the neighbours do not show the same place, and {agrees:.0%} of a median frame is found again in the next"
        found["consecutive"] = jumps > MOST_CUTS or agrees < CLOSE, f"{said}: {closer}"
        said = f"the picture moves by {flow:.2%} of its width from frame to frame, {USEFUL[0]:.1%} to {USEFUL[1]:.1%} is needed"
        mend = closer if flow > USEFUL[1] else f"{'leave --stride out, ' * given}drive faster, or film what is nearer"
        found["speed"] = not USEFUL[0] <= flow <= USEFUL[1], f"{said}: {mend}"
        said = f"only {travels:.0%} of the motion is more than turning: drive or walk, do not pan, since a turn says nothing of depth"
        found["travels"] = travels < TRAVELS, said
    lost = f"{counts['standing']} stand still, {counts['gaps']} gaps, {counts['cuts']} cuts"
    said = f"{counts['read']} frames at stride {stride}, {counts['used']} of them in drives of three or more ({lost})"
    mend = f"{FEWEST} and {FEWEST_USED} are needed: {slower}film longer without a stop"
    found["frames"] = counts["read"] < FEWEST or counts["used"] < FEWEST_USED, f"{said}; {mend}"
    return {name: said if failed else "" for name, (failed, said) in found.items()}


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
    kept = chosen._replace(numbers=chosen.numbers[: max(0, len(chosen.numbers) - held - APART)])
    train = [kept if d is chosen else d for d in drives]
    return [d for d in train if len(d.numbers) >= 3], chosen._replace(numbers=chosen.numbers[-held:])
