"""Notebooks opened in JupyterLab in a headless Chromium, as a person would: open, Run All, look.

python -m tests.lab [--pictures DIR] 00_quickstart 05_table_main
"""

import argparse
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from contextlib import contextmanager
from pathlib import Path

from tests.browser import Browser

REPOSITORY = Path(__file__).parents[1]
PANEL = "window.jupyterapp && jupyterapp.shell.currentWidget && jupyterapp.shell.currentWidget.content"


@contextmanager
def lab(folder: Path):
    """A JupyterLab on this machine's own address that shows a folder; gives the address of a file in it by name."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port, token = free.getsockname()[1], os.urandom(16).hex()
    words = ["lab", "--no-browser", "--expose-app-in-browser", "--ip=127.0.0.1", f"--port={port}", f"--IdentityProvider.token={token}"]
    words += [f"--ServerApp.root_dir={folder}", "--allow-root", "--LabApp.workspaces_dir=" + str(folder / ".workspaces")]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "JUPYTER_CONFIG_DIR": str(folder / ".config")}
    server = subprocess.Popen(
        [sys.executable, "-m", "jupyter", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment, cwd=folder
    )
    address = f"http://127.0.0.1:{port}"
    try:
        for _ in range(600):
            try:
                urllib.request.urlopen(f"{address}/api?token={token}", timeout=5)
                break
            except OSError:
                time.sleep(0.1)
        yield lambda name: f"{address}/lab/tree/{name}?reset&token={token}"  # no other page comes back with it
    finally:
        server.terminate()
        server.wait(30)


def wait_for(window: Browser, condition: str, seconds: float):
    """What a JavaScript expression gives as soon as it is true.

    Raises:
        TimeoutError: it does not become true.
    """
    until = time.monotonic() + seconds
    while not (value := window.run(f"return {condition}")):
        if time.monotonic() > until:
            raise TimeoutError(f"not within {seconds} s: {condition}")
        time.sleep(0.2)
    return value


def run_all(window: Browser, address: str, seconds: float = 600) -> list[dict]:
    """Open a notebook, clear its outputs, run all its cells; returns the cells as they are then."""
    window.open(address, 1400, 900)
    name = address.partition("?")[0].rpartition("/")[2]
    wait_for(window, f"!!({PANEL} && {PANEL}.model && {PANEL}.model.cells.length > 1)", 120)
    wait_for(window, f"jupyterapp.shell.currentWidget.context.path == '{name}'", 120)
    wait_for(window, "jupyterapp.shell.currentWidget.sessionContext.session?.kernel?.status == 'idle'", 120)
    window.run("jupyterapp.commands.execute('notebook:clear-all-cell-outputs')")
    window.run(
        "window.ended = ''; jupyterapp.commands.execute('notebook:run-all-cells').then(() => ended = 'done', e => ended = String(e))"
    )
    wait_for(window, "window.ended", seconds)
    cells = json.loads(window.run(f"return JSON.stringify({PANEL}.model.toJSON().cells)"))
    # a page with changes would ask whether to leave it
    window.run("window.ended = ''; jupyterapp.commands.execute('docmanager:save').then(() => ended = 'saved')")
    wait_for(window, "window.ended", 60)
    window.run("jupyterapp.shell.currentWidget.sessionContext.shutdown()")
    return cells


def faults(cells: list[dict]) -> list[str]:
    """What went wrong: errors that cells show, and code cells that were not run."""
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    errors = [f"{o['ename']}: {o['evalue']}" for cell in code for o in cell["outputs"] if o["output_type"] == "error"]
    return errors + [f"not run: {''.join(cell['source'])[:60]}" for cell in code if cell["execution_count"] is None]


def shows(cells: list[dict], what: str) -> int:
    """How many outputs are of a kind, such as `image/png`, or hold a text in their HTML, such as `<table`."""
    data = [o["data"] for cell in cells if cell["cell_type"] == "code" for o in cell["outputs"] if "data" in o]
    return sum(what in d or what in "".join(d.get("text/html", "")) for d in data)


def main() -> int:
    """Run notebooks of this checkout, on copies."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="+")
    parser.add_argument("--pictures", type=Path, help="folder for a screenshot of each")
    arguments = parser.parse_args()
    failed = 0
    (REPOSITORY / "work").mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=REPOSITORY / "work") as folder:  # a notebook looks for its checkout above itself
        for name in arguments.names:
            shutil.copy(REPOSITORY / "notebooks" / f"{name}.ipynb", folder)
        with lab(Path(folder)) as address, Browser(Path(folder) / ".browser") as window:
            for name in arguments.names:
                cells = run_all(window, address(f"{name}.ipynb"))
                wrong = faults(cells)
                failed += bool(wrong)
                print(f"{name}: {wrong or 'no error'}, {shows(cells, '<table')} tables, {shows(cells, 'image/png')} pictures", flush=True)
                if arguments.pictures:
                    arguments.pictures.mkdir(parents=True, exist_ok=True)
                    window.screenshot(arguments.pictures / f"{name}.png")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
