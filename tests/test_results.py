"""What makes a result stale, what is said of a missing one, and what stands in its stamp."""

import hashlib
import json

import pandas as pd
import pytest

from dualdepth import run
from dualdepth.errors import InputError
from dualdepth.files import file_digest, folder_digest
from dualdepth.run import Run, project_root
from dualdepth.staleness import CODE, PACKAGE, code_digest, notebook_digest

SOURCE = '''"""A module."""

import math


def area(r):
    """Of a circle."""
    return math.pi * r**2  # in square metres
'''


@pytest.fixture
def digest_of(tmp_path, monkeypatch):
    """The digest of a step whose only module has the given source."""
    monkeypatch.setattr(run, "PACKAGE", tmp_path)
    monkeypatch.setattr(run, "CODE", {"step": ("parts",)})

    def digest(source, name="parts/circle.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(source)
        return code_digest("step")

    return digest


@pytest.fixture
def project(tmp_path, monkeypatch):
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "Snakefile").touch()
    (tmp_path / "environment.lock").write_text("torch==2.13.0\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("# in square metres", "# m²"),
        ('"""Of a circle."""', '"""Area of a circle of radius r."""'),
        ('"""A module."""\n', '"""Circles."""\n\n\n'),
        ("math.pi * r**2", "(math.pi\n            * r ** 2)"),
    ],
)
def test_comments_docstrings_and_layout_make_nothing_stale(digest_of, old, new):
    before = digest_of(SOURCE)
    assert old in SOURCE
    assert digest_of(SOURCE.replace(old, new)) == before


@pytest.mark.parametrize(("old", "new"), [("r**2", "r**3"), ("math.pi", "3.14"), ("area", "surface"), ("(r)", "(r=1)")])
def test_a_change_of_the_code_makes_results_stale(digest_of, old, new):
    before = digest_of(SOURCE)
    assert digest_of(SOURCE.replace(old, new)) != before


def test_a_new_file_beside_it_makes_results_stale(digest_of):
    before = digest_of(SOURCE)
    assert digest_of("def length(r): return r\n", "parts/length.py") != before


@pytest.mark.parametrize("step", CODE)
def test_the_modules_that_shape_a_step_are_where_the_list_says(step):
    for module in CODE[step]:
        base = PACKAGE.parent if module.startswith("data_scripts") else PACKAGE
        path = base / module.replace(".", "/")
        assert path.is_dir() or path.with_suffix(".py").is_file(), module
    assert code_digest(step) == code_digest(step)


def test_what_builds_a_network_and_what_draws_a_figure_make_their_steps_stale():
    assert "building" in CODE["train_lr"] and "figures" in CODE["tables"]


def test_the_root_is_found_from_below_and_asked_for_elsewhere(project, tmp_path_factory, monkeypatch):
    monkeypatch.chdir(project / "notebooks")
    assert project_root() == project
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    with pytest.raises(InputError, match="is not inside a dualdepth checkout"):
        project_root()


def test_a_missing_prerequisite_names_the_notebook_that_makes_it(project):
    run = Run("tiny")
    with pytest.raises(InputError, match=r"work/tiny/sources\.json is missing: run notebook 01_download_data with profile tiny first"):
        run.require(run.sources, "01_download_data")
    run.sources.parent.mkdir(parents=True)
    run.sources.touch()
    assert run.require(run.sources, "01_download_data") == run.sources


def test_a_table_is_written_with_a_stamp_that_says_what_made_it(project):
    run = Run("tiny")
    given = project / "input.csv"
    given.write_text("a\n1\n")
    path = run.save_table(pd.DataFrame({"abs_rel": [0.123456789]}), "main", [given], seeds=[0, 1])
    assert path == project / "results/tiny/tables/main.csv"
    assert path.read_text() == "abs_rel\n0.123457\n"
    stamp = json.loads(path.with_suffix(".json").read_text())
    assert stamp["profile"] == "tiny"
    assert stamp["seeds"] == [0, 1]
    assert stamp["inputs_sha256"] == {"input.csv": hashlib.sha256(b"a\n1\n").hexdigest()}
    assert stamp["lock_sha256"] == hashlib.sha256(b"torch==2.13.0\n").hexdigest()


def test_a_stamp_outside_of_git_says_that_the_revision_is_unknown(project):
    assert Run("tiny").stamp([])["revision"] == "unknown"


