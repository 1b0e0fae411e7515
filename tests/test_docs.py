"""README, CONTRIBUTING and docs/: links lead somewhere, settings exist, commands are what the programs take, short ones run."""

import re
import shlex
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from doc_commands import (
    PAGES,
    REPOSITORY,
    Command,
    dry_make,
    dry_program,
    dry_pytest,
    dry_torchrun,
    fenced_commands,
    fences,
    inline_code,
    inline_commands,
    program,
    prose,
    trust,
)
from own_film import write_video
from small_nets import with_heads

from dualdepth.data.odometry import write_trajectory
from dualdepth.model import DepthModel
from dualdepth.profile import Profile, _laid_over, _settings, load_profile
from dualdepth.training.loop import total_steps
from tools import settings_page

DRIVE = "2011_09_26/2011_09_26_drive_0052_sync"

# A command belongs to the longest entry that its words begin with. EXECUTED run on the files of `small_world`, whose names are those that
# the pages use; DRY are only parsed, and say by what. A new command needs a line in one of the two; its options do not.
EXECUTED = (
    "dualdepth evaluate depth",
    "dualdepth evaluate odometry",
    "dualdepth export",
    "dualdepth predict",
    "dualdepth --help",
    "python data_scripts/export_depth.py",
)
DRY = {
    # long, or in need of KITTI, a network, a GPU or a cluster
    "make": dry_make,
    "dualdepth reproduce": dry_program,
    "dualdepth train": dry_program,
    "python data_scripts/prepare_data.py": dry_program,
    "python data_scripts/own_camera.py": dry_program,  # a film that a person would make; tests/data_scripts/test_own_camera.py runs it
    "python data_scripts/download_kitti.py": dry_program,
    "python data_scripts/download_make3d.py": dry_program,
    "python data_scripts/export_labels.py": dry_program,
    "python -m tools.bench": dry_program,
    "python -m pytest": dry_pytest,
    "torchrun": dry_torchrun,
    "srun": dry_torchrun,
    "dualdepth notebook": dry_program,
    "python -m venv": trust,
    "pip install": trust,
    ". .venv/bin/activate": trust,
}


def entry_of(command: Command) -> str | None:
    """The longest entry that a command begins with."""
    entries = [e for e in (*EXECUTED, *DRY) if command.words[: len(e.split())] == e.split()]
    return max(entries, key=len, default=None)


def named(command: Command) -> str:
    return f"{command.page}: {' '.join(command.words)}"


@pytest.fixture
def small_world(tmp_path, monkeypatch, kitti_factory, write_scan, encoder):
    """The files that the pages' examples name, small, in the working directory; gives what puts them in place of a reader's folders."""
    monkeypatch.chdir(tmp_path)
    root, rng = kitti_factory({DRIVE: range(2)}), np.random.default_rng(0)
    for index in range(2):
        write_scan(root, DRIVE, index)
    Path("frames.txt").write_text("".join(f"{DRIVE} {index:010d} l\n" for index in range(2)))
    np.save("disparities.npy", rng.uniform(0.02, 0.2, (2, 16, 52)).astype(np.float32))
    np.save("depths.npy", rng.uniform(5, 50, (2, 16, 52)).astype(np.float32))
    np.savez("gt.npz", **{f"{i:06d}": rng.uniform(2, 70, (48, 160)).astype(np.float32) for i in range(2)})
    poses = np.tile(np.eye(4), (300, 1, 1))
    poses[:, 2, 3] = np.arange(300)
    Path("poses").mkdir()
    write_trajectory("poses/09.txt", poses)
    write_trajectory("09.txt", poses)
    cv2.imwrite("photo.jpg", rng.integers(0, 255, (120, 200, 3), np.uint8))
    write_video("drive.mp4", rng.integers(0, 255, (2, 120, 200, 3), np.uint8))
    model = with_heads(DepthModel({"network": "hr", "encoder": encoder, "hr_size": [192, 288]}, device="cpu"))
    model.save_pretrained("work/miniature/runs/lr/seed0")
    shutil.copytree("work/miniature/runs/lr", "work/miniature/runs/dual")
    return lambda words: [str(root) if word == "/data/kitti_raw" else word for word in words]


def test_there_are_commands():
    found = {page: {entry_of(c) for c in fenced_commands() if c.page == page} for page in ("README.md", "data.md", "scale.md")}
    assert found["README.md"] >= {"make", "dualdepth predict", "python data_scripts/own_camera.py"}
    assert found["data.md"] >= {*EXECUTED[:2]} and found["scale.md"] >= {"torchrun", "srun"}


