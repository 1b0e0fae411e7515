"""Regions: made predictions whose faults are known give the numbers that follow."""

import cv2
import numpy as np
import pytest

from dualdepth import paper
from dualdepth.data.label_maps import label_path
from dualdepth.errors import InputError
from dualdepth.evaluation.depth import METRICS
from dualdepth.evaluation.parts import REGIONS
from dualdepth.files import write_json
from dualdepth.run import Sources
from dualdepth.tables.rows import COMPARISON
from dualdepth.tables.sa_region import NO_LABELS, labels_made_by, region_claims, region_scores, region_table
from dualdepth.tables.scores import scored

ROAD, GREEN = REGIONS
FAULT = {("dual_no_sa", ROAD): 0.3, ("dual", ROAD): 0.1, ("dual_no_sa", GREEN): 0.1, ("dual", GREEN): 0.15}
"""By how much each network is wrong; the median depth is a building's, which is exact, so the median ratio is that of exact depth."""


def labels(image):
    """A building, trees over grass, a road; the last image has no green."""
    row = np.repeat(np.array([2, 8, 0] if image < 2 else [2, 2, 0], np.uint8), [15, 5, 10])
    made = np.tile(row, (30, 1))
    made[20:][made[20:] == 8] = 9
    return made


@pytest.fixture
def prepare(make_run, give_maps, truths, tmp_path):
    """A run with three scored frames, their label maps, and predictions with the faults."""

    def disparities(variant, seed):
        fault = {region: FAULT[variant, region] + 0.1 * seed * (region == ROAD) for region in REGIONS}
        wrong = [1 + sum(np.isin(labels(i), REGIONS[region]) * fault[region] for region in REGIONS) for i in range(3)]
        return 0.7 / np.stack([t * w for t, w in zip(truths, wrong)])  # of any scale

    def prepare(*arguments, with_labels=True, **settings):
        run = make_run(*arguments, frames=3, **settings)
        root = tmp_path / "labels"
        Sources(kitti_root=tmp_path, test_list=tmp_path, labels_root=root if with_labels else None).save(run)
        for image, frame in enumerate(scored(run).frames):
            label_path(root, frame).parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(label_path(root, frame)), labels(image))
        return run

    give_maps(disparities, truths)
    return prepare


def table_of(run, seeds):
    return region_table(run, region_scores(run, seeds))


@pytest.fixture
def run(prepare):
    return prepare()


def test_faults_of_a_region_show_in_its_rows_alone_below_the_papers_in_its_order(run, check_paper_rows):
    table, published = table_of(run, [0, 1]), paper.table("sa_region")
    check_paper_rows(table, published)
    table = table.query("source == 'measured'")
    assert table[["region", "method"]].to_numpy().tolist() == published[["region", "method"]].to_numpy().tolist()
    table = table.set_index(["variant", "region"])
    assert table.index.get_level_values("variant").tolist() == ["dual_no_sa", "dual"] * 2
    for (variant, region), fault in FAULT.items():
        row, by_seed = table.loc[(variant, region)], 0.1 * (region == ROAD)
        assert row["abs_rel"] == pytest.approx(fault + by_seed / 2)
        assert row["abs_rel_std"] == pytest.approx(by_seed / 2**0.5, abs=1e-9)
        assert row["rmse_log"] == pytest.approx((np.log(1 + fault) + np.log(1 + fault + by_seed)) / 2)
        assert row["n"] == (3 if region == ROAD else 2) and row["seeds"] == "0 1"


def test_notes_say_what_made_the_labels_and_how_many_images_have_the_region(run):
    notes = table_of(run, [0]).query("source == 'measured'").groupby("region")["note"].unique()
    assert len(notes[ROAD]) == len(notes[GREEN]) == 1
    assert notes[ROAD][0].endswith("last epoch, exact labels")
    assert notes[GREEN][0].endswith("exact labels, 2 of 3 images; the others have fewer than 1 valid pixel of the region")


def test_labels_of_real_frames_are_named_by_the_file_beside_them(prepare, tmp_path):
    run = prepare("own", kitti="")
    assert labels_made_by(run) == "labels of unknown origin"
    write_json(tmp_path / "labels" / "labels.json", {"model": "some/segformer"})
    assert labels_made_by(run) == "labels by some/segformer"
    assert "labels by some/segformer" in table_of(run, [0])["note"].iloc[-1]
    for text in ("{}", "[1]", "{"):
        (tmp_path / "labels" / "labels.json").write_text(text)
        with pytest.raises(InputError, match=r"labels\.json: cannot be read .*export_labels"):
            labels_made_by(run)


def test_without_label_maps_the_rows_are_there_and_say_how_to_make_them(prepare):
    run = prepare(with_labels=False)
    missing = table_of(run, [0]).query("source == 'not run'")
    assert len(missing) == 4 and missing[[*METRICS, "n"]].isna().all(axis=None) and set(missing["reason"]) == {NO_LABELS}
    claims = region_claims(region_scores(run, [0, 1]), [0, 1])
    assert claims.query("seed == '0 1'")["of"].tolist() == [ROAD, GREEN] and set(claims["reason"]) == {NO_LABELS}


def test_attention_is_judged_in_each_region_over_all_seeds_and_for_each(run):
    claims = region_claims(region_scores(run, [0, 1]), [0, 1])
    assert list(claims.columns) == ["of", "seed", *COMPARISON[1:]]
    regions = claims.query("a == 'dual' and b == 'dual_no_sa' and metric == 'abs_rel'").set_index(["seed", "of"])
    assert list(regions.index) == [(seeds, region) for seeds in ("0 1", "0", "1") for region in (ROAD, GREEN)]
    for seeds in ("0 1", "0", "1"):
        assert regions.loc[(seeds, ROAD), "difference"] == pytest.approx(-0.2)
        assert regions.loc[(seeds, GREEN), "difference"] == pytest.approx(0.05)
        assert regions.loc[(seeds, ROAD), "seeds"] == len(seeds.split())
        assert regions.loc[(seeds, ROAD), "n"] == 3 and regions.loc[(seeds, GREEN), "n"] == 2
    assert regions.loc[("1", ROAD), "mean_b"] == pytest.approx(0.4)
    assert regions.loc[("0 1", ROAD), "in_words"].startswith("better by 0.2: ")
    assert regions.loc[("0 1", GREEN), "in_words"].startswith("worse by 0.05: ")
    assert set(region_claims(region_scores(run, [0]), [0])["seed"]) == {"0"}
    rows = claims.query("of == 'Road against Tree & grass'").set_index("seed")  # in images that have both
    row = rows.loc["0 1"]
    assert [row["a"], row["b"]] == ["gain of dual, Road", "gain of dual, Tree & grass"]
    assert [row["mean_a"], row["mean_b"], row["difference"]] == pytest.approx([0.2, -0.05, 0.25])
    assert row["n"] == 2 and row["in_words"].startswith("better by 0.25: ")
    assert rows.loc["1", "difference"] == pytest.approx(0.25)
