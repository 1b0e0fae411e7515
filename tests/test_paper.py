"""The paper's numbers as data: every number of every table stands in its TeX, row by row."""

import math
import re
from itertools import chain
from pathlib import Path

import pytest

from dualdepth import paper

TEX = Path(__file__).parents[2] / "shared" / "paper.tex"
MARKS = {
    "main": "tab:KITTI",
    "make3d": "tab:make3d",
    "ablation": "tab:ablation_dual",
    "distance": "tab:ablation_disntance",
    "sharpness": "tab:sharpness",
    "sa_region": "tab:sa_region",
    "backbone": "tab:res1",
    "odometry": "tab:pose1",
}


def tex():
    if not TEX.is_file():
        pytest.skip("the paper's source is not beside the repository (../shared/paper.tex)")
    return TEX.read_text(encoding="utf-8")


def tex_rows(name):
    """The numbers of each row of a table, in the TeX's order; rows without one are left out."""
    table = next(t for t in re.findall(r"\\begin\{table.*?\\end\{table", tex(), re.S) if f"{{{MARKS[name]}}}" in t)
    body = table[table.index(r"\toprule") : table.index(r"\bottomrule")]
    rows = []
    for line in body.split(r"\\"):
        # the cells that are nothing but numbers; a cell `mean ± deviation` holds two
        line = re.sub(r"\\multicolumn\{2\}\{[^}]*\}|\\textbf|[{}]", " ", line).replace(r"$\pm$", "&")
        cells = [cell.strip() for cell in line.split("&")]
        numbers = [float(cell) for cell in cells if re.fullmatch(r"\d+(\.\d+)?", cell)]
        if numbers:
            rows.append(numbers)
    return rows


def numbers(name):
    frame = paper.table(name)
    return [[float(v) for v in row if isinstance(v, int | float) and not math.isnan(v)] for row in frame.itertuples(index=False)]


@pytest.mark.parametrize("name", MARKS)
def test_every_row_has_the_numbers_of_the_paper(name):
    found, expected = numbers(name), tex_rows(name)
    if name in ("sharpness", "sa_region"):  # these have a column for each method, and are turned here
        found, expected = (list(chain(*rows)) for rows in (found, expected))
    assert found == expected


def test_tables_are_whole_and_marked_as_the_papers():
    tables = [paper.table(name) for name in MARKS]
    assert [len(table) for table in tables] == [15, 9, 3, 4, 2, 4, 5, 8] and all(set(table["source"]) == {"paper"} for table in tables)


def test_rows_of_the_main_table_have_their_supervision():
    text = tex()
    for row in paper.table("main").itertuples():
        cells = rf"& {re.escape(row.dataset)} +& +{re.escape(row.supervision)} +& (?:\\textbf{{)?{row.abs_rel:.3f}"
        assert re.search(cells, text), row
