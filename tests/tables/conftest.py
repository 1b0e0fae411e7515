"""Runs without weights or images, whose scores are given."""

import numpy as np
import pandas as pd
import pytest
import yaml

from dualdepth.evaluation.depth import METRICS
from dualdepth.files import write_json
from dualdepth.profile import PROFILES, standard_variants
from dualdepth.run import Run
from dualdepth.tables import scores

DRIVE = "2011_09_26/2011_09_26_drive_0001_sync"


@pytest.fixture
def make_run(tmp_path):
    """A run of tiny with every variant, of a profile with this text, or of one on KITTI with more; its list of scored frames is there."""

    def make(profile="tiny", *, text=None, kitti=None, frames=2, listed=None):
        if text is None and kitti is None:
            values = yaml.safe_load((PROFILES / "tiny.yaml").read_text(encoding="utf-8"))
            text = yaml.safe_dump(values | {"train": dict.fromkeys(standard_variants())})
        path = tmp_path / f"{profile}.yaml"
        path.write_text(text or f"about: x\ndata: {{source: kitti, train_list: eigen_zhou}}\n{kitti}")
        run = Run(str(path), tmp_path)
        run.prepared.mkdir(parents=True, exist_ok=True)
        listing = {"frames": [[DRIVE, i, "image_02"] for i in range(frames)], "listed": listed or frames}
        write_json(run.prepared / "test_frames.json", listing)
        return run

    return make


@pytest.fixture(autouse=True)
def cards(monkeypatch):
    """What the cards of trainings say that have no weights, by variant or by variant and seed; what is not given there is usual."""
    given, real = {}, scores.load_card
    usual = {"encoder": "resnet18", "pretrained": False, "steps": 100, "starts_from": None, "drives": []}

    def card(weights):
        if weights.with_suffix(".json").is_file():
            return real(weights)
        variant, seed = weights.parts[-3], int(weights.parts[-2].removeprefix("seed"))
        return usual | given.get(variant, {}) | given.get((variant, seed), {})

    monkeypatch.setattr(scores, "load_card", card)
    return given


@pytest.fixture
def make_scores():
    """Per-image scores about a value; the noise is the same whatever the value, so that paired differences are exact."""

    def make(value, images=6):
        noise = np.random.default_rng(0).normal(0, 0.01, images)
        frame = pd.DataFrame({m: value + noise - noise.mean() for m in METRICS})
        return frame.assign(scale_ratio=1.0, valid_pixels=10).rename_axis("image")

    return make


@pytest.fixture
def give(monkeypatch):
    """Makes `Trained.scores` what the given function says of (variant, seed)."""
    return lambda function: monkeypatch.setattr(scores.Trained, "scores", property(lambda t: function(t.variant, t.seed)))


@pytest.fixture
def give_maps(monkeypatch):
    """Makes `Trained.disparities` what the given function says of (variant, seed), and the scored frames' ground truth some maps."""

    def give(function, truths):
        monkeypatch.setattr(scores.Trained, "disparities", property(lambda t: function(t.variant, t.seed)))
        monkeypatch.setattr(scores.Scored, "truth", truths)

    return give


@pytest.fixture
def truths():
    """Depth of three images of 30 columns: 15 of 8.5 to 19 m, which hold the median, 5 of 4 to 7 m, 10 of 25 to 50 m."""
    rng = np.random.default_rng(0)
    columns = [rng.uniform(8.5, 19, (3, 30, 15)), rng.uniform(4, 7, (3, 30, 5)), rng.uniform(25, 50, (3, 30, 10))]
    return list(np.concatenate(columns, axis=2))


@pytest.fixture
def check_paper_rows():
    """Checks that the paper's rows stand first, all there, with no number changed and no count of images."""

    def check(table, expected):
        published = table[table["source"] == "paper"]
        assert list(published.index) == list(range(len(expected)))
        pd.testing.assert_frame_equal(published[expected.columns], expected, check_dtype=False)
        assert "n" not in table or published["n"].isna().all()

    return check
