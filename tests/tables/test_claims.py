"""Verdicts follow their rules to the edge, and every row and claim is found in the tables that are really made."""

import numpy as np
import pandas as pd
import pytest

from dualdepth import paper
from dualdepth.evaluation.statistics import Comparison
from dualdepth.report import TITLES
from dualdepth.run import project_root
from dualdepth.tables import claims
from dualdepth.tables.claims import CLAIMS, NOT_REPRODUCED, NOT_RUN, PAIRS, REPRODUCED, WITHIN_NOISE, compare_numbers, judge_claims


def number(ours, paper=0.100, spread=np.nan, seeds=1, metric="abs_rel"):
    return claims.judge_number(metric, paper, ours, spread=spread, seeds=seeds).word


def test_two_percent_half_of_the_last_digit_and_what_is_better_are_reproduced():
    assert number(0.102) == REPRODUCED
    assert number(0.1021) == NOT_REPRODUCED
    assert number(1.02 * 16.43, paper=16.43, metric="params_m") == REPRODUCED
    assert number(0.97 * 16.43, paper=16.43, metric="params_m") == NOT_REPRODUCED
    assert number(0.0075, paper=0.008) == number(0.0085, paper=0.008) == REPRODUCED
    assert number(0.0087, paper=0.008) == NOT_REPRODUCED
    assert number(0.05) == REPRODUCED and number(0.05, metric="a1") == NOT_REPRODUCED
    assert number(0.5, metric="a1") == REPRODUCED and number(0.05, metric="gmacs") == NOT_REPRODUCED


def test_noise_is_the_t_interval_over_seeds():
    # three seeds: 4.303 · 0.01 / √3 = 0.0248
    assert number(0.1247, spread=0.01, seeds=3) == WITHIN_NOISE
    assert number(0.1249, spread=0.01, seeds=3) == NOT_REPRODUCED
    assert number(0.11) == NOT_REPRODUCED  # one seed knows no noise


def claim(difference, half, spread=np.nan, seeds=1, lower=True):
    return claims.judge_claim(Comparison(0, 0, difference, difference - half, difference + half, spread, seeds), lower_is_better=lower)


def test_a_claim_needs_the_sign_and_both_intervals():
    assert claim(-0.01, 0.005).word == REPRODUCED and claim(-0.01, 0.005).why == "one seed"
    assert claim(-0.01, 0.02).word == WITHIN_NOISE
    assert claim(-0.01, 0.005, spread=0.001, seeds=3) == (REPRODUCED, "")
    assert claim(-0.01, 0.005, spread=0.01, seeds=3).word == WITHIN_NOISE
    assert claim(0.01, 0.005, spread=0.001, seeds=3).word == NOT_REPRODUCED
    assert claim(0.01, 0.02, spread=0.001, seeds=3).word == WITHIN_NOISE
    assert claim(0.01, 0.005, lower=False).word == REPRODUCED and claim(-0.01, 0.005, lower=False).word == NOT_REPRODUCED
    assert claim(np.nan, 0.005).word == NOT_RUN


@pytest.mark.parametrize("name", TITLES)
def test_every_row_of_the_paper_that_is_its_own_has_a_pair_with_its_metrics(name):
    table, pairs = paper.table(name), [pair for pair in PAIRS if pair.table == name]
    rows = [claims._row(table, pair.paper, of_paper=True) for pair in pairs]
    own = {"main": [0, 14], "make3d": [8], "sharpness": [1], "odometry": [6, 7]}.get(name, range(len(table)))
    assert {row.name for row in rows} == set(own)
    for pair, row in zip(pairs, rows):
        assert pair.metrics == ("ratio",) or all(pd.notna(row[m]) for m in pair.metrics if m != "rmse_log"), pair


def judged(name, *ours, judged=True, **of_paper):
    """`compare_numbers` of the paper's table with rows of ours below it, by row and metric."""
    rows = pd.DataFrame([{"source": "measured"} | row for row in ours])
    return compare_numbers({name: pd.concat([paper.table(name).assign(**of_paper), rows])}, judged).set_index(["row", "metric"])


def test_numbers_stand_beside_the_papers_with_their_interval_or_the_reason_why_not():
    lr = {"method": "LR-Net", "variant": "lr"}
    table = judged("ablation", lr | {"seeds": "0 1 2", "n": 5, "abs_rel": 0.14, "abs_rel_std": 0.01})
    row = table.loc["Baseline (LR-Net only)", "abs_rel"]
    assert row["paper"] == 0.132 and row["ours"] == 0.14 and row["seeds"] == "0 1 2"
    assert row["high"] - row["low"] == pytest.approx(2 * 4.3027 * 0.01 / 3**0.5, rel=1e-3)
    assert row["difference"] == pytest.approx(0.008) and row["verdict"] == WITHIN_NOISE
    rows = judged("ablation", lr | {"source": "not run", "reason": "no GPU"}).loc["Baseline (LR-Net only)"]
    assert set(rows["verdict"]) == {NOT_RUN} and set(rows["note"]) == {"no GPU"}


def test_the_papers_two_regions_are_told_apart():
    """0.080 is printed with three digits, though it ends in a zero."""
    road = {"region": "Road", "abs_rel": 0.085}
    verdicts = judged("sa_region", road | {"variant": "dual"}, road | {"variant": "dual_no_sa"})["verdict"]
    assert verdicts["Road, w/ SA", "abs_rel"] == NOT_REPRODUCED and verdicts["Road, w/o SA", "abs_rel"] == REPRODUCED


