"""Readers of KITTI's files: what they give, and the one line they say of a bad file."""

import io

import cv2
import numpy as np
import PIL.Image
import pytest
from small_kitti import DRIVE, wall, write_calibration

from dualdepth.data import kitti
from dualdepth.data.kitti import Frame, intrinsics, read_calibration, read_frame_list, read_image, read_static_frames, read_test_scenes
from dualdepth.errors import InputError
from dualdepth.files import write_text


@pytest.fixture
def listed(tmp_path):
    return lambda text: write_text(tmp_path / "list.txt", text) or tmp_path / "list.txt"


def test_a_list_in_the_fields_format_gives_frames_in_its_order(listed):
    path = listed(f"{DRIVE} 0000000007 l\n\n{DRIVE} 0000000003 r\n{DRIVE} 12\n")
    assert read_frame_list(path) == [Frame(DRIVE, 7), Frame(DRIVE, 3, "image_03"), Frame(DRIVE, 12)]


def test_lists_of_other_scripts_and_systems_are_read(tmp_path):
    left, right = (f"{DRIVE}/image_0{camera}/data/0000000007" for camera in (2, 3))
    text = f'\ufeff{DRIVE}\t0000000007\tl\r\n"{DRIVE} 7 l"\r\n{left}.png\r\n{left}.jpg {right}.jpg\r\n{right}.PNG\r\n'
    (tmp_path / "list.txt").write_bytes(text.encode())
    assert read_frame_list(tmp_path / "list.txt") == [Frame(DRIVE, 7)] * 4 + [Frame(DRIVE, 7, "image_03")]
    (tmp_path / "calib.txt").write_bytes("\ufeffP2:\t1 2\r\nT: 3\r\n".encode())
    assert {key: row.tolist() for key, row in read_calibration(tmp_path / "calib.txt").items()} == {"P2": [1, 2], "T": [3]}


@pytest.mark.parametrize("line", [DRIVE, f"{DRIVE[11:]} 7 l", f"{DRIVE} 7 x", f"2011_09_28{DRIVE[10:]} 7 l", f"{DRIVE} 7 l extra"])
def test_a_malformed_line_is_named_with_its_file_and_number(listed, line):
    with pytest.raises(InputError, match=r"list\.txt, line 2: "):
        read_frame_list(listed(f"{DRIVE} 0000000000 l\n{line}\n"))


def test_static_frames_and_test_scenes_name_drives_as_lists_do(listed):
    assert read_static_frames(listed("2011_09_26 2011_09_26_drive_0001_sync 0000000005\n")) == {(DRIVE, 5)}
    assert read_test_scenes(listed("2011_09_26_drive_0001\n2011_09_28_drive_0002\n")) == {DRIVE, "2011_09_28/2011_09_28_drive_0002_sync"}
    for reader in (read_static_frames, read_test_scenes):
        with pytest.raises(InputError, match=r"list\.txt, line 1: 'nonsense'"):
            reader(listed("nonsense\n"))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_grey_is_repeated_over_three_channels(tmp_path, suffix):
    cv2.imwrite(str(tmp_path / f"a{suffix}"), np.full((16, 24), 77, np.uint8))
    assert (found := read_image(tmp_path / f"a{suffix}")).shape == (16, 24, 3) and np.abs(found.astype(int) - 77).max() <= 1


