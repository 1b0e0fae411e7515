"""Where a run's files lie, what is said of a missing one, what a training's recipe is made of, and what stands in a stamp."""

import hashlib
import json
import shutil
import subprocess
import tomllib
from pathlib import Path

import pandas as pd
import pytest
from packaging.requirements import Requirement

from dualdepth.errors import InputError
from dualdepth.run import _SHAPING, Run, project_root
from dualdepth.settings import Training

REPOSITORY = project_root()


@pytest.fixture
def project(checkout, monkeypatch):
    (checkout / "environment.lock").write_text("torch==2.13.0\n")
    monkeypatch.chdir(checkout)
    return checkout


def test_the_root_is_found_from_below_and_asked_for_elsewhere(project, tmp_path_factory, monkeypatch):
    monkeypatch.chdir(project / "notebooks")
    assert project_root() == project
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    with pytest.raises(InputError, match="is not inside a dualdepth checkout"):
        project_root()


def test_a_table_is_written_with_a_stamp_that_says_what_made_it(project, tmp_path_factory):
    run = Run("tiny")
    given = project / "input.csv"
    given.write_text("a\n1\n")
    table = pd.DataFrame({"abs_rel": [0.123456789]})
    outside = tmp_path_factory.mktemp("data") / "poses" / "03.txt"
    outside.parent.mkdir()
    outside.write_text("a\n1\n")
    assert run.save_table(table, "main", [given, outside], seeds=[0, 1]) is table
    path = project / "results/tiny/tables/main.csv"
    assert path.read_text() == "abs_rel\n0.123457\n"
    stamp = json.loads(path.with_suffix(".json").read_text())
    assert (stamp["profile"], stamp["seeds"], stamp["revision"]) == ("tiny", [0, 1], "unknown")  # outside of git
    digest = hashlib.sha256(b"a\n1\n").hexdigest()  # of a file outside the checkout no more is said than where it lies in its data set
    assert stamp["inputs_sha256"] == {"input.csv": digest, f"{outside.parents[1].name}/poses/03.txt": digest}
    assert stamp["lock_sha256"] == hashlib.sha256(b"torch==2.13.0\n").hexdigest()


@pytest.mark.slow
def test_the_revision_is_this_checkouts_own_and_not_that_of_a_repository_around_it(project, monkeypatch):
    def revision_after_commit(folder):
        for words in (["init", "-q"], ["-c", "user.name=a", "-c", "user.email=a@b", "commit", "-q", "--allow-empty", "-m", "x"]):
            subprocess.run(["git", "-C", folder, *words], check=True)
        return Run("tiny")._revision

    assert revision_after_commit(project.parent) == {"revision": "unknown", "dirty": False}
    own = revision_after_commit(project)
    monkeypatch.setenv("GIT_DIR", str(project.parent / ".git"))  # as a hook of that repository has it
    assert len(own["revision"]) == 40 and own["dirty"] and Run("tiny")._revision == own
    monkeypatch.setenv("PATH", "")
    assert Run("tiny")._revision["revision"] == "unknown"


def test_the_lock_pins_what_lies_in_the_ranges_that_are_asked_for():
    asked = map(Requirement, tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["dependencies"])
    pinned = dict(line.lower().replace("_", "-").split("==") for line in (REPOSITORY / "environment.lock").read_text().splitlines())
    assert [r.name for r in asked if not r.specifier.contains(pinned[r.name.replace("_", "-")])] == []


def test_a_checkout_that_was_moved_after_its_environment_was_made_is_one_line(project):
    shutil.copyfile(REPOSITORY / "Makefile", "Makefile")
    Path(".venv/bin").mkdir(parents=True)
    for name in ("pyproject.toml", ".venv/.installed", ".venv/bin/pip"):
        Path(name).write_text("#!/renamed/.venv/bin/python\n")
    Path(".venv/bin/pip").chmod(0o755)
    done = subprocess.run(["make", "status"], capture_output=True, text=True, check=False)
    assert done.stderr.splitlines()[0] == "error: .venv was made where this folder was before; 'rm -r .venv && make env' makes it anew"


