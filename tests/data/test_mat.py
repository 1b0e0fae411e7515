"""Arrays of MATLAB files, against what SciPy writes."""

import io

import numpy as np
import pytest
from dualdepth.data.mat import read_mat
from scipy.io import savemat


@pytest.fixture
def written(tmp_path):
    def write(compressed=False, **values):
        buffer = io.BytesIO()
        savemat(buffer, values, do_compression=compressed)
        path = tmp_path / "a.mat"
        path.write_bytes(buffer.getvalue())
        return path

    return write


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("kind", ["f8", "f4", "i4", "u1", "i2"])
def test_arrays_are_what_scipy_wrote(written, compressed, kind):
    values = np.random.default_rng(0).integers(0, 100, (3, 5, 4)).astype(kind)
    path = written(compressed, before={"a": "structure"}, wanted=values, x=np.eye(2), text="words")
    found = read_mat(path, "wanted")
    assert found.dtype == kind
    np.testing.assert_array_equal(found, values)
    np.testing.assert_array_equal(read_mat(path, "x"), np.eye(2))
    assert read_mat(path, "absent") is None


@pytest.mark.parametrize("name", ["before", "text"])
def test_what_is_no_array_of_numbers_is_refused(written, name):
    with pytest.raises(ValueError, match=f"{name} is no plain array"):
        read_mat(written(before={"a": 1}, text="words"), name)


@pytest.mark.parametrize("compressed", [False, True])
def test_an_unknown_type_of_numbers_and_a_truncated_file_are_refused(written, compressed):
    path = written(wanted=np.full((3, 5), 7.5))
    whole = path.read_bytes()
    at = whole.index(np.uint32(9).tobytes() + np.uint32(15 * 8).tobytes())
    for kind in (8, 10, 11, 21, 2**16 - 1):
        path.write_bytes(whole[:at] + np.uint32(kind).tobytes() + whole[at + 4 :])
        with pytest.raises(ValueError, match="no plain array"):
            read_mat(path, "wanted")
    whole = written(compressed, wanted=np.random.default_rng(0).random((30, 5))).read_bytes()
    for share in (0.3, 0.6, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ValueError, match=r"truncated|no header"):
            read_mat(path, "wanted")