def test_a_recipe_changes_with_triplets_and_settings_that_shape_the_weights(project):
    def recipe(profile, triplets, identity="{}"):
        run = Run(profile)
        run.prepared.mkdir(parents=True, exist_ok=True)
        (run.prepared / "triplets.csv").write_text(triplets)
        (run.prepared / "identity.json").write_text(identity)
        return run.recipe("lr", 0)

    def own(name, training):
        path = project / f"{name}.yaml"
        path.write_text(f"about: x\ndata:\n  source: kitti\n  train_list: eigen_zhou\ntraining:\n{training}")
        return str(path)

    plain = recipe(own("a", "  workers: 1\n"), "x")
    assert recipe(own("b", "  workers: 3\n  log_every: 7\n"), "x") == plain
    assert recipe(own("a", "  workers: 1\n"), "y") != plain
    assert recipe(own("a", "  workers: 1\n"), "x", '{"frames": 1}') != plain
    for line in ("  lr: {batch_size: 2}\n", "  precision: float32\n", "  encoder: resnet18\n", "  loss: {feature: 0}\n"):
        assert recipe(own("c", line), "x") != plain


def test_stage_2_is_stale_when_stage_1_or_its_own_settings_change(project):
    def recipe(text="", weights="a", variant="dual", seed=0):
        path = project / "own.yaml"
        path.write_text(f"about: x\ndata:\n  source: kitti\n  train_list: eigen_zhou\n{text}")
        run = Run(str(path))
        for file, content in (
            (run.prepared / "triplets.csv", "x"),
            (run.prepared / "identity.json", "{}"),
            (run.weights("lr", 0), weights),
        ):
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(content)
        return run.recipe(variant, seed)

    plain = recipe()
    assert recipe(weights="b") != plain
    assert recipe(variant="dual_no_sa") != plain
    assert recipe(variant="dual_cosine") != plain
    assert recipe("training: {hr: {epochs: 3}}\n") != plain
    assert recipe("training: {lr: {epochs: 3}}\n") == plain  # what it did to LR-Net stands in LR-Net's weights
    assert recipe("train: {lr: , dual: {training.hr.max_steps: 9}}\n") != plain
    assert recipe("train: {lr: , dual: , hr_only: }\n") == plain
    lr = recipe(variant="lr")
    assert recipe("training: {hr: {epochs: 3}}\n", variant="lr") == lr


def test_a_notebooks_digest_is_blind_to_its_outputs(project):
    def write(source, outputs):
        cell = {"cell_type": "code", "source": source, "outputs": outputs, "metadata": {}}
        (project / "notebooks" / "00_a.ipynb").write_text(json.dumps({"cells": [cell]}))
        return notebook_digest("00_a")

    before = write(["x = 1\n", "x"], [])
    assert write(["x = 1\n", "x"], [{"text": "1"}]) == before
    assert write("x = 1\nx", []) == before
    assert write(["x = 2\n", "x"], []) != before


def test_a_file_that_is_not_there_has_no_digest(tmp_path):
    assert file_digest(tmp_path / "a") is None


def own_run(project, text):
    path = project / "own.yaml"
    path.write_text(f"about: x\ndata:\n  source: kitti\n  train_list: eigen_zhou\n{text}")
    return Run(str(path))


def test_a_table_is_made_from_the_weights_that_are_trained_the_scored_frames_and_their_truth(project):
    run = own_run(project, "train: {lr: , dual: }\n")
    assert [str(path.relative_to(run.work)) for path in run.scored_with(("lr", "dual_no_sa", "dual"), (0, 2))] == [
        "runs/lr/seed0/model.safetensors",
        "runs/lr/seed2/model.safetensors",
        "runs/dual/seed0/model.safetensors",
        "runs/dual/seed2/model.safetensors",
        "prepared/test_frames.json",
        "prepared/ground_truth.npz",
    ]


def test_tables_are_stale_when_the_variants_or_their_labels_change(project):
    def digest(text):
        return own_run(project, text).profile.trained_variants()

    plain = digest("train: {lr: , dual: }\n")
    assert digest("train: {lr: , dual: }\ntraining: {log_every: 7}\n") == plain
    assert digest("train: {lr: , dual: , hr_only: }\n") != plain
    assert digest("train: {lr: , dual: {training.hr.max_steps: 9}}\n") != plain
    label = "variants: {{dual: {{label: {}, about: x, network: dual, starts_from: lr}}}}\ntrain: {{lr: , dual: }}\n"
    assert digest(label.format("a")) != digest(label.format("b"))


def test_a_folders_digest_changes_with_its_files_alone(tmp_path):
    assert folder_digest("", "*") == folder_digest(tmp_path, "*")
    (tmp_path / "a.png").write_bytes(b"1")
    before = folder_digest(tmp_path, "*.png")
    assert before == folder_digest(tmp_path, "*.png") != folder_digest("", "*.png")
    (tmp_path / "other.txt").touch()
    assert folder_digest(tmp_path, "*.png") == before
    (tmp_path / "a.png").write_bytes(b"12")
    assert folder_digest(tmp_path, "*.png") != before
