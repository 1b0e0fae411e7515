"""Run commands on files that may not be touched, as a user who has no special rights; writes what came of each as JSON to stdout.

    python unprivileged.py FOLDER

Root may touch all files, so the commands run in children that gave root's rights up; what they import was imported before.
Exit code 77: rights cannot be given up here.
"""

import contextlib
import io
import json
import os
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[place]) for place in (1, 2)] + [str(Path(__file__).parents[1] / "data_scripts")]

from worlds import CAMERAS, DRIVE, SCAN, WORLDS  # noqa: E402

NOBODY = 65534
DENIED = [
    ("scans", "list.txt"),
    ("scans", SCAN),
    ("scans", CAMERAS),
    ("scans", f"kitti/{DRIVE}"),
    ("scans", f"kitti/{DRIVE}/image_02/data"),
    ("scans", "kitti"),
    ("scans", "."),
    ("improved", "improved"),
    ("depth", "P.npy"),
    ("depth", "G.npz"),
    ("depth", "w.json"),
    ("depth", "."),
    ("odometry", "pred.txt"),
    ("labels", "labels.png"),
    ("PNG frames", "own.yaml"),
    ("PNG frames", "work/own/prepared/triplets.csv"),
    ("PNG frames", "work/own/runs/lr/seed0"),
]
"""What is read, and which file or folder of it may not be touched; `.` is the folder to write to."""


def give_up_rights() -> None:
    """Go on as nobody."""
    os.setgroups([])
    os.setgid(NOBODY)
    os.setuid(NOBODY)


def outcome(call, report: Path, drop: bool) -> dict[str, object]:
    """Exit code and stderr of a call in a child."""
    report.write_text("")
    report.chmod(0o666)
    if not (child := os.fork()):
        code, said = 1, io.StringIO()
        with contextlib.suppress(BaseException), contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            if drop:
                give_up_rights()
            try:
                code = call()
            except SystemExit as stop:
                code = stop.code
            except BaseException as error:
                print(f"Traceback: {error!r}", file=said)
        report.write_text(said.getvalue())
        os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return {"code": code, "said": report.read_text()}


def main(folder: Path) -> int:
    """Try all of `DENIED`."""
    drop, results = os.geteuid() == 0, {}
    if drop:
        if not (child := os.fork()):
            try:
                give_up_rights()
            except OSError:
                os._exit(77)
            os._exit(0)
        if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]):
            return 77
    folder.chmod(0o755)
    for number, (world, name) in enumerate(DENIED):
        place = folder / str(number)
        place.mkdir()
        os.chdir(place)
        call = WORLDS[world](place)
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            assert call() == 0  # with all rights it works
        for written in ("out.npz", "out.json"):
            (place / written).unlink(missing_ok=True)
        if name != ".":
            place.chmod(0o777)
        path, report = place / name, folder / f"{number}.txt"
        path.chmod(0o555 if name == "." else 0)
        before = sorted(p.name for p in place.iterdir())
        results[f"{world} {name}"] = outcome(call, report, drop) | {"left": sorted(set(os.listdir(place)) - set(before))}
        path.chmod(0o755)
    print(json.dumps(results))
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