def in_its_ring(command: Command) -> object:
    return pytest.param(command, marks=[pytest.mark.slow] if "export" in command.words[:2] else [], id=named(command))  # ten seconds


@pytest.mark.parametrize("command", [in_its_ring(command) for command in {c.text: c for c in fenced_commands()}.values()])
def test_every_command_runs_on_small_data_or_is_dry_run(command, request, monkeypatch, capsys):
    entry = entry_of(command)
    assert entry, f"{named(command)}: a new command; add it to EXECUTED or DRY in tests/test_docs.py"
    if entry in DRY:
        DRY[entry](command.words, monkeypatch)
        return
    main, arguments = program(request.getfixturevalue("small_world")(command.words))
    try:
        code = main(arguments)
    except SystemExit as stop:
        code = stop.code
    assert not code, capsys.readouterr().err


@pytest.mark.parametrize("command", inline_commands(), ids=named)
def test_commands_in_prose_are_known(command, monkeypatch):
    """`dualdepth train` in a sentence mentions a command; one with options is a command to type."""
    entry = entry_of(command)
    assert entry, f"{named(command)}: unknown; add it to EXECUTED or DRY in tests/test_docs.py"
    mention = entry not in DRY or DRY[entry] is dry_program
    if mention and not any(word.startswith("-") for word in command.words[1:] if word != "-m"):
        command = command._replace(text=f"{' '.join(map(shlex.quote, command.words))} --help")
    DRY.get(entry, dry_program)(command.words, monkeypatch)


def anchors(page):
    """Anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files_and_headings_and_files_that_are_named_exist(page):
    """`dualdepth/settings.py` in prose is a file of the repository; what a run writes, or a pattern, is none."""
    for code in inline_code(page):
        if re.fullmatch(r"(dualdepth|data_scripts|tests|docs|cluster|notebooks)/[\w./-]*", code):
            assert (REPOSITORY / code).exists(), f"{page.name} names {code}, which is not there"
    for link in re.findall(r"\]\((?![a-z]+:)([^)\s]+)\)", prose(page)):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), f"{page.name} links to {path}, which is not there"
        assert not anchor or anchor in anchors(target), f"{page.name} links to #{anchor} of {target.name}, which has no such heading"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_settings_that_are_named_exist(page):
    settings = set(_settings(Profile, []))
    leaves = {name.rpartition(".")[2] for name in settings} | {"extends"}
    for code in inline_code(page):
        name, colon, _ = code.partition(": ")
        if not re.fullmatch(r"[a-z_]\w*(\.\w+)*", name) or name.endswith((".py", ".yaml", ".json", ".csv")):
            continue
        if name.partition(".")[0] in settings and "." in name:
            assert name in settings, f"{page.name} names the setting {name}, which is none"
        elif colon:
            assert name in leaves, f"{page.name} names the setting {name}, which is none"


def test_the_page_of_settings_is_current_and_that_on_the_method_names_functions_that_exist():
    assert settings_page.PAGE.read_text(encoding="utf-8") == settings_page.page(), "run `python -m tools.settings_page`"
    code = "".join(path.read_text(encoding="utf-8") for path in (REPOSITORY / "dualdepth").rglob("*.py"))
    names = [n for c in inline_code(REPOSITORY / "docs/method.md") if "/" not in c and not c.endswith(".py") for n in c.split(".")]
    assert len(names) > 20 and [n for n in names if not re.search(rf"(def|class) {n}\b", code)] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pieces_of_profiles_are_valid(page):
    """A fence of YAML is part of a profile: with the rest of `paper` it is one."""
    for language, content in fences(page):
        if language == "yaml":
            values = _laid_over(load_profile("paper").model_dump(), yaml.safe_load(content))
            profile = Profile.model_validate(values)
            for name in profile.train:
                profile.of_variant(name)


def test_steps_in_the_page_on_scale_are_those_of_the_profiles():
    text = (REPOSITORY / "docs" / "scale.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| `(\w+)` \| (\d+) \| (\d+) \|$", text, re.MULTILINE)
    assert len(rows) > 10
    for name, variant, triplets, steps in rows:
        profile = load_profile(name)
        stage = getattr(profile.of_variant(variant).training, profile.variant(variant).stage)
        assert total_steps(stage, int(triplets)) == int(steps), f"{name}, {variant}"
