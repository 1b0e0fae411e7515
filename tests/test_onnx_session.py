"""Loading an exported network: its shapes are checked, and images it cannot see are refused with what it wants instead."""

import numpy as np
import pytest
from dualdepth.onnx_session import load_onnx
from onnx import TensorProto
from small_onnx import HEIGHT, WIDTH, write

from dualdepth.errors import InputError


@pytest.fixture
def path(tmp_path):
    return tmp_path / "depth.onnx"


@pytest.fixture
def images():
    return np.random.default_rng(0).uniform(0, 1, (2, 3, HEIGHT, WIDTH)).astype(np.float32)


@pytest.mark.parametrize("pool", [1, 3])
def test_images_of_the_right_shape_give_disparities(path, images, pool):
    loaded = load_onnx(write(path, pool=pool), threads=1)
    assert (loaded.size, loaded.output_size) == ((6, 9), (6 // pool, 9 // pool))
    for batch in (1, 2):
        expected = 1 + images[:batch].reshape(batch, 3, 6 // pool, pool, 9 // pool, pool).mean((1, 3, 5))
        np.testing.assert_allclose(loaded(images[:batch])[:, 0], expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda x: x[0], r"takes images \(B, 3, 6, 9\), found \(3, 6, 9\); resize"),
        (lambda x: x[:0], r"found \(0, 3, 6, 9\)"),
        (lambda x: x.transpose(0, 2, 3, 1), r"found \(2, 6, 9, 3\)"),
        (lambda x: x[..., :8], r"found \(2, 3, 6, 8\)"),
        (lambda x: (255 * x).astype(np.uint8), "takes float32 images in .0, 1., found uint8"),
        (lambda x: x.astype(np.float64), "found float64"),
        (lambda x: 255 * x, "found values from .* to 2[0-9]{2}; divide bytes by 255"),
        (lambda x: x - 1, "found values from -"),
        (lambda x: x * np.float32("nan"), "found values from nan"),
    ],
)
def test_other_images_are_refused(path, images, change, said):
    with pytest.raises(InputError, match=said):
        load_onnx(write(path))(change(images))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"image": ("batch", 3, 6, 12)}, r"has \[\('image', 'tensor\(float\)', 'batch', 3, 6, 12\)\] where image \(B, 3, 6, 9\)"),
        ({"image": (1, 3, 6, 9)}, "where image"),
        ({"image": ("batch", 3, "height", "width")}, "where image"),
        ({"image": ("batch", 4, 6, 9)}, "where image"),
        ({"names": ("x", "disparity")}, "where image"),
        ({"names": ("image", "y")}, r"where disparity \(B, 1, 6, 9\)"),
        ({"kind": TensorProto.DOUBLE}, r"tensor\(double\)"),
        ({"pool": 3, "metadata": {"hr_size": "[6, 9]", "card": '{"network": "dual"}'}}, "where disparity"),
        ({"metadata": {}}, r"its metadata name no network of this project \('card'\); export it"),
        ({"metadata": {"hr_size": "[6, 9]", "card": "[]"}}, "its metadata name no network"),
        ({"metadata": {"hr_size": "[6, 9]", "card": "{"}}, "its metadata name no network"),
        ({"metadata": {"hr_size": "[6]", "card": '{"network": "dual"}'}}, "its metadata name no network"),
        ({"metadata": {"hr_size": "[null, 1e999]", "card": '{"network": "dual"}'}}, "its metadata name no network"),
        ({"metadata": {"hr_size": "[6, 12]", "card": '{"network": "dual"}'}}, "where image"),
    ],
    ids=str,
)
def test_a_graph_that_is_not_what_its_metadata_say_is_refused_at_load(path, changes, said):
    with pytest.raises(InputError, match=said):
        load_onnx(write(path, **changes))


def test_missing_and_damaged_files_are_refused(path, capfd):
    with pytest.raises(InputError, match=r"depth\.onnx: cannot be loaded by ONNX Runtime"):
        load_onnx(path)
    whole = write(path).read_bytes()
    for damaged in (b"", b"text", whole[: len(whole) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"depth\.onnx: "):
            load_onnx(path)
    assert capfd.readouterr().err == ""
