"""Keep what a run made: its results (`make publish`), its weights, its notebooks without what differs between runs (`make notebooks`)."""

import argparse
import ast
import base64
import json
import re
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from dualdepth.errors import InputError, exit_on_input_error
from dualdepth.files import atomic_path
from dualdepth.run import Run
from dualdepth.training.weights import HUB_CARD, save_weights

if TYPE_CHECKING:
    from torch import Tensor

LARGE = 10_000  # Numbers from which on a tensor is kept in 8 bits.
PICTURE_WIDTH = 900
"""Pixels that a picture in a published notebook has at most."""
LIMITS = (
    "In a street seen from a car, road, facades, near objects and the open distance can be told apart, most poles, cars farther off and"
    " outlines cannot; upright photos, people close by and rooms come out wrong."
)
PLOTS = ("backbone_cost", "error_by_time", "odometry_motions", "odometry_trajectories")  # Figures without a frame in them.
LICENCE = "CC BY-NC-SA 3.0, as KITTI's images from which they were learned, for non-commercial research"


def publish_results(profile: str) -> int:
    """Copy tables, figures and executed notebooks of `results/<profile>/` to `results/published/<profile>/`; pictures of real frames stay
    out. Among the tables is `by_seed`, the scores of each training.

    Raises:
        InputError: the profile has no results yet, or some were made by code that was not committed.
    """
    run = Run(profile)
    run.require(run.results / "tables" / "main.json", "05_table_main")
    if failed := sorted((run.results / "notebooks").glob("*.failed.ipynb")):
        raise InputError(
            f"{failed[0]}: this notebook failed; run the chain to its end, or delete this file if its seed is not wanted any more"
        )
    save_by_seed(run)
    dirty = [p.name for p in sorted(run.results.glob("*/*.json")) if json.loads(p.read_text(encoding="utf-8"))["dirty"]]
    if dirty:
        raise InputError(f"{run.results}: {', '.join(dirty)} were made by code that was not committed; commit it and run again")
    target = run.root / "results" / "published" / run.profile.name
    shutil.rmtree(target, ignore_errors=True)
    for path in (path for folder in ("tables", "figures") for path in (run.results / folder).glob("*.*")):
        # frames of real data sets are not ours to publish
        if run.profile.world or path.parent.name == "tables" or path.stem in PLOTS:
            (target / path.parent.name).mkdir(parents=True, exist_ok=True)
            shutil.copy2(path, target / path.parent.name)
    if run.profile.name != "tiny":  # whose executed notebooks are the stored ones
        for path in sorted((run.results / "notebooks").glob("*.ipynb")):
            _store(path, target / "notebooks" / path.name, "small" if run.profile.world else "none")
    files = sum(path.is_file() for path in target.rglob("*"))
    print(f"{target.relative_to(run.root)}: {files} files")
    return files


def save_by_seed(run: Run) -> None:
    """Write the mean scores of each training to the tables `by_seed`: those that the tables of the paper give the mean of."""
    import pandas as pd

    from dualdepth.evaluation.depth import METRICS

    seeds = json.loads((run.results / "tables" / "main.json").read_text(encoding="utf-8")).get("seeds", run.profile.seeds)
    trainings = [(variant, seed) for variant in run.profile.train for seed in seeds]
    scores = {name: path for name in trainings if (path := run.training(*name) / "per_image.csv").exists()}
    if scores:
        means = pd.DataFrame({name: pd.read_csv(path)[[*METRICS]].mean() for name, path in scores.items()}).T
        run.save_table(means.rename_axis(["variant", "seed"]).reset_index(), "by_seed", scores.values())


def publish_weights(profile: str) -> None:
    """Put the dual network of a profile's first seed into the package, in 8 bits, with its scores and licence on the card.

    Raises:
        InputError: there is no trained dual network or no main table yet, or the numbers are not those of one training from KITTI's
            frames, scored on drives that it did not see.
    """
    import pandas as pd

    from dualdepth.model import RELEASED, WEIGHTS, load

    run = Run(profile)
    table = pd.read_csv(run.require(run.results / "tables" / "main.csv", "05_table_main")).query("source == 'measured'")
    row = table[table["method"] == run.profile.variant("dual").label].iloc[0]
    if run.profile.data.source != "kitti" or len(run.profile.seeds) > 1 or pd.notna(row["leak"]):
        raise InputError(f"{run.results}: only weights of one seed from KITTI come with the package, scored on drives they did not see")
    model = load(run.weights("dual", run.profile.seeds[0]), "cpu")
    scores = {name: float(row[name]) for name in ("abs_rel", "rmse", "a1")}
    model.card |= {
        "scores": scores,
        "scored_on": f"{int(row['n'])} frames of other drives of KITTI, on which the recipe was chosen",
        "limits": LIMITS,
        "licence": LICENCE,
    }
    shutil.rmtree(RELEASED, ignore_errors=True)  # a page that is there would be kept
    model.save_pretrained(RELEASED)
    card = {key: value for key, value in model.card.items() if key != "sha256"}
    save_weights(RELEASED / WEIGHTS, in_8_bits(model.state_dict()), card, HUB_CARD)
    page = RELEASED / "README.md"
    text = page.read_text(encoding="utf-8").replace("pipeline_tag", "license: cc-by-nc-sa-3.0\npipeline_tag", 1)
    names = {"abs_rel": "Abs Rel", "rmse": "RMSE (m)", "a1": "δ<1.25"}
    numbers = ", ".join(f"{names[name]} {value:.3f}" for name, value in scores.items())
    drives = "\n".join(f"- {drive}" for drive in model.card["drives"])
    text += f"\nScored on {card['scored_on']}, each scaled by its median: {numbers}. Expect worse on others.\n"
    text += f"\nLearned from these drives of KITTI:\n\n{drives}\n"
    page.write_text(text, encoding="utf-8")
    print(f"{RELEASED}: {sum(path.stat().st_size for path in RELEASED.iterdir()) / 1e6:.1f} MB")


