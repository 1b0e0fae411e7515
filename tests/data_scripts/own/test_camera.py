"""A camera that is given, found or estimated is the true one, and one that cannot be is refused."""

import json

import numpy as np
import pytest
from own_film import chessboards

from data_scripts.own import camera
from data_scripts.own.camera import calibrate, camera_of_field, camera_of_file, camera_of_numbers
from dualdepth.errors import InputError

SIZE = (240, 320)
TRUE = np.array([[290.0, 0, 163], [0, 285.0, 117], [0, 0, 1]])
LENS = (-0.22, 0.06, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def boards():
    return [(f"view {k}", image) for k, image in enumerate(chessboards(TRUE, LENS, SIZE))]


@pytest.fixture(scope="module")
def found(boards):
    return calibrate(boards, (9, 6), SIZE, "boards")


def test_a_chessboard_gives_the_camera_that_rendered_it_by_its_squares_too(found, boards):
    assert np.abs(found.matrix - TRUE).max() < 3, found.matrix  # 1 % of the focal length
    assert found.distortion[0] == pytest.approx(LENS[0], abs=0.03)
    assert "9x6 inner corners in 12 of 12 views" in found.origin and "RMS error 0." in found.origin
    assert np.allclose(calibrate(boards, (10, 7), SIZE, "boards").matrix, found.matrix)


def test_boards_that_do_not_do_are_refused(boards, monkeypatch):
    blank = [(f"blank {k}", np.full((*SIZE, 3), 128, np.uint8)) for k in range(3)]
    with pytest.raises(InputError, match=r"boards: the whole board of 9x6 was found in 2 of 5 views, 8 are needed"):
        calibrate([*boards[:2], *blank], (9, 6), SIZE, "boards")
    with pytest.raises(InputError, match="view 0: has 320×240 pixels, the frames have 640×480"):
        calibrate(boards, (9, 6), (480, 640), "boards")
    monkeypatch.setattr(camera, "REPROJECTION", 0.01)  # finer than these pixels can tell
    with pytest.raises(InputError, match=r"boards: the corners are off by 0\.\d\d pixels \(RMS\), at most 0\.01"):
        calibrate(boards, (9, 6), SIZE, "boards")


def test_an_estimate_from_the_field_of_view_is_a_pinholes_and_says_that_it_is_one():
    wide = camera_of_field(90, (1080, 1920))
    assert wide.matrix[0, 0] == pytest.approx(960) and wide.matrix[1, 1] == pytest.approx(960)
    assert tuple(wide.matrix[:2, 2]) == (959.5, 539.5) and wide.field == pytest.approx(90)
    assert wide.origin.startswith("ESTIMATED")


WRONG = {
    "290,285,163": "give fx,fy,cx,cy",
    "a,b,c,d": "give fx,fy",
    "nan,285,163,117": "must be finite",
    "-290,285,163,117": "above 0",
}
WRONG |= {"4.2,4.2,163,117": "of 177 degrees", "2900,2850,163,117": "of 6 degrees", "290,900,163,117": "fx and fy differ"}
WRONG |= {"290,285,400,117": "outside of the frame", "290,285,163,-1": "outside of the frame", "290,285,163,117,320,120": "another shape"}
WRONG |= {"290,285,280,117": "far from the middle.*fx,fy,cx,cy,width,height"}


@pytest.mark.parametrize(("text", "said"), WRONG.items())
def test_numbers_that_cannot_be_are_refused_with_what_to_do(text, said):
    with pytest.raises(InputError, match=f"--intrinsics.*{said}"):
        camera_of_numbers(text, SIZE)


def test_numbers_of_another_size_are_scaled_from_it_about_the_middles_of_pixels(tmp_path):
    given = camera_of_numbers("721.5,721.5,609.5,172.5,1242,375", (187, 621))
    assert given.matrix.diagonal()[:2].tolist() == [360.75, 721.5 * 187 / 375] and given.cx == 304.5
    assert camera_of_numbers("290,285,280,117,320,240", SIZE).cx == 280  # a crop's, whose size is told
    (tmp_path / "c.json").write_bytes('\ufeff{"fx": 721, "fy": 721, "cx": 309, "cy": 172}'.encode())
    with pytest.raises(InputError, match=r"c\.json: .*far from the middle"):
        camera_of_file(tmp_path / "c.json", SIZE)


def test_a_record_is_read_back_as_the_same_camera(tmp_path, found):
    path = tmp_path / "own.json"
    path.write_text(json.dumps({"camera": camera.record(found)}))
    again = camera_of_file(path, SIZE)
    assert np.allclose(again.matrix, found.matrix, atol=1e-4) and again.distortion == found.distortion
    double = camera_of_file(path, (480, 640))
    assert np.allclose(double.matrix[:2], 2 * again.matrix[:2] + [[0, 0, 0.5], [0, 0, 0.5]]) and double.field == pytest.approx(again.field)
    assert double.distortion == again.distortion and "320×240" in double.origin


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "cannot be read"),
        ('{"fx": 290, "fy": 285, "cx": 163}', "cannot be read .*cy"),
        ('{"fx": 290, "fy": 285, "cx": 163, "cy": 117, "width": 320}', "cannot be read .*height"),
        ('{"fx": 290, "fy": 285, "cx": 163, "cy": 117, "width": 320, "height": 0}', "is of 320×0"),
        ('{"fx": 290, "fy": 285, "cx": 163, "cy": 117, "distortion": [1, 2, 3]}', "distortion has 3 numbers"),
        ('{"fx": 290, "fy": 285, "cx": 163, "cy": 117, "k1": -0.3, "image_width": 320}', "unknown image_width, k1; known are .*width"),
    ],
)
def test_a_json_that_is_no_camera_is_refused(tmp_path, text, said):
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(InputError, match=rf"c\.json: {said}"):
        camera_of_file(tmp_path / "c.json", SIZE)


@pytest.mark.parametrize("named", ["P_rect_02: ", "P2: ", "P0: ", ""])
def test_kittis_calibration_files_are_read(tmp_path, named):
    path = tmp_path / "calib.txt"
    path.write_text(f"{named}290 0 163 4.5 0 285 117 0.2 0 0 1 0.003\n")
    assert np.allclose(camera_of_file(path, SIZE).matrix, TRUE)
    path.write_text("S_rect_02: 1242 375\nP_rect_02: 721 0 609 0 0 721 172 0 0 0 1 0\n")
    assert camera_of_file(path, (375, 1242)).matrix[0, 0] == 721
    with pytest.raises(InputError, match="is of 1242×375 pixels, the frames, 640×240"):
        camera_of_file(path, (240, 640))
    path.write_text("image_width: 640\ncamera_matrix:\n  rows: 3\n  cols: 3\n")  # ROS
    with pytest.raises(InputError, match=r'calib\.txt: has none of KITTI.s matrices P_rect_02.*JSON: {"fx"'):
        camera_of_file(path, SIZE)
