"""What is kept of a run: no results of code that was not committed, no real frames, and the notebooks as they are by default."""

import base64
import json

import cv2
import nbformat
import numpy as np
import pandas as pd
import pytest

from dualdepth.errors import InputError
from dualdepth.evaluation.depth import METRICS
from dualdepth.model import DepthModel, load
from dualdepth.profile import PROFILES
from dualdepth.run import Run
from tools.publish import publish_notebooks, publish_results, publish_weights

KITTI = "about: x\ndata:\n  source: kitti\n  train_list: eigen_zhou\n"


@pytest.fixture
def project(checkout, monkeypatch):
    monkeypatch.chdir(checkout)
    return checkout


@pytest.fixture
def results_of(project):
    """Makes results of a profile: a table and a figure with their stamps, and an executed notebook."""

    def make(profile, dirty=()):
        run = Run(profile)
        for file in (
            "tables/main.csv",
            "tables/ablation.csv",
            "figures/main_depth.png",
            "figures/backbone_cost.png",
            "notebooks/05.ipynb",
        ):
            path = run.results / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"of {file}")
            if path.suffix != ".ipynb":
                path.with_suffix(".json").write_text(json.dumps({"dirty": path.stem in dirty}))
        return run

    return make


def published(project, profile="tiny"):
    folder = project / "results" / "published" / profile
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def pictures():
    """A cell's outputs that are pictures."""
    kinds = {"image/png": "aaaa", "image/jpeg": "aaaa", "image/svg+xml": "<svg/>", "text/html": "<p><img src='data:image/png;base64,aaaa'>"}
    return [nbformat.v4.new_output("display_data", {kind: data, "text/plain": "a picture"}) for kind, data in kinds.items()]


def said(text):
    """A cell's output that is text."""
    return nbformat.v4.new_output("stream", text=text)


TABLES = {"tables/main.csv", "tables/main.json", "tables/ablation.csv", "tables/ablation.json"}
PLOTS = {"figures/backbone_cost.png", "figures/backbone_cost.json"}
FIGURES = {"figures/main_depth.png", "figures/main_depth.json"} | PLOTS


def test_tables_and_figures_of_a_made_world_are_kept_with_their_stamps_and_older_ones_go(project, results_of):
    results_of("tiny")
    old = project / "results/published/tiny/tables/old.csv"
    old.parent.mkdir(parents=True)
    old.touch()
    assert publish_results("tiny") == 8
    assert published(project) == TABLES | FIGURES
    assert (project / "results/published/tiny/tables/main.csv").read_text() == "of tables/main.csv"
    (project / "own.yaml").write_text(KITTI)  # pictures of real frames stay out
    run = results_of(str(project / "own.yaml"))
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("show()", outputs=[*pictures(), said("of the frames")])])
    nbformat.write(notebook, run.results / "notebooks/05.ipynb")
    scores = run.training("lr", 0) / "per_image.csv"
    scores.parent.mkdir(parents=True)
    pd.DataFrame({name: [1.0, 2.0] for name in METRICS}, index=pd.RangeIndex(2, name="image")).to_csv(scores)
    assert publish_results(str(project / "own.yaml")) == 9
    assert published(project, "own") == TABLES | PLOTS | {"tables/by_seed.csv", "tables/by_seed.json", "notebooks/05.ipynb"}
    kept = project / "results/published/own"
    outputs = nbformat.read(kept / "notebooks/05.ipynb", 4).cells[0].outputs
    assert [output["output_type"] for output in outputs] == ["stream"]
    row = pd.read_csv(kept / "tables/by_seed.csv").iloc[0]
    assert (row["variant"], row["seed"]) == ("lr", 0) and (row[[*METRICS]] == 1.5).all()


def test_scores_that_publishing_itself_would_write_from_uncommitted_code_are_refused_too(project, results_of, monkeypatch):
    run = results_of("tiny")
    scores = run.training("lr", 0) / "per_image.csv"
    scores.parent.mkdir(parents=True)
    pd.DataFrame({name: [1.0] for name in METRICS}).to_csv(scores)
    monkeypatch.setattr(Run, "_revision", {"revision": "x", "dirty": True})
    with pytest.raises(InputError, match=r"tiny: by_seed\.json were made by code that was not committed"):
        publish_results("tiny")
    assert not (project / "results/published").exists()


def test_results_beside_a_notebook_that_failed_are_refused(project, results_of):
    run = results_of("tiny")
    (run.results / "notebooks/09_x.failed.ipynb").touch()
    with pytest.raises(InputError, match=r"09_x\.failed\.ipynb: this notebook failed; run the chain to its end"):
        publish_results("tiny")


def test_results_of_code_that_was_not_committed_are_refused_by_name(project, results_of):
    kept = project / "results/published/tiny/tables/main.csv"
    kept.parent.mkdir(parents=True)
    kept.write_text("kept")
    results_of("tiny", ("ablation", "main_depth"))
    with pytest.raises(InputError, match=r"tiny: main_depth\.json, ablation\.json were made by code that was not committed; commit it"):
        publish_results("tiny")
    assert kept.read_text() == "kept"