def in_8_bits(tensors: dict[str, "Tensor"]) -> dict[str, "Tensor"]:
    """Tensors for a file of a quarter of the size: large ones as whole numbers of steps, from −127 to 127, where each output channel has a
    step size of its own, `<name>.step`. A weight moves by at most half a step, a 254th of its channel's largest."""
    import torch

    large = {name: tensor for name, tensor in tensors.items() if tensor.numel() >= LARGE}
    steps = {n: t.abs().amax(dim=tuple(range(1, t.ndim)), keepdim=True).clamp(min=1e-12) / 127 for n, t in large.items()}
    rounded = {name: (tensor / steps[name]).round().to(torch.int8) for name, tensor in large.items()}
    return tensors | rounded | {f"{name}.step": step for name, step in steps.items()}


def publish_notebooks() -> int:
    """Store the executed copies of `results/tiny/notebooks` as `notebooks/`, without what differs from run to run.

    Raises:
        InputError: no copy of a notebook has the parameters that are written in it.
    """
    run = Run("tiny")
    sources = sorted((run.root / "notebooks").glob("*.ipynb"))
    for source in sources:
        _store(_default_copy(source, run.results / "notebooks"), source)
    print(f"notebooks: {len(sources)} stored")
    return len(sources)


def _default_copy(source: Path, folder: Path) -> Path:
    """The executed copy of a notebook that had the parameters which are written in it."""
    import papermill

    defaults = {k: str(ast.literal_eval(v["default"])) for k, v in papermill.inspect_notebook(str(source)).items()}
    for copy in sorted(set(folder.glob(f"{source.stem}*.ipynb")) - set(folder.glob("*.failed.ipynb"))):
        given = json.loads(copy.read_text(encoding="utf-8"))["metadata"]["papermill"]["parameters"]
        if all(str(given[k]) == v for k, v in defaults.items() if k in given):
            return copy
    raise InputError(f"{folder}: holds no copy of {source.name} with its own parameters; run `make reproduce` first")


def _store(executed: Path, target: Path, pictures: str = "as they are") -> None:
    """Write an executed notebook without papermill's traces and the checkout's place, with cells, ids and styled tables numbered anew.

    `pictures` are kept as they are, `small` or, for real frames, `none` of them.
    """
    import nbformat

    notebook = nbformat.read(executed, as_version=4)
    notebook.cells = [cell for cell in notebook.cells if "injected-parameters" not in cell.metadata.get("tags", [])]
    for part in (notebook, *notebook.cells):
        for key in ("papermill", "widgets", "execution"):
            part.metadata.pop(key, None)
    for number, cell in enumerate(notebook.cells):
        if pictures != "as they are" and "parameters" in cell.metadata.get("tags", []):  # the stored ones name tiny
            cell.source = cell.source.replace('profile = "tiny"', f'profile = "{executed.parents[1].name}"')
        cell.id = f"{executed.stem[:2]}-{number:02d}"
    for count, cell in enumerate((cell for cell in notebook.cells if cell.cell_type == "code"), 1):
        cell.execution_count = count
        for place, output in enumerate(cell.outputs):
            data = output.get("data", {})
            if "execution_count" in output:
                output.execution_count = count
            if html := data.get("text/html"):  # pandas draws a name for each styled table
                data["text/html"] = re.sub(r"\bT_[0-9a-f]{5}(?=\b|_)", f"T_{count}_{place}", html)
            if pictures == "small" and "image/png" in data:
                data["image/jpeg"] = _small_jpeg(data.pop("image/png"))
        if pictures == "none":
            cell.outputs = [output for output in cell.outputs if _is_text(output.get("data", {}))]
    checkout = f"{executed.resolve().parents[3]}/"  # messages name files by their whole path
    with atomic_path(target) as partial:
        partial.write_text(nbformat.writes(notebook).replace(checkout, "") + "\n", encoding="utf-8")


def _is_text(data: dict[str, str]) -> bool:
    """Whether an output has no picture in it, in whatever format."""
    return {*data} <= {"text/plain", "text/html", "text/markdown"} and not re.search(r"<(img|svg|image|iframe)|data:image", str(data))


def _small_jpeg(png: str) -> str:
    """A picture, both in base64, as JPEG of at most `PICTURE_WIDTH` pixels: a tenth of the bytes."""
    import cv2
    import numpy as np

    picture = cv2.imdecode(np.frombuffer(base64.b64decode(png), np.uint8), cv2.IMREAD_COLOR)
    scale = min(1.0, PICTURE_WIDTH / picture.shape[1])
    picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return base64.b64encode(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]).decode()


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Keep what a run made.")
    parser.add_argument("what", choices=("results", "notebooks", "weights"))
    parser.add_argument("--profile", default="miniature")
    arguments = parser.parse_args(argv)
    with exit_on_input_error():
        keep = {"results": publish_results, "weights": publish_weights}
        publish_notebooks() if arguments.what == "notebooks" else keep[arguments.what](arguments.profile)
    return 0


if __name__ == "__main__":
    sys.exit(main())
