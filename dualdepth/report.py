"""The report: the whole paper against ours on one page, shown by notebook 14 and written as `results/<profile>/report.html`."""

import base64
import json
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from dualdepth import paper
from dualdepth.files import write_text
from dualdepth.run import PACKAGE, Run
from dualdepth.settings import Loss
from dualdepth.tables.claims import NOT_RUN, TOLERANCE, compare_numbers, judge_claims
from dualdepth.tables.rows import readable

_WORDS = yaml.safe_load((PACKAGE / "report.yaml").read_text(encoding="utf-8"))
TITLES: dict[str, str] = _WORDS["titles"]  # Titles of the tables, by name.
FIRST_LOOK = "side_by_side"  # The picture to look at first.
CAPTIONS: dict[str, str] = _WORDS["captions"]
RULES = {what: rule.replace("{tolerance}", f"{TOLERANCE:.0%}") for what, rule in _WORDS["rules"].items()}  # How verdicts are given.
FIGURE_OF = {"make3d": "make3d", "odometry_trajectories": "odometry", "odometry_motions": "odometry", "sa_region": "sa_region"}
"""Figures that are of one table, and left from an earlier run where that was not run."""


class Report(NamedTuple):
    """What the page shows."""

    run: Run
    headline: str  # What was learned, in a sentence.
    caution: str  # How far the numbers may be trusted; empty for the paper's profile.
    claims: pd.DataFrame  # `judge_claims`.
    numbers: pd.DataFrame  # `compare_numbers`.
    tables: dict[str, pd.DataFrame]
    more: dict[str, pd.DataFrame]  # Of odometry: whole trajectories by alignment, and PoseNet against the controls.
    stamps: pd.DataFrame  # Provenance of every table and figure.
    figures: dict[str, Path]
    assumptions: list[tuple[str, str, str]]


def assumptions(loss: Loss) -> list[tuple[str, str, str]]:
    """(topic, choice, why) of `dualdepth/assumptions.yaml`, with the loss weights of a run."""
    rows = yaml.safe_load((PACKAGE / "assumptions.yaml").read_text(encoding="utf-8"))
    weights = f"photometric {loss.photometric:g}, smoothness {loss.smoothness:g}, features {loss.feature:g}"
    return [(row["topic"], row["choice"].replace("{weights}", weights), row["why"]) for row in rows]


def make_report(run: Run) -> Report:
    """A run's tables, figures and stamps, judged as far as its profile says; of a missing table an `InputError` names the notebook."""
    folder = run.results / "tables"
    for number, name in zip(("05", "06", "07", "08", "09", "10", "11", "12"), TITLES):
        run.require(folder / f"{name}.csv", f"{number}_table_{name}")
    read = {path.stem: pd.read_csv(path, dtype={"seeds": str}) for path in sorted(folder.glob("*.csv"))}
    tables = {name: read[name].fillna(dict.fromkeys(("note", "reason", "leak", "seeds"), "")) for name in TITLES}
    leaks = {leak for table in read.values() if "leak" in table for leak in table["leak"].dropna()}
    judged = "none" if leaks else run.profile.verdicts
    claims, numbers = judge_claims(read), compare_numbers(tables, judged == "numbers")
    if judged == "none":
        claims["verdict"] = claims["verdict"].where(claims["verdict"] == NOT_RUN, "not judged")
    training, words = run.profile.training, _WORDS["cautions"][judged]
    used = {
        "residual": training.beyond_paper_residual,
        "anchored": training.beyond_paper_residual and training.beyond_paper_residual_anchor > 0,
        "pose_encoder": training.beyond_paper_pose_encoder,
    }
    used |= {"frozen_pose": training.hr.beyond_paper_frozen_pose, "refined": training.beyond_paper_refined_after is not None}
    used |= {"augmented": training.augmentation.beyond_paper_flip or training.augmentation.beyond_paper_colour}
    beyond = [_WORDS[name] for name, on in used.items() if on]
    caution = " ".join([f"What these numbers describe: {run.profile.about}. Of them {words}", *beyond]) if words else ""
    if not run.profile.data.has_truth:
        caution = "An own camera has no ground truth: nothing is scored and nothing is judged. What was learned shows in the pictures."
    if leaks:
        caution = f"Nothing is judged: frames were scored that networks were trained on. {'; '.join(sorted(leaks))}."
    not_run = {name for name, table in tables.items() if "n" not in table or table["n"].isna().all()}
    figures = {path.stem: path for path in sorted((run.results / "figures").glob("*.png")) if path.stem in CAPTIONS}
    figures = {name: path for name, path in figures.items() if FIGURE_OF.get(name) not in not_run}
    stamps = [path for path in sorted(folder.glob("*.json")) if not path.stem.startswith("report_")]
    stamps += [path.with_suffix(".json") for path in figures.values()]
    more = {name: read[name] for name in ("odometry_trajectories", "odometry_motions", "odometry_claims") if name in read}
    said, provenance = headline(tables["main"]), pd.DataFrame([_provenance(run, path) for path in stamps])
    return Report(run, said, caution, claims, numbers, tables, more, provenance, figures, assumptions(run.profile.training.loss))


