"""The ablation: every row and claim of the paper has ours beside it, or the reason why not."""

import pytest

from dualdepth import paper
from dualdepth.profile import standard_variants
from dualdepth.tables.ablation import CLAIMS, ROWS, ablation_claims, ablation_table

VALUES = {"lr": 0.30, "dual_no_sa": 0.22, "dual": 0.20, "dual_embedding_only": 0.20, "hr_only": 0.50}
"""Of the others: 0.4."""
TEXT = "about: x\ndata:\n  source: kitti\n  train_list: eigen_zhou\n"


@pytest.fixture
def scored(make_scores, give):
    give(lambda run, variant, seed: make_scores(VALUES.get(variant, 0.4) + 0.01 * seed))


def test_every_variant_has_the_row_of_its_own_scores_below_the_papers(scored, make_run, check_paper_rows):
    table = ablation_table(make_run(), [0, 2])
    check_paper_rows(table, paper.table("ablation"))
    measured = table.query("source == 'measured'").set_index("variant")
    assert tuple(measured.index) == ROWS and ROWS[:3] == ("lr", "dual_no_sa", "dual")
    for variant, row in measured.iterrows():
        assert row["method"] == standard_variants()[variant].label
        assert row["abs_rel"] == pytest.approx(VALUES.get(variant, 0.4) + 0.01)
        assert row["abs_rel_std"] == pytest.approx(0.02 / 2**0.5)
        assert row["seeds"] == "0 2" and row["n"] == 6


def test_every_claim_of_the_paper_is_judged_with_the_better_one_first(scored, make_run):
    table = ablation_claims(make_run(), [0, 1])
    assert {(row.a, row.b): row.claim for row in table.itertuples()} == CLAIMS
    assert len(table) == 2 * len(CLAIMS)
    for row in table.itertuples():
        expected = VALUES.get(row.a, 0.4) - VALUES.get(row.b, 0.4)
        assert row.difference == pytest.approx(expected), (row.a, row.b)
    errors = table[table["metric"] == "abs_rel"].set_index(["a", "b"])["in_words"]
    assert errors["dual", "lr"] == "better by 0.1: the interval over images excludes 0, that over 2 seeds excludes 0"
    assert errors["dual", "hr_only"].startswith("better by 0.3:")
    assert errors["dual_no_sa", "lr"].startswith("better by 0.08:")


def test_rows_and_claims_about_networks_that_are_not_trained_stay_with_the_reason(scored, make_run):
    run = make_run("own", text=TEXT)
    measured = ablation_table(run, [0]).query("source == 'measured'").set_index("variant")
    trained = measured.index.isin(["lr", "dual", "dual_no_sa"])
    assert measured["abs_rel"].notna().tolist() == trained.tolist()
    assert measured.loc[~trained, "note"].eq("not run: profile own does not train it").all()
    table = ablation_claims(run, [0])
    assert set(table["claim"]) == set(CLAIMS.values())
    open_claims = table[table["in_words"].str.startswith("not run")]
    assert set(zip(open_claims["a"], open_claims["b"])) == set(CLAIMS) - {("dual", "lr"), ("dual_no_sa", "lr"), ("dual", "dual_no_sa")}
    assert open_claims["difference"].isna().all()
