"""What a person sees in a browser: the first notebook in a running JupyterLab, every cell run, and the report's page, wide and narrow."""

import json
import os
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from selenium import webdriver
from selenium.webdriver.support.ui import WebDriverWait

from dualdepth import paper
from dualdepth.report import TITLES, make_report, write_report
from dualdepth.run import Run

BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
FLAGS = "headless no-sandbox disable-gpu no-first-run disable-background-networking disable-component-update disable-sync"
REPOSITORY = Path(__file__).parents[1]
PAGE = "notebooks/00_quickstart.ipynb"
TINY = REPOSITORY / "results/tiny/report.html"

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not (BROWSER and DRIVER), reason="no chromium with chromedriver: `make browser`")]


@pytest.fixture
def window(tmp_path):
    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    for flag in (*FLAGS.split(), f"user-data-dir={tmp_path / 'browser'}"):
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    with webdriver.Chrome(options, webdriver.ChromeService(DRIVER)) as driver:
        driver.set_script_timeout(500)
        yield driver


@pytest.fixture
def lab(tmp_path):
    """Address and file of the first notebook in a JupyterLab whose checkout holds nothing else, so no trained weights."""
    root = tmp_path / "checkout"
    (root / "notebooks").mkdir(parents=True)
    for name in (PAGE, "Snakefile"):
        shutil.copy(REPOSITORY / name, root / name)
    (root / "docs").symlink_to(REPOSITORY / "docs")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port, token = free.getsockname()[1], os.urandom(16).hex()
    words = ["lab", "--no-browser", "--allow-root", "--expose-app-in-browser", "--ip=127.0.0.1", f"--port={port}"]
    words += [f"--IdentityProvider.token={token}", f"--ServerApp.root_dir={root}", f"--LabApp.workspaces_dir={tmp_path / 'workspaces'}"]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "JUPYTER_CONFIG_DIR": str(tmp_path / "config")}
    server = subprocess.Popen([sys.executable, "-m", "jupyter", *words], stderr=subprocess.DEVNULL, env=environment, cwd=root)
    until = time.monotonic() + 120
    while socket.socket().connect_ex(("127.0.0.1", port)) and time.monotonic() < until:
        time.sleep(0.2)
    yield f"http://127.0.0.1:{port}/lab/tree/{PAGE}?reset&token={token}", root / PAGE
    server.terminate()
    server.wait(30)


def test_the_first_notebook_runs_from_top_to_bottom_in_the_lab(window, lab):
    address, file = lab
    window.get(address)
    ready = "return window.jupyterapp?.shell.currentWidget?.sessionContext?.session?.kernel?.status == 'idle'"
    WebDriverWait(window, 120).until(lambda driver: driver.execute_script(ready))
    for command in ("notebook:clear-all-cell-outputs", "notebook:run-all-cells", "docmanager:save"):
        window.execute_async_script(f"jupyterapp.commands.execute('{command}').finally(arguments[0])")
    cells = [cell for cell in json.loads(file.read_text())["cells"] if cell["cell_type"] == "code"]
    assert [o for cell in cells for o in cell["outputs"] if o["output_type"] == "error"] == []
    assert all(cell["execution_count"] for cell in cells) and sum("image/png" in str(cell["outputs"]) for cell in cells) >= 2


@pytest.mark.parametrize(("width", "phone"), [(1280, False), (390, True)])
def test_the_report_reads_well(width, phone, window, tmp_path):
    run = Run("miniature", tmp_path)
    (run.root / "docs").symlink_to(REPOSITORY / "docs")  # the page holds a drawing of it
    for name in TITLES:
        run.save_table(paper.table(name), name, [])
    run.save_figure(plt.figure(figsize=(12, 2)), "main_depth", [])
    plt.close()
    window.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": phone})
    for page in (write_report(run, make_report(run)), *([TINY] if TINY.exists() else [])):
        window.get(page.as_uri())
        assert set(window.execute_script("return [...document.images].map(i => i.complete && i.naturalWidth > 0)")) == {True}
        assert window.execute_script("return document.documentElement.scrollWidth") <= width
        assert len(window.find_elements("css selector", "main h2")) > len(TITLES) and window.get_log("browser") == []