@pytest.mark.parametrize("kind", ["JPEG", "progressive JPEG", "restarting JPEG", "PNG", "TIFF", "BMP", "GIF"])
def test_bytes_behind_an_image_do_no_harm_and_pixels_that_are_missing_are_noticed(tmp_path, kind):
    whole, thumbnail, path, picture = io.BytesIO(), io.BytesIO(), tmp_path / "photo", PIL.Image.fromarray(wall(90, 120))
    picture.resize((12, 9)).save(thumbnail, "JPEG")  # whose end is not the photo's
    words = {"exif": b"Exif\0\0" + thumbnail.getvalue()} if "JPEG" in kind else {}
    words |= {"p": {"progressive": True}, "r": {"restart_marker_blocks": 4}}.get(kind[0], {})
    picture.save(whole, kind.split()[-1], **words)
    path.write_bytes(data := whole.getvalue())
    expected, film = read_image(path), np.random.default_rng(0).bytes(5000) + b"\xff\xd9" + bytes(200)
    for behind in (b"SEFT" + bytes(63), bytes(4000), film):
        path.write_bytes(data + behind)
        assert np.array_equal(read_image(path), expected)
    unended = kind in ("JPEG", "restarting JPEG")  # webcams leave out the end marker
    for ended in (data[:-1], data[:-2], data[:-2] + bytes(300)) if unended else ():
        path.write_bytes(ended)
        assert np.array_equal(read_image(path), expected)
    half = data[: data.index(b"\xff\xd3", len(data) // 2) + 1 if kind[0] == "r" else len(data) // 2]  # in a restart marker
    gaps = [half + bytes(4000), half + bytes(7)] if "JPEG" in kind else []
    for missing in (half, data[: -20 if "JPEG" in kind else -2000], *gaps, *[half + film] * (kind[0] != "r")):
        path.write_bytes(missing)
        with pytest.raises(InputError, match="photo: "):
            read_image(path)


@pytest.mark.parametrize(("most", "bits"), [(200, 8), (1000, 10), (4000, 12), (9000, 14), (18000, 16), (65535, 16)])
def test_deep_images_of_a_folder_show_the_bits_that_it_holds_which_is_said_once(tmp_path, capsys, most, bits):
    deep = np.linspace(0, most, 60 * 80 * 3).reshape(60, 80, 3).astype(np.uint16)
    deep[0, 0] = 65535  # a hot pixel
    (hot := deep.copy())[30] = 65535  # of depth, whose values do not count
    pictures = {"a.png": deep // 5, "b.png": deep, "b.tif": deep, "b.depth.png": hot}
    for name, picture in pictures.items():
        cv2.imwrite(str(tmp_path / name), picture)
    for name, picture in pictures.items():
        assert np.array_equal(read_image(tmp_path / name), np.minimum(picture[..., ::-1] >> (bits - 8), 255))
    assert capsys.readouterr().err.count(f"{tmp_path}: holds 16-bit images with values of {bits} bits") == (bits < 16)


def test_a_narrow_range_far_from_zero_is_scaled_for_all_frames_of_a_folder_alike(tmp_path, capsys):
    for name, least in {"a.png": 28000, "b.PNG": 30000, "c.png": 0}.items():  # hundredths of a kelvin, and a closed shutter
        cv2.imwrite(str(tmp_path / name), np.linspace(least, least and least + 1000, 4800).reshape(60, 80).astype(np.uint16))
    cold, warm, none = (read_image(tmp_path / name).astype(int)[..., 0] for name in ("a.png", "b.PNG", "c.png"))
    assert [cold.min(), cold.max(), warm.min(), warm.max(), none.max()] == [0, 86, 173, 255, 0] and len(np.unique(cold)) == 87
    assert capsys.readouterr().err.count(f"{tmp_path}: holds 16-bit images with values from 28002 to 30946 alone") == 1


def test_signed_values_begin_at_zero_those_of_32_bits_are_refused_and_of_several_pictures_the_first_is_read(tmp_path, capfd):
    signed = np.linspace(-30000, 30000, 60 * 80).reshape(60, 80)
    cv2.imwrite(str(tmp_path / "a.tiff"), signed.astype(np.int16))
    assert np.array_equal(read_image(tmp_path / "a.tiff")[..., 1], signed.astype(np.int16).clip(0) >> 8)
    PIL.Image.fromarray(wall(90, 120)).save(tmp_path / "raw.tif", tiffinfo={254: 1})  # a raw photo's preview
    for kind in ("int32", "float32", "raw"):
        kind == "raw" or cv2.imwrite(str(tmp_path / f"{kind}.tif"), signed.astype(kind))
        with pytest.raises(InputError, match=rf"{kind}\.tif: .*({'raw photo' if kind == 'raw' else '32-bit'})"):
            read_image(tmp_path / f"{kind}.tif")
    pictures = [PIL.Image.fromarray(wall(90, 120, seed=k)) for k in range(3)]
    for name in ("a.webp", "a.png", "a.tif", "a.gif"):
        pictures[0].save(tmp_path / name, save_all=True, append_images=pictures[1:])
        assert np.abs(read_image(tmp_path / name).astype(float) - pictures[0]).mean() < 12
    assert ["has 3 frames" in line for line in capfd.readouterr().err.splitlines()] == [True] * 4


@pytest.mark.parametrize("kind", ["jpg", "png", "webp", "tif", "avif"])
def test_photos_are_turned_as_they_say(tmp_path, kind):
    picture = PIL.Image.fromarray(np.add.outer(np.arange(90), np.arange(120)).astype(np.uint8)).convert("RGB")
    picture.getexif()[0x112] = 6
    picture.save(tmp_path / f"a.{kind}", exif=picture.getexif())
    assert np.abs(read_image(tmp_path / f"a.{kind}").astype(float) - np.rot90(picture, -1)).mean() < 3


def test_intrinsics_are_those_of_the_cameras_rectified_projection(tmp_path):
    write_calibration(tmp_path)
    (path := tmp_path / "2011_09_26/calib_cam_to_cam.txt").write_text(path.read_text().replace("P_rect_03: 2.2", "P_rect_03: 3.3"))
    assert intrinsics(tmp_path, day := "2011_09_26").tolist() == [[220, 0, 104], [0, 220, 104], [0, 0, 1]]
    assert intrinsics(tmp_path, day, "image_03")[0, 0] == 330


def test_a_calibration_entry_keeps_its_numbers_and_rows_of_a_file_without_names_are_cameras(tmp_path):
    path = tmp_path / "calib.txt"
    path.write_text("4 5\nT: 1.5e-01 -2 3\n\n6 7\nR: a b\n")
    assert (values := read_calibration(path)).keys() == {"T"} and kitti.calibration_entry(values, "T", 3, path).tolist() == [0.15, -2, 3]
    path.write_text("\n4 5\n6 7\n")
    assert {key: row.tolist() for key, row in read_calibration(path).items()} == {"P0": [4, 5], "P1": [6, 7]}


def test_a_root_must_hold_date_folders(tmp_path):
    for root in (tmp_path / "nowhere", tmp_path):
        with pytest.raises(InputError, match=rf"KITTI_ROOT {root}: holds no 20\S+/calib_cam_to_cam\.txt; give"):
            kitti.check_root(root)
    write_calibration(tmp_path)
    assert kitti.check_root(str(tmp_path)) == tmp_path