def headline(main: pd.DataFrame) -> str:
    """What was learned, in a sentence: how far off both networks are, beside what the mean depth map of training streets has."""
    ours = main[main["source"] == "measured"].set_index("method")
    measured = ours[["abs_rel", "a1"]].dropna()
    names = {
        "LR-Net + HR-Net, w/ SA": "the dual network's depth",
        "LR-Net": "LR-Net's depth",
        "Train set mean": "the mean depth map of other streets",
    }
    rows = [(words, *map("{:.1%}".format, measured.loc[method])) for method, words in names.items() if method in measured.index]
    if not rows:
        return "Nothing was scored; what was learned shows in the pictures."
    said = ["{} is off by {} on average and right within a factor of 1.25 in {} of the pixels".format(*rows[0])]
    said += [f"{words.removesuffix(' depth')} is off by {off} and right in {near}" for words, off, near in rows[1:]]
    leaked = "leak" in ours and ours["leak"].fillna("").ne("").any()
    return f"On {'frames of drives that were trained on' if leaked else 'frames that no training saw'}, {'; '.join(said)}."


def first_look(run: Run) -> str:
    """What a run ends with: what was learned, and where to look; of a run of some steps alone, where its results are."""
    table = run.results / "tables" / "main.csv"
    if not table.is_file():
        return f"The steps that were asked for are done; results in {run.results.relative_to(run.root)}."
    picture = run.results / "figures" / f"{FIRST_LOOK}.png"
    where = f"Look first at {picture.relative_to(run.root)}, then at {(run.results / 'report.html').relative_to(run.root)}."
    return f"{headline(pd.read_csv(table))}\n{where}"


def _provenance(run: Run, path: Path) -> dict[str, Any]:
    """What a stamp says, as the page shows it."""
    stamp = json.loads(path.read_text(encoding="utf-8"))
    inputs = {Path(k).as_posix().removeprefix(f"work/{run.profile.name}/"): (v or "")[:8] for k, v in stamp["inputs_sha256"].items()}
    return {
        "result": f"{path.parent.name}/{path.stem}",
        "revision": stamp["revision"][:10] + (" and changes" if stamp["dirty"] else ""),
        "profile": f"{stamp['profile']} {stamp['profile_sha256'][:8]}",
        "lock": (stamp["lock_sha256"] or "")[:8],
        "seeds": " ".join(map(str, stamp.get("seeds", []))),
        "device": stamp["device"],
        "seconds": stamp["seconds"],
        "made": stamp["made"],
        "inputs": ", ".join(f"{k} {v}" for k, v in inputs.items()),
    }


def footnotes(table: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """The table with its notes and reasons as numbers in the column `note`, and their texts in that order, each once."""
    words = [table[c].fillna("").astype(str) for c in ("note", "reason", "leak") if c in table]
    if not words:
        return table, []
    joined = ["; ".join(filter(None, parts)) for parts in zip(*words)]
    notes = list(dict.fromkeys(filter(None, joined)))
    numbers = {note: str(number) for number, note in enumerate(notes, 1)}
    return table.drop(columns=["note", "reason", "leak"], errors="ignore").assign(note=[numbers.get(note, "") for note in joined]), notes


def digits_of(name: str) -> int:
    """Digits that a table is shown with: the odometry table's errors are of centimetres."""
    return 4 if name == "odometry" else 3


def html(report: Report) -> str:
    """The page, with everything in it: no file, script or address of elsewhere."""
    options = {"autoescape": True, "undefined": StrictUndefined, "trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(loader=FileSystemLoader(PACKAGE), **options)
    environment.filters |= {"cell": cell, "footnotes": footnotes}
    drawing = report.run.root / "docs/overview.svg"
    pictures = {k: base64.b64encode(path.read_bytes()).decode() for k, path in report.figures.items()}
    return environment.get_template("report.html.j2").render(
        report=report,
        drawing=drawing.read_text(encoding="utf-8") if drawing.is_file() else "",
        claims=report.claims[["claim", "metric", "verdict", *(c for c in report.claims if c not in ("claim", "metric", "verdict"))]],
        tables={k: (title, readable(report.tables[k], digits_of(k))) for k, title in TITLES.items()},
        pictures=pictures,
        captions=CAPTIONS if report.run.profile.data.has_truth else CAPTIONS | _WORDS["without_truth"],
        more={k: readable(frame, digits_of(k)) for k, frame in report.more.items()},
        oddities=paper.ODDITIES,
        rules=RULES,
        first=FIRST_LOOK,
    )


def cell(value: Any) -> str:
    """A value as a table cell has it: nothing for NaN, four digits of a float."""
    if value is None or (not isinstance(value, str) and pd.isna(value)):
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def write_report(run: Run, report: Report) -> Path:
    """Write `results/<profile>/report.html`, and the judged tables beside the others."""
    path = run.results / "report.html"
    write_text(path, html(report))
    inputs = [run.results / "tables" / f"{name}.csv" for name in TITLES]
    run.save_table(report.claims, "report_claims", inputs)
    run.save_table(report.numbers, "report_numbers", inputs)
    return path
