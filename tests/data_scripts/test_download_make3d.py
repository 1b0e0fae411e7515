"""What is Make3D's own of its download; the rest is in test_download_kitti.py. In-process, against a server with a toy test set."""

import hashlib
import io
import json

import cv2
import numpy as np
import pytest
from loopback import tar_of
from scipy.io import savemat

from data_scripts import download_make3d as script
from dualdepth.data.make3d import find_pairs

PHOTOS, GRIDS = "Test134.tar.gz", "Test134Depth.tar.gz"
NAMES = ("a-p-001t000", "b-p-002t000", "c-p-003t000")


def photo(seed, keep=None):
    coarse = np.random.default_rng(seed).integers(0, 255, (16, 12, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", cv2.resize(coarse, (120, 160)))[1].tobytes()[:keep]


def grid(seed):
    buffer = io.BytesIO()
    savemat(buffer, {"Position3DGrid": np.random.default_rng(seed).uniform(1, 80, (55, 305, 4))})
    return buffer.getvalue()


def photos(**changes):
    return {f"img-{name}.jpg": photo(seed) for seed, name in enumerate(NAMES)} | changes


def grids(**changes):
    return {f"Gridlaserdata/depth_sph_corr-{name}.mat": grid(seed) for seed, name in enumerate(NAMES)} | changes


@pytest.fixture
def server(bare_server, monkeypatch):
    monkeypatch.setattr(script, "MAKE3D_PHOTOS", len(NAMES))
    bare_server.files[PHOTOS] = tar_of(photos(**{"._img-a-p-001t000.jpg": b"of another system", "Readme": b"read me"}))
    bare_server.files[GRIDS] = tar_of(grids())
    return bare_server


def run(server, root, *arguments):
    return script.main(["--root", str(root), *arguments], home=server.home)


def files(root):
    return sorted(str(path.relative_to(root)) for path in root.rglob("*") if path.is_file())


def test_both_archives_are_laid_out_as_make3d_root_however_they_nest(server, tmp_path, capsys):
    assert run(server, tmp_path) == 0
    expected = [f"Gridlaserdata/depth_sph_corr-{name}.mat" for name in NAMES] + [f"Test134/img-{name}.jpg" for name in NAMES]
    assert files(tmp_path) == sorted([*expected, "Gridlaserdata/.complete.json", "Test134/.complete.json"])
    assert [pair.name for pair in find_pairs(tmp_path)] == list(NAMES) and f"MAKE3D_ROOT={tmp_path}" in capsys.readouterr().out
    server.requests.clear()
    assert run(server, tmp_path) == 0 and server.requests == []


def test_the_marker_says_what_came(server, tmp_path):
    server.files[PHOTOS] = tar_of(photos(**{"img-b-p-002t000.jpg": photo(1, keep=-100)}))
    run(server, tmp_path)
    marker = json.loads((tmp_path / "Test134" / ".complete.json").read_text())
    assert marker["sha256"] == hashlib.sha256(server.files[PHOTOS]).hexdigest()
    assert marker["files"] == 3 and marker["truncated"] == ["img-b-p-002t000.jpg"]


def test_archives_with_other_files_are_refused_and_come_anew_the_next_time(server, tmp_path, refused):
    good, server.files[PHOTOS] = server.files[PHOTOS], tar_of({"img-a.jpg": photo(0)})
    assert "Test134.tar.gz: holds 1 files img-*.jpg, expected 3" in refused(run, server, tmp_path)
    assert not (tmp_path / "archives" / PHOTOS).exists()
    server.files[PHOTOS] = good
    assert run(server, tmp_path) == 0 and len(files(tmp_path)) == 8


def test_photos_and_grids_that_do_not_fit_together_are_named(server, tmp_path, refused):
    wrong = {"Gridlaserdata/depth_sph_corr-x.mat": grid(0)} | dict(list(grids().items())[1:])
    server.files[GRIDS] = tar_of(wrong)
    assert "depth_sph_corr-x.mat stands alone, img-a-p-001t000.jpg stands alone" in refused(run, server, tmp_path)
