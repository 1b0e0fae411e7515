"""No network but for downloads from the public addresses, and a closed JupyterLab."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

from data_scripts import sources

REPOSITORY = Path(__file__).parents[2]
SOURCES = [path for folder in ("dualdepth", "data_scripts", "tools") for path in sorted((REPOSITORY / folder).rglob("*.py"))]
IMPORT_ALL = """
import importlib, pkgutil, socket, sys

def forbidden(*arguments, **settings):
    raise AssertionError(f"network at import: {arguments}")

for name in ("connect", "connect_ex", "sendto"):
    setattr(socket.socket, name, forbidden)
socket.getaddrinfo = socket.create_connection = forbidden
import data_scripts, dualdepth
names = [m.name for p in (dualdepth, data_scripts) for m in pkgutil.walk_packages(p.__path__, p.__name__ + ".")]
for name in names:
    importlib.import_module(name)
print(len(names))
"""


@pytest.mark.slow
def test_no_module_needs_the_network_to_be_imported():
    done = subprocess.run([sys.executable, "-c", IMPORT_ALL], capture_output=True, text=True, check=False, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 80


def test_addresses_stand_in_the_manifest_alone_and_are_https():
    for path in SOURCES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        texts = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
        addresses = [text for text in texts if re.match(r"\w+://", text)]
        assert not addresses or path.name == "sources.py", path
        assert all(address.startswith("https://") for address in addresses)
    homes = {value for name, value in vars(sources).items() if name.endswith("_HOME")}
    assert len(homes) == 3 and all(re.match(r"https://[a-z0-9.-]+/", home) for home in homes)
    relative = [a.address for a in (*sources.ODOMETRY, sources.IMPROVED_DEPTH, *sources.drive_archives(["2011_09_26_drive_0001"]))]
    relative += [entry.path for entry in sources.LISTS.values()] + [archive.name for archive in sources.MAKE3D]
    assert not [address for address in relative if "://" in address or address.startswith("/") or ".." in address]


def test_nothing_but_the_downloads_opens_addresses():
    for path in SOURCES:
        imported = re.findall(r"(?m)^\s*(?:import|from) (urllib\.request|http\.client|requests|httpx|aiohttp)\b", path.read_text())
        assert not imported or path.name == "fetch.py", path


def test_the_lab_listens_on_this_machine_alone_and_keeps_its_token():
    recipe = re.search(r"^lab:.*\n((?:\t.*\n)+)", (REPOSITORY / "Makefile").read_text(), re.MULTILINE)[1]
    assert re.findall(r"--(?:\w+\.)?ip[ =](\S+)", recipe) == ["127.0.0.1"]
    for opened in ("token", "password", "allow_origin", "allow_remote", "xsrf", "0.0.0.0", "--config"):
        assert opened not in recipe
    assert not list(REPOSITORY.glob("**/jupyter_*_config.*")) or all(".venv" in str(p) for p in REPOSITORY.glob("**/jupyter_*_config.*"))
