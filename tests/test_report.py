"""The report gathers what a run made, judges as far as its profile says, and is one page that needs nothing else."""

import json
import re

import numpy as np
import pandas as pd
import pytest

from dualdepth import paper, report
from dualdepth.errors import InputError
from dualdepth.report import TITLES, assumptions, first_look, headline, html, make_report, write_report
from dualdepth.run import Run, project_root
from dualdepth.tables.plots import image_grid


@pytest.fixture
def make_run(tmp_path):
    """A run whose tables are the paper's with a row of ours, with one figure and one comparison."""

    def make(profile="tiny", seeds="0 1 2"):
        run = Run(profile, tmp_path)
        for name in TITLES:
            table = paper.table(name)
            ours = {c: 0.12345 for c in table if pd.api.types.is_numeric_dtype(table[c])} | {"source": "measured", "note": "a <b>note</b>"}
            ours |= {"variant": "dual", "seeds": seeds, "abs_rel_std": 0.01}
            table = pd.concat([table, pd.DataFrame([ours])], ignore_index=True)
            run.save_table(table.assign(frames=3) if name == "odometry" else table, name, [], seeds=[0, 1, 2])
        numbers = {"mean_a": 0.1, "mean_b": 0.2, "difference": -0.1, "low": -0.2, "high": -0.05, "spread": 0.001, "seeds": 3, "n": 9}
        claim = {"of": "", "a": "dual", "b": "lr", "metric": "abs_rel", "better": "lower", "reason": "", **numbers}
        run.save_table(pd.DataFrame([claim]), "ablation_claims", [])
        run.save_figure(image_grid([np.zeros((2, 3, 3))], ["one"]), "main_depth", [])
        return run

    return make


@pytest.mark.parametrize(
    ("profile", "claim", "caution"),
    [
        ("tiny", "not judged", "none is judged"),
        ("miniature", "reproduced", "numbers of that world, not of KITTI"),
        ("own", "not judged", "no ground truth: nothing is scored"),
    ],
)
def test_only_claims_of_a_world_that_was_learned_are_judged(make_run, profile, claim, caution):
    made = make_report(make_run(profile))
    assert made.claims["verdict"].iloc[0] == claim and caution in made.caution
    assert made.claims["verdict"].isin(["reproduced", "within noise"]).any() == (profile == "miniature")
    assert made.numbers.query("metric == 'abs_rel'")["verdict"].dropna().eq("not run").all()
    own = profile == "own"
    assert ("laser depth, predicted" not in html(made)) == own and ("scale is unknown" in html(made)) == own


def test_the_papers_profile_judges_numbers(make_run):
    made = make_report(make_run("paper"))
    row = made.numbers.query("table == 'ablation' and row == 'LR-Net+HR-Net (w/ SA module)' and metric == 'abs_rel'").iloc[0]
    assert row["verdict"] == "within noise" and row["difference"] == pytest.approx(0.12345 - 0.121)
    assert made.caution == ""


def test_nothing_is_judged_where_a_leak_was_allowed(make_run):
    run = make_run("paper")
    table = pd.read_csv(run.results / "tables/odometry.csv")
    run.save_table(table.assign(leak="LEAK: trained on drive_0033"), "odometry", [])
    made = make_report(run)
    assert "LEAK: trained on drive_0033" in made.caution and "Nothing is judged" in made.caution
    assert not made.claims["verdict"].eq("reproduced").any() and made.numbers["verdict"].dropna().eq("not run").all()


def test_a_figure_of_an_earlier_run_does_not_stand_under_a_table_that_was_not_run(make_run):
    run = make_run("paper")
    for name in ("make3d", "unknown"):
        (run.results / f"figures/{name}.png").write_bytes((run.results / "figures/main_depth.png").read_bytes())
        (run.results / f"figures/{name}.json").write_bytes((run.results / "figures/main_depth.json").read_bytes())
    assert "make3d" not in make_report(run).figures and "main_depth" in make_report(run).figures
    table = pd.read_csv(run.results / "tables/make3d.csv")
    run.save_table(table.assign(n=[None] * (len(table) - 1) + [134]), "make3d", [])
    made = make_report(run)
    assert set(made.figures) == {"make3d", "main_depth"} and "figures/unknown" not in set(made.stamps["result"])