def own_run(project, text):
    """Of a profile with more in it."""
    path = project / "own.yaml"
    path.write_text(f"about: x\ndata:\n  source: kitti\n  train_list: eigen_zhou\n{text}")
    return Run(str(path))


@pytest.fixture
def recipe(project):
    """The recipe of a training of a profile, from prepared files and stage 1's weights of given content."""

    def recipe(text="", variant="lr", triplets="x", identity="{}", weights="a"):
        run = own_run(project, text)
        files = {run.prepared / "triplets.csv": triplets, run.prepared / "identity.json": identity, run.weights("lr", 0): weights}
        for file, content in files.items():
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(content)
        return run.recipe(variant, 0)

    return recipe


def test_a_recipe_changes_with_triplets_and_settings_that_shape_the_weights(recipe):
    plain = recipe()
    assert recipe("training: {workers: 3, log_every: 7, accumulate: 2}\n") == plain == recipe(weights="b")
    assert recipe(triplets="y") != plain
    assert recipe(identity='{"frames": 1}') != plain
    for setting in ("lr: {batch_size: 2}", "precision: float32", "encoder: resnet18", "loss: {feature: 0}"):
        assert recipe(f"training: {{{setting}}}\n") != plain
    assert recipe("training: {beyond_paper_residual_anchor: 0.1}\n") == plain  # LR-Net has none


def test_each_setting_of_training_shapes_the_weights_but_for_those_of_the_machine():
    shaping = {name.removeprefix("training.") for name in _SHAPING} | {"lr", "hr"}
    of_the_machine = {"workers", "accumulate", "log_every", "panel_every", "checkpoint_every", "checkpoint_minutes", "keep_checkpoints"}
    assert {*Training.model_fields} - shaping == of_the_machine


def test_stage_2_is_stale_when_stage_1_or_its_own_settings_change(recipe):
    plain = recipe(variant="dual")
    assert recipe(variant="dual", weights="b") != plain
    assert recipe(variant="dual_no_sa") != plain
    assert recipe(variant="dual_cosine") != plain
    for setting in ("hr: {epochs: 3}", "beyond_paper_residual_anchor: 0.1"):
        assert recipe(f"training: {{{setting}}}\n", "dual") != plain
    assert recipe("training: {loss: {smoothness: 0.2}}\n", "dual") != plain
    assert recipe("training: {lr: {epochs: 3}}\n", "dual") == plain  # what it did to LR-Net stands in LR-Net's weights
    assert recipe("train: {lr: , dual: {training.hr.max_steps: 9}}\n", "dual") != plain
    assert recipe("train: {lr: , dual: , hr_only: }\n", "dual") == plain
    assert recipe("training: {hr: {epochs: 3}}\n") == recipe()


def test_a_table_is_made_from_the_weights_that_are_trained_the_scored_frames_and_their_truth(project):
    run = own_run(project, "train: {lr: , dual: }\n")
    weights = [run.weights(variant, seed) for variant in ("lr", "dual") for seed in (0, 2)]
    others = [run.prepared / name for name in ("test_frames.json", "ground_truth.npz")]
    assert [*run.scored_with(("lr", "dual_no_sa", "dual"), (0, 2))] == weights + others


def test_tables_are_stale_when_the_variants_or_their_labels_change(project):
    def digest(text):
        return own_run(project, text).profile.trained_variants()

    plain = digest("train: {lr: , dual: }\n")
    assert digest("train: {lr: , dual: {training.hr.max_steps: 9}}\n") != plain
    label = "variants: {{dual: {{label: {}, about: x, network: dual, starts_from: lr}}}}\ntrain: {{lr: , dual: }}\n"
    assert digest(label.format("a")) != digest(label.format("b"))