@pytest.mark.parametrize(("kitti", "leak"), [(True, ""), (True, "LEAK"), (False, "")])
def test_weights_of_kitti_alone_come_with_the_package_with_scores_and_licence(project, monkeypatch, tmp_path, capsys, kitti, leak):
    monkeypatch.setattr("dualdepth.model.RELEASED", tmp_path / "released")
    (project / "own.yaml").write_text(KITTI)
    profile = str(project / "own.yaml") if kitti else "tiny"
    run, model = Run(profile), DepthModel({"network": "hr", "hr_size": [192, 288], "about": "nothing", "drives": ["a"]}, device="cpu")
    model.save_pretrained(run.weights("dual", 0).parent)
    (run.results / "tables").mkdir(parents=True)
    row = f'"{run.profile.variant("dual").label}",0.2,5.0,0.7,26,{leak},measured'
    (run.results / "tables/main.csv").write_text(f"method,abs_rel,rmse,a1,n,leak,source\n{row}\n")
    if leak or not kitti:
        with pytest.raises(InputError, match="only weights of one seed from KITTI come with the package"):
            publish_weights(profile)
        return
    publish_weights(profile)
    found = load(tmp_path / "released")
    page = (tmp_path / "released/README.md").read_text()
    assert "license: cc-by-nc-sa-3.0" in page.split("---")[1] and "Abs Rel 0.200, RMSE (m) 5.000, δ<1.25 0.700" in page
    assert found.card["scores"] == {"abs_rel": 0.2, "rmse": 5.0, "a1": 0.7} and "26 frames" in found.card["scored_on"]
    assert "CC BY-NC-SA 3.0" in found.about and f"the package's own weights: {found.about}" in capsys.readouterr().err
    assert (tmp_path / "released/model.safetensors").stat().st_size < 0.3 * 4 * sum(p.numel() for p in model.parameters())


def write_notebook(path, output=None, parameters=None):
    """A notebook; an executed one has an output and the parameters that papermill was given."""
    cells = [
        nbformat.v4.new_markdown_cell("# A table"),
        nbformat.v4.new_code_cell('profile = "tiny"  # or another\nseed = 0', metadata={"tags": ["parameters"]}),
        nbformat.v4.new_code_cell("print(seed)"),
    ]
    metadata = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    if output:
        cells.insert(2, nbformat.v4.new_code_cell("seed = 0", metadata={"tags": ["injected-parameters"]}))
        ran = {"outputs": [nbformat.v4.new_output("stream", text=output)], "execution_count": 9}
        cells[-1] = nbformat.v4.new_code_cell("print(seed)", metadata={"papermill": {"duration": 1.5}}, **ran)
        metadata["papermill"] = {"parameters": parameters}
    path.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(nbformat.v4.new_notebook(cells=cells, metadata=metadata), path)


def test_the_copy_that_ran_with_the_notebooks_own_parameters_is_stored(project):
    source, executed = project / "notebooks" / "05_a.ipynb", project / "results/tiny/notebooks"
    write_notebook(source)
    write_notebook(executed / "05_a-dual-seed1.ipynb", "of seed 1", {"profile": "tiny", "seed": 1})
    write_notebook(executed / "05_a-other.ipynb", "of another profile", {"profile": "other", "seed": 0})
    before = source.read_bytes()
    with pytest.raises(InputError, match=r"holds no copy of 05_a\.ipynb with its own parameters; run `make reproduce` first"):
        publish_notebooks()
    assert source.read_bytes() == before
    write_notebook(executed / "05_a-seed0.ipynb", f"{project}/of the defaults", {"profile": "tiny", "seed": 0, "beside": 5})
    assert publish_notebooks() == 1
    stored = nbformat.read(source, as_version=4)
    assert [cell["outputs"][0]["text"] for cell in stored.cells if cell.get("outputs")] == ["of the defaults"]
    assert "papermill" not in stored.metadata and "papermill" not in stored.cells[-1].metadata
    assert [cell.id for cell in stored.cells] == ["05_a"[:2] + f"-0{n}" for n in range(3)]  # what was injected is gone
    assert [cell.execution_count for cell in stored.cells if cell.cell_type == "code"] == [1, 2]


def test_executed_notebooks_of_a_world_that_learned_are_kept_with_small_pictures(project, results_of):
    (project / "world.yaml").write_text((PROFILES / "tiny.yaml").read_text())
    profile = str(project / "world.yaml")
    results_of(profile)
    picture = np.random.default_rng(0).integers(0, 255, (60, 2000, 3), np.uint8)
    png = base64.b64encode(cv2.imencode(".png", picture)[1].tobytes()).decode()
    cell = nbformat.v4.new_code_cell("show()", outputs=[nbformat.v4.new_output("display_data", {"image/png": png})])
    executed = project / "results/world/notebooks/05_a.ipynb"
    (executed.parent / "05.ipynb").unlink()
    nbformat.write(nbformat.v4.new_notebook(cells=[cell]), executed)
    publish_results(profile)
    stored = nbformat.read(project / "results/published/world/notebooks/05_a.ipynb", as_version=4)
    assert set(stored.cells[0].outputs[0].data) == {"image/jpeg"}
    small = cv2.imdecode(np.frombuffer(base64.b64decode(stored.cells[0].outputs[0].data["image/jpeg"]), np.uint8), cv2.IMREAD_COLOR)
    assert small.shape == (27, 900, 3)
