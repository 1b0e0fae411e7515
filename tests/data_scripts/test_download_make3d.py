"""What is Make3D's own of its download; the rest is in test_download_kitti.py. In-process, against a server with a toy test set."""

import hashlib
import io
import json

import cv2
import numpy as np
import pytest
from loopback import files, tar_of
from scipy.io import savemat

from data_scripts import download_make3d as script
from dualdepth.data.make3d import find_pairs

PHOTOS, GRIDS = "Test134.tar.gz", "Test134Depth.tar.gz"
NAMES = ("a-p-001t000", "b-p-002t000", "c-p-003t000")
OTHERS = {"._img-a-p-001t000.jpg": b"of another system", "Readme": b"read me"}


def photos(*names):
    photo = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (160, 120, 3), dtype=np.uint8))[1].tobytes()
    return tar_of({f"img-{name}.jpg": photo for name in names} | {f"img-{names[0]}.jpg": photo[:-100]} | OTHERS)


def grids(*names):
    buffer = io.BytesIO()
    savemat(buffer, {"Position3DGrid": np.random.default_rng(0).uniform(1, 80, (55, 305, 4))})
    return tar_of({f"Gridlaserdata/depth_sph_corr-{name}.mat": buffer.getvalue() for name in names})


@pytest.fixture
def server(bare_server, monkeypatch):
    monkeypatch.setattr(script, "MAKE3D_PHOTOS", len(NAMES))
    bare_server.files |= {PHOTOS: photos(*NAMES), GRIDS: grids(*NAMES)}
    return bare_server


def run(server, root):
    script.main(["--root", str(root)], home=server.home)


def test_both_archives_are_laid_out_as_make3d_root_however_they_nest(server, tmp_path, capsys):
    run(server, tmp_path)
    expected = [f"Gridlaserdata/depth_sph_corr-{name}.mat" for name in NAMES] + [f"Test134/img-{name}.jpg" for name in NAMES]
    assert files(tmp_path) == sorted([*expected, "Gridlaserdata/.complete.json", "Test134/.complete.json"])
    assert [pair.name for pair in find_pairs(tmp_path)] == list(NAMES) and f"MAKE3D_ROOT={tmp_path}" in capsys.readouterr().out
    marker = json.loads((tmp_path / "Test134" / ".complete.json").read_text())
    assert marker["sha256"] == hashlib.sha256(server.files[PHOTOS]).hexdigest() and marker["files"] == 3
    server.requests.clear()
    run(server, tmp_path)
    assert server.requests == []


def test_archives_with_other_files_or_damaged_ones_are_refused_and_come_anew_the_next_time(server, tmp_path, refused):
    good = server.files[PHOTOS]
    for bad, said in ((photos("a"), "holds 1 files img-*.jpg, expected 3"), (good[:-9], "not a whole zip or gzipped tar archive")):
        server.files[PHOTOS] = bad
        assert f"Test134.tar.gz: {said}" in refused(run, server, tmp_path) and files(tmp_path) == []
    server.files[PHOTOS] = good
    run(server, tmp_path)
    assert len(files(tmp_path)) == 8


def test_photos_and_grids_that_do_not_fit_together_are_named(server, tmp_path, refused):
    server.files[GRIDS] = grids("x", *NAMES[1:])
    assert "depth_sph_corr-x.mat stands alone, img-a-p-001t000.jpg stands alone" in refused(run, server, tmp_path)
