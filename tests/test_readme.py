"""README's tables of results are made from the published runs."""

import re

import pandas as pd
import pytest

from dualdepth.run import project_root

METHODS = {
    "Constant depth": ("", "constant depth"),
    "Train set mean": ("", "mean depth map of other streets"),
    "LR-Net": ("lr", "**LR-Net**"),
    "LR-Net + HR-Net, w/ SA": ("dual", "**LR-Net + HR-Net, with SA**"),
}


def table_of(profile):
    """The rows in Markdown: Abs Rel and δ<1.25 of all pixels, Abs Rel near and far."""
    folder = project_root() / "results/published" / profile / "tables"
    main, distance = (pd.read_csv(folder / f"{name}.csv").query("source == 'measured'") for name in ("main", "distance"))
    parts = distance[distance["scaling"] == "one median ratio an image"].set_index(["variant", "distance"])["abs_rel"]
    main, lines = main.set_index("method"), ["| | Abs Rel | δ<1.25 | Abs Rel ≤ 20 m | Abs Rel > 20 m |", "|---|---|---|---|---|"]
    for method, (variant, name) in METHODS.items():
        numbers = [*main.loc[method, ["abs_rel", "a1"]], *(parts.get((variant, part)) for part in ("<= 20 m", "> 20 m"))]
        lines.append(f"| {' | '.join([name, *('' if pd.isna(n) else f'{n:.3f}' for n in numbers)])} |")
    return "\n".join(lines)


@pytest.mark.parametrize("profile", ["miniature", "sample"])
def test_a_table_of_the_readme_is_that_of_the_published_run(profile):
    page = project_root() / "README.md"
    shown = re.search(rf"(?s)<!-- results/published/{profile} -->\n\n(.*?)\n\n", page.read_text(encoding="utf-8"))
    assert shown and shown[1] == table_of(profile), f"the table of {profile} must be\n{table_of(profile)}"