def test_the_page_says_what_snippets_are_worth_beside_trajectories_and_controls(make_run):
    run = make_run("paper")
    claim = {"of": "sequence 09", "a": "odometry_lr", "b": "straight", "metric": "t_err", "in_words": "better by 9"}
    run.save_table(pd.DataFrame([claim]), "odometry_claims", [])
    run.save_table(pd.DataFrame([{"method": "Straight ahead", "align": "7dof", "t_err": 12.5}]), "odometry_trajectories", [])
    page = html(make_report(run))
    assert "0.0163 on sequence 09" in page and "better by 9" in page and "7dof" in page and "12.5" in page


def test_loss_weights_are_those_of_the_run(make_run):
    assert "smoothness 0.03" in str(make_report(make_run()).assumptions)
    run = make_run()
    loss = run.profile.training.loss.model_copy(update={"smoothness": 0.7})
    run.profile = run.profile.model_copy(update={"training": run.profile.training.model_copy(update={"loss": loss})})
    assert "smoothness 0.7" in html(make_report(run))


def test_a_missing_table_names_its_notebook(make_run):
    run = make_run()
    (run.results / "tables/make3d.csv").unlink()
    with pytest.raises(InputError, match=r"make3d\.csv is missing: run notebook 06_table_make3d"):
        make_report(run)


def test_the_page_has_everything_in_it_and_asks_for_no_other_file(make_run):
    run = make_run("miniature")
    (run.root / "docs").symlink_to(project_root() / "docs")
    made = make_report(run)
    file = write_report(run, made)
    assert file == run.results / "report.html"
    assert pd.read_csv(run.results / "tables/report_claims.csv")["verdict"].iloc[0] == "reproduced"
    page = file.read_text()
    assert write_report(run, make_report(run)).read_text() == page  # its own tables do not disturb it
    asked = set(re.findall(r"""(?:src|href|url)\s*[=(]\s*["']?([^"')\s>]+)""", page))
    assert asked and all(address.startswith(("data:", "#")) for address in asked)
    assert "<script" not in page and "@import" not in page
    assert "SA-Attention" in page[page.index("<svg") : page.index("</svg>")]  # the drawing of the networks
    for title in TITLES.values():
        assert title in page
    for oddity in paper.ODDITIES:
        assert oddity.split(",")[0].split("<")[0][:40] in page
    assert all(topic in page.replace("&#39;", "'").replace("&amp;", "&") for topic, _, _ in assumptions(run.profile.training.loss))
    assert page.count("data:image/png;base64,") == 1
    assert json.loads((run.results / "tables/main.json").read_text())["profile_sha256"][:8] in page  # provenance
    assert "0.123 ± 0.010" in page  # our numbers have their spread
    assert "a &lt;b&gt;note&lt;/b&gt;" in page and "<b>note</b>" not in page


def test_every_figure_of_the_chain_has_a_caption():
    saved = set()
    for path in (project_root() / "notebooks").glob("*.ipynb"):
        saved |= set(re.findall(r'save_figure\([^\n]*?, \\"(\w+)\\", ', path.read_text()))
    assert saved and saved <= set(report.CAPTIONS)


def test_a_run_ends_with_what_was_learned_and_where_to_look(tmp_path):
    run = Run("paper", tmp_path)
    assert "results/paper" in first_look(run)
    methods = ["LR-Net", "LR-Net", "LR-Net + HR-Net, w/ SA", "Train set mean"]
    scores = {"abs_rel": [0.5, 0.2, 0.18, 0.3], "a1": [0.5, 0.71, 0.75, 0.6]}
    table = pd.DataFrame({"method": methods, "source": ["paper", *["measured"] * 3], **scores})
    run.save_table(table, "main", [])
    said = first_look(run)
    for words in ("20.0%", "71.0%", "18.0%", "75.0%", "30.0%", "results/paper/figures/side_by_side.png", "results/paper/report.html"):
        assert words in said
    assert "50.0%" not in said and "%" not in headline(table.assign(abs_rel=np.nan))
    alone = headline(table.assign(abs_rel=table["abs_rel"].mask(table["method"].str.contains("HR-Net"))))
    assert "LR-Net's depth is off by 20.0% on average" in alone  # also the sentence of a profile without a dual network is one
    assert headline(table.assign(leak="LEAK: trained on d")).split(",")[0] != headline(table).split(",")[0]
