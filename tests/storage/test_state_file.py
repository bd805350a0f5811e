"""A state survives its file to the last bit, and a file that is not what was written is refused."""

import numpy as np
import pytest

from fcslam.errors import InputError
from fcslam.storage.state_file import read_state, write_state

STATE = {
    "numbers": [1, 2.5, None, True, "text", -float("inf")],
    "array": {"array": 3, "poses": np.arange(6.0).reshape(2, 3), "empty": np.zeros((0, 3), np.float32)},
    "bits": np.arange(64, dtype=np.uint64),
}


@pytest.fixture
def file(tmp_path):
    write_state(tmp_path / "state", "version 1", STATE)
    return tmp_path / "state"


def test_what_was_written_is_read(file):
    found = read_state(file, "version 1")
    assert found["numbers"] == STATE["numbers"]
    assert found["array"]["array"] == 3
    for kept, array in (
        (found["bits"], STATE["bits"]),
        (found["array"]["poses"], STATE["array"]["poses"]),
        (found["array"]["empty"], STATE["array"]["empty"]),
    ):
        assert (kept.dtype, kept.shape, kept.tobytes()) == (array.dtype, array.shape, array.tobytes())


def test_without_a_file_there_is_no_state(tmp_path):
    assert read_state(tmp_path / "state", "version 1") is None


def test_a_state_of_another_version_does_not_fit(file):
    with pytest.raises(InputError, match="another version"):
        read_state(file, "version 2")


def test_every_damaged_byte_is_found(file):
    data = bytearray(file.read_bytes())
    for position in np.random.default_rng(5).integers(0, len(data), 60):
        damaged = data.copy()
        damaged[position] ^= 1
        file.write_bytes(damaged)
        with pytest.raises(InputError, match="damaged"):
            read_state(file, "version 1")
    for length in (0, 5, 40, len(data) - 1):
        file.write_bytes(data[:length])
        with pytest.raises(InputError, match="damaged"):
            read_state(file, "version 1")


def test_objects_are_never_written(tmp_path):
    with pytest.raises(ValueError, match="allow_pickle"):
        write_state(tmp_path / "state", "version 1", {"objects": np.array([object()])})
    assert not (tmp_path / "state").exists()
