"""The ablation: every row and claim of the paper has ours beside it, or the reason why not."""

import pytest

from dualdepth import paper
from dualdepth.profile import standard_variants
from dualdepth.tables.ablation import VARIANTS, ablation_claims, ablation_table, own_variants
from dualdepth.tables.claims import claims_of
from dualdepth.tables.scores import collect

VALUES = {"lr": 0.30, "dual_no_sa": 0.22, "dual": 0.20, "dual_embedding_only": 0.20, "hr_only": 0.50}
"""Of the others: 0.4."""


@pytest.fixture
def scored(make_scores, give):
    give(lambda variant, seed: make_scores(VALUES.get(variant, 0.4) + 0.01 * seed))


def test_every_variant_has_the_row_of_its_own_scores_below_the_papers(scored, make_run, check_paper_rows):
    run = make_run()
    table = ablation_table(run, collect(run, VARIANTS, [0, 2]))
    check_paper_rows(table, paper.table("ablation"))
    measured = table.query("source == 'measured'").set_index("variant")
    assert tuple(measured.index) == VARIANTS and VARIANTS[:3] == ("lr", "dual_no_sa", "dual")
    for variant, row in measured.iterrows():
        assert row["method"] == standard_variants()[variant].label
        assert row["abs_rel"] == pytest.approx(VALUES.get(variant, 0.4) + 0.01)
        assert row["abs_rel_std"] == pytest.approx(0.02 / 2**0.5)
        assert row["seeds"] == "0 2" and row["n"] == 6


def test_every_claim_of_the_paper_is_compared_with_the_better_one_first(scored, make_run):
    run = make_run()
    table = ablation_claims(run, collect(run, VARIANTS, [0, 1]))
    pairs = [(claim.a, claim.b) for claim in claims_of("ablation")]
    assert list(zip(table["a"], table["b"])) == [pair for pair in pairs for _ in range(2)] and len(pairs) == 7
    for row in table.itertuples():
        assert row.difference == pytest.approx(VALUES.get(row.a, 0.4) - VALUES.get(row.b, 0.4)), (row.a, row.b)
    errors = table[table["metric"] == "abs_rel"].set_index(["a", "b"])["in_words"]
    assert errors["dual", "lr"] == "better by 0.1: the interval over images excludes 0, that over 2 seeds excludes 0"
    assert errors["dual", "hr_only"].startswith("better by 0.3:")


def test_variants_of_a_profiles_own_come_last_and_stand_against_lr_or_dual(scored, make_run):
    more = "mine: {label: Mine, about: x, network: lr}\n  dual_mine: {label: Mine 2, about: x, network: dual, starts_from: lr}"
    text = f"about: x\nextends: tiny\nvariants:\n  {more}\n  dual: {{label: D, about: x, network: dual, starts_from: lr}}"
    run = make_run(text=f"{text}\ntrain: {{lr: , dual: , mine: , dual_mine: }}")
    assert own_variants(run) == ["mine", "dual_mine"]
    scores = collect(run, [*VARIANTS, *own_variants(run)], [0, 1])
    table, claims = ablation_table(run, scores), ablation_claims(run, scores)
    assert list(table["method"])[-2:] == ["Mine", "Mine 2"] and table["abs_rel"].iloc[-1] == pytest.approx(0.405)
    assert list(zip(claims["a"], claims["b"]))[-4:] == [("mine", "lr")] * 2 + [("dual_mine", "dual")] * 2
    assert claims["difference"].iloc[-2] == pytest.approx(0.2)
