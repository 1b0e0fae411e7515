"""Near and far: made predictions whose faults are known give the numbers that follow."""

import numpy as np
import pandas as pd
import pytest

from dualdepth import paper
from dualdepth.evaluation.parts import PARTS, near_and_far
from dualdepth.tables.distance import METHODS, RATIOS, distance_claims, distance_table
from dualdepth.tables.rows import COMPARISON, gains
from dualdepth.tables.scores import Scores, collect

NEAR, FAR = PARTS
STRETCH = {"lr": 1.3, "dual_no_sa": 1.2, "dual": 1.0}
"""What each network multiplies far depth by."""
FAULT = {"lr": 0.2, "dual_no_sa": 0.2, "dual": 0.1}
"""By how much each is wrong below 8 m; the median is of neither, so the median ratio is that of exact depth."""
SHARE = 5 / 19
"""Share of the near pixels below 8 m: of 30 columns, the protocol's crop takes the first and the last."""


@pytest.fixture
def run(make_run, give_maps, truths):
    def disparities(variant, seed):
        stretch = STRETCH[variant] + 0.1 * seed
        return 0.7 / np.stack([t * np.where(t > 20, stretch, np.where(t < 8, 1 + FAULT[variant], 1)) for t in truths])  # of any scale

    give_maps(disparities, truths)
    return make_run(frames=3)


def scores_of(run, seeds, own_ratio=False):
    return collect(run, METHODS, seeds, lambda training: training.parts(near_and_far, own_ratio=own_ratio))


def test_faults_of_far_depth_show_in_the_far_rows_with_one_ratio_and_go_with_a_ratio_of_their_own(run, check_paper_rows):
    table = distance_table(run, {own_ratio: scores_of(run, [0, 1], own_ratio) for own_ratio in RATIOS})
    published = paper.table("distance")
    check_paper_rows(table, published)
    table = table.query("source == 'measured'").set_index(["variant", "distance", "scaling"])
    named = table["method"].groupby("variant").first()
    assert named.to_dict() == {"lr": "w/o HR-Net", "dual_no_sa": "w/ HR-Net, w/o SA", "dual": "w/ HR-Net"}
    assert {named["lr"], named["dual"]} == set(published["method"]) and set(PARTS) == set(published["distance"])
    assert len(table) == 12
    one, own = RATIOS[False], RATIOS[True]
    for variant, stretch in STRETCH.items():
        far = table.loc[(variant, FAR, one)]
        assert far["abs_rel"] == pytest.approx(stretch - 1 + 0.05)
        assert far["abs_rel_std"] == pytest.approx(0.1 / 2**0.5)
        assert far["n"] == 3 and far["seeds"] == "0 1"
        assert table.loc[(variant, FAR, own), "abs_rel"] == pytest.approx(0, abs=1e-9)
        for scaling in (one, own):
            assert table.loc[(variant, NEAR, scaling), "abs_rel"] == pytest.approx(FAULT[variant] * SHARE)


def test_the_gain_is_judged_in_each_part_and_far_against_near(run):
    table = distance_claims(scores_of(run, [0, 1]))
    assert list(table.columns) == COMPARISON
    claims = table[table["of"].isin(PARTS)].query("metric == 'abs_rel'").set_index(["of", "a", "b"])
    assert set(claims.index) == {(part, a, "lr") for part in PARTS for a in ("dual", "dual_no_sa")}
    far = claims.loc[(FAR, "dual", "lr")]
    assert far["difference"] == pytest.approx(-0.3) and far["spread"] == pytest.approx(0, abs=1e-9)
    assert claims.loc[(FAR, "dual_no_sa", "lr"), "difference"] == pytest.approx(-0.1)
    assert claims.loc[(NEAR, "dual", "lr"), "difference"] == pytest.approx(-0.1 * SHARE)
    assert claims.loc[(NEAR, "dual_no_sa", "lr"), "difference"] == pytest.approx(0, abs=1e-9)

    # far errors are 0.3 and 0.4 before; 0 and 0.1 after with `dual`, 0.2 and 0.3 with `dual_no_sa`
    claims = table.query("of == '> 20 m against <= 20 m'")
    assert claims["metric"].eq("abs_rel").all() and claims["n"].eq(3).all()
    claims = claims.set_index("a")
    expected = {  # far, near
        f"gain of dual, {FAR}": (0.3, 0.1 * SHARE),
        f"relative gain of dual, {FAR}": ((0.3 / 0.3 + 0.3 / 0.4) / 2, 0.5),
        f"gain of dual_no_sa, {FAR}": (0.1, 0),
        f"relative gain of dual_no_sa, {FAR}": ((0.1 / 0.3 + 0.1 / 0.4) / 2, 0),
    }
    assert list(claims.index) == list(expected)
    for name, (far, near) in expected.items():
        assert claims.loc[name, ["mean_a", "mean_b", "difference"]].tolist() == pytest.approx([far, near, far - near], abs=1e-9), name
        assert claims.loc[name, "b"] == name.replace(FAR, NEAR)
    assert claims.loc[f"relative gain of dual, {FAR}", "spread"] == pytest.approx(0.25 / 2**0.5)
    assert claims["in_words"].iloc[1] == "better by 0.38: the interval over images excludes 0, that over 2 seeds includes 0"


def test_gains_are_of_images_that_have_both_parts_and_relative_ones_in_units_of_all_that_have_the_part():
    values = {  # Abs Rel by variant, part and image: image 2 has no far pixels, image 3 none that are near
        ("lr", NEAR): {0: 0.1, 1: 0.2, 2: 0.3},
        ("dual", NEAR): {0: 0.1, 1: 0.15, 2: 0.1},
        ("lr", FAR): {0: 0.5, 1: 0.4, 3: 0.9},
        ("dual", FAR): {0: 0.2, 1: 0.3, 3: 0.1},
    }
    rows = {(variant, 0, image, part): error for (variant, part), errors in values.items() for image, error in errors.items()}
    scores = Scores(pd.DataFrame({"abs_rel": rows}).rename_axis(["variant", "seed", "image", "part"]), {}, {})
    (row,) = gains(scores, ("dual", "lr"), (FAR, NEAR))  # far: 0.3, 0.1; near: 0, 0.05
    assert [row["mean_a"], row["mean_b"], row["difference"]] == pytest.approx([0.2, 0.025, 0.175])
    assert [row["low"], row["high"]] == pytest.approx([0.05, 0.3])
    assert row["n"] == 2 and row["in_words"] == "better by 0.17: the interval over images excludes 0, one seed"
    (row,) = gains(scores, ("dual", "lr"), (FAR, NEAR), relative=True)
    # LR-Net's mean errors: 0.6 far, 0.2 near, over all images of the part
    assert [row["mean_a"], row["mean_b"]] == pytest.approx([0.2 / 0.6, 0.025 / 0.2])
