"""The soak counts what its parts counted, and a part that fails, whatever it does to itself."""

import json
import signal

import pandas as pd
import pytest

from tests.reliability import soak
from tests.reliability.soak import Part, by_pytest, run_part, save

COUNT = "from tests.reliability.counting import write_count; write_count('kills', 5, {held}, 'x')"


def part(code, **settings):
    return Part("a part", ["-c", code], **settings)


def test_rows_are_what_a_part_counted():
    assert run_part("p", part(COUNT.format(held=5))) == [{"test": "kills", "tried": 5, "held": 5, "note": "x"}]


@pytest.mark.parametrize(
    "code, says",
    [
        ("raise SystemExit(3)", "ended with 3"),
        (f"import os; os.kill(os.getpid(), {int(signal.SIGKILL)})", "ended with -9"),
        ("pass", "ended with 0 and counted too little"),
        (COUNT.format(held=5) + "; raise SystemExit(1)", "ended with 1"),
    ],
)
def test_a_part_that_fails_or_counts_nothing_is_a_row_that_did_not_hold(code, says):
    row = run_part("p", part(code))[-1]
    assert (row["test"], row["tried"], row["held"]) == ("a part", 1, 0) and says in row["note"]


def test_what_did_not_hold_is_not_counted_twice():
    assert [row["held"] for row in run_part("p", part(COUNT.format(held=4) + "; raise SystemExit(1)"))] == [4]


def test_tests_count_their_cases_and_a_failed_one_that_counts_none_is_told_too(tmp_path):
    path = tmp_path / "test_it.py"
    path.write_text("from tests.reliability.counting import write_count\ndef test_a(): write_count('a', 3, 3)\ndef test_b(): assert 0\n")
    words = by_pytest(str(path), "--rootdir", str(tmp_path), "-c", "/dev/null")
    rows = run_part("p", Part("a part", words, counted=True))
    assert [(row["tried"], row["held"]) for row in rows] == [(3, 3), (1, 0)] and "2 tests, 1 failed" in rows[0]["note"]


def test_tests_that_count_nothing_are_counted(tmp_path):
    report = tmp_path / "report.xml"
    report.write_text('<testsuites><testsuite tests="5" failures="1" errors="0" skipped="1"/></testsuites>')
    row = soak._of_tests(Part("a part", []), [], report)
    assert row == {"test": "a part", "tried": 4, "held": 3, "note": "4 tests, 1 failed, 1 skipped"}


def test_the_table_keeps_the_rows_of_parts_that_did_not_run(tmp_path, monkeypatch):
    monkeypatch.setattr(soak, "OUT", tmp_path / "reliability.csv")
    row = {"test": "t", "tried": 2, "held": 2, "note": "n, with a comma"}
    save("fuzz", [row], {"device": "other", "revision": "a"})
    save("kills", [row | {"test": "k"}], {"device": "this", "revision": "b"})
    save("fuzz", [row | {"held": 1}], {"device": "this", "revision": "b"})
    table = pd.read_csv(tmp_path / "reliability.csv")
    assert list(table.columns) == ["test", "tried", "held", "note", "device"]
    assert table[["test", "held", "device"]].to_numpy().tolist() == [["k", 2, "this"], ["t", 1, "this"]]
    assert json.loads((tmp_path / "reliability.json").read_text())["kills"]["revision"] == "b"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["reliability.csv", "reliability.json"]


def test_an_unknown_part_is_refused(capsys):
    with pytest.raises(SystemExit) as stop:
        soak.main(["kils"])
    assert stop.value.code == 2 and "unknown part kils; there are kills, chains" in capsys.readouterr().err
