"""Which room may import which: read from the source, also what a function imports only when it is called."""

import subprocess
import sys

import pytest
from import_graph import ROOT, closure, imports_of, modules

ORDER = [
    *("dualdepth", "errors", "files", "device", "geometry", "refinement", "paper", "networks"),
    *("settings", "profile", "losses", "data", "evaluation", "run", "training"),
    *("model", "inference", "tables", "report", "notebooks", "cli"),
]
"""Rooms and modules of the root from the ground up: each imports only those before it, and itself."""
NEVER = {
    "networks": {*ORDER} - {"dualdepth", "errors", "geometry", "networks"},
    "geometry": {*ORDER} - {"geometry"},
    "losses": {"data", "profile", "run", "training", "networks"},
    "data": {"networks", "profile", "losses"},
    "evaluation": {"networks", "profile", "losses", "settings"},
}
"""What a room must not import although it lies before it."""
OWN_CAMERA = {"data_scripts.own_camera", "data_scripts.find_data"}
"""The doors of the room of own cameras."""


def room(module):
    """Of a module of `dualdepth`."""
    return module.split(".")[1] if "." in module else module


def edges():
    """All (importer, imported)."""
    return [(module, other) for module in modules() for other in imports_of(module)]


def test_no_module_imports_itself_by_way_of_others():
    assert [module for module in modules() if module in closure(imports_of(module))] == []


def test_no_arrow_of_the_package_runs_up():
    place = {name: number for number, name in enumerate(ORDER)}
    ours = [(a, b) for a, b in edges() if a.startswith("dualdepth") and b.startswith("dualdepth")]
    assert [(a, b) for a, b in ours if place[room(a)] < place[room(b)] or room(b) in NEVER.get(room(a), ())] == []


def test_the_package_never_imports_scripts_or_tools_and_the_cameras_room_has_two_doors():
    assert [(a, b) for a, b in edges() if a.startswith("dualdepth") and b.startswith(("data_scripts", "tools"))] == []
    inside = ("data_scripts.own.", "data_scripts.own")
    outside = {a for a, b in edges() if b.startswith(inside[0]) or b == inside[1]} - {a for a in modules() if a.startswith(inside[0])}
    assert outside <= OWN_CAMERA


def test_the_corridor_is_short():
    assert len([*(ROOT / "dualdepth").glob("*.py")]) <= 15


HEAVY = {"torch", "transformers", "pandas", "numpy", "scipy", "snakemake", "cv2", "matplotlib", "kornia", "accelerate", "papermill", "PIL"}


@pytest.mark.slow
@pytest.mark.parametrize("words", ["", "evaluate depth", "evaluate odometry", "reproduce", "predict", "train", "export", "notebook"])
def test_help_loads_nothing_heavy(words):
    call = f"main({[*words.split(), '--help']})"
    program = f"import sys\nfrom dualdepth.cli import main\ntry:\n    {call}\nexcept SystemExit:\n    print('LOADED', *sys.modules)"
    said = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    loaded = set(said.split("LOADED")[1].split())
    assert "argparse" in loaded and not loaded & HEAVY