def test_a_reading_that_was_chosen_by_its_closeness_is_not_judged():
    ours = {"method": "w/ HR-Net", "closest": True, "ratio": 5.1}
    row = judged("sharpness", ours, ratio=[np.nan, 5.15], closest=False).iloc[0]
    assert row["ours"] == 5.1 and pd.isna(row["verdict"]) and row["note"].startswith("not judged")


def test_snippets_are_counted_for_their_own_sequence():
    ours = {"variant": "odometry_lr", "frames": 3, "snippet_ate_mean_09": 0.017, "n_09": 114, "n_10": 115, "n": 229}
    assert judged("odometry", ours).loc[("Ours (LR-Net)", "snippet_ate_mean_09"), "n"] == 114


def test_numbers_are_judged_only_where_asked():
    ours = {"backbone": "ResNet18", "params_m": 16.313, "gmacs": 99.0, "abs_rel": 0.5}
    table = judged("backbone", ours, judged=False).loc["ResNet18"]
    assert table.loc[["params_m", "gmacs", "abs_rel"], "verdict"].isna().all()
    assert table.loc["a1", ["verdict", "note"]].tolist() == [NOT_RUN, "no number"]
    assert table.loc["params_m", "difference"] == pytest.approx(16.313 - 16.43)
    verdicts = judged("backbone", ours).loc["ResNet18", "verdict"]
    assert verdicts["params_m"] == REPRODUCED and verdicts["gmacs"] == NOT_REPRODUCED


def claims_table(difference, low, high, spread=0.001, seeds=3, **row):
    pair = {"of": "", "a": "dual", "b": "lr", "metric": "abs_rel", "mean_a": 0.1, "mean_b": 0.2, "n": 9, "better": "lower", "reason": ""}
    return pd.DataFrame([pair | {"difference": difference, "low": low, "high": high, "spread": spread, "seeds": seeds} | row])


def test_a_claim_is_judged_by_its_row_or_says_why_not():
    table = judge_claims({"ablation_claims": claims_table(-0.1, -0.2, -0.05)})
    first = table.iloc[0]
    assert first["claim"] == CLAIMS[0].text and first["metric"] == "abs_rel" and first["verdict"] == REPRODUCED
    assert table["verdict"].iloc[1:].eq(NOT_RUN).all()
    row = claims_table(*5 * [np.nan], metric="", reason="why not")
    for tables, reason in (({"ablation_claims": row}, "why not"), ({}, "no comparison was made")):
        first = judge_claims(tables).iloc[0]
        assert (first["verdict"], first["note"]) == (NOT_RUN, reason)


@pytest.mark.parametrize(
    ("far", "verdict"), [((-0.1, -0.2, -0.05), REPRODUCED), ((0.02, 0.01, 0.03), NOT_REPRODUCED), ((-0.1, -0.2, 0.1), WITHIN_NOISE)]
)
def test_to_gain_more_far_away_is_nothing_without_a_gain(far, verdict):
    gain = claims_table(0.04, 0.03, 0.05, a="gain of dual, > 20 m", b="gain of dual, <= 20 m", better="higher")
    part = claims_table(*far, of="> 20 m")
    table = judge_claims({"distance_claims": pd.concat([gain, part])}).set_index("claim")
    assert table.loc["The gain is largest far away", "verdict"] == verdict


@pytest.mark.parametrize(
    ("text", "metric", "of", "mean_b", "seen", "unseen"),
    [
        ("Edges of the dual network are sharper", "f1", "boundaries", 0.05, 0.11, 0.09),
        ("Slim poles are seen", "a1", "poles", 0.2, 0.41, 0.39),
        ("Slim poles are seen", "a1", "poles", 0.6, 0.81, 0.79),
    ],
)
def test_to_be_better_at_what_neither_can_do_is_nothing(text, metric, of, mean_b, seen, unseen):
    for mean_a, verdict in ((seen, REPRODUCED), (unseen, NOT_REPRODUCED)):
        row = claims_table(0.1, 0.05, 0.2, metric=metric, of=of, better="higher", mean_a=mean_a, mean_b=mean_b)
        assert judge_claims({"sharpness_claims": row}).set_index("claim")["verdict"][text] == verdict


def test_every_row_and_claim_is_found_in_the_tables_of_the_last_published_run():
    folder = project_root() / "results" / "published" / "miniature" / "tables"
    tables = {path.stem: pd.read_csv(path, dtype={"seeds": str}) for path in folder.glob("*.csv")}
    numbers = compare_numbers(tables, judged=True)
    assert len(numbers) > 100 and not numbers["note"].eq("no row of ours").any()
    claims = judge_claims(tables).set_index("claim")["note"]
    # the one needs `dual_no_sa`, which the profile does not train
    assert set(claims[claims == "no comparison was made"].index) <= {"SA-Attention helps more on road than on tree & grass"}


def test_the_pose_nets_of_kitti_and_of_the_synthetic_world_are_told_by_their_stage():
    for a, b in (("odometry_dual", "odometry_lr"), ("dual", "lr")):
        table = claims_table(-1.0, -2.0, -0.5, of="sequence 09", a=a, b=b, metric="snippet_ate_3")
        found = judge_claims({"odometry_claims": table}).set_index("claim")["verdict"]
        assert found["Stage 2 betters the poses of sequence 09"] == REPRODUCED
        assert found["Stage 2 betters the poses of sequence 10"] == NOT_RUN
