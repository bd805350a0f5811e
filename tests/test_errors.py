"""Messages of errors."""

import pickle
from pathlib import Path

import pytest

from fcslam.errors import InputError, PacketConflictError, UnavailableError


@pytest.mark.parametrize(
    ("message", "readable"),
    [
        ("a.yaml: cannot be read ({})", "a.yaml: cannot be read (No such file or directory)"),
        ("cannot write ({})", "cannot write (No such file or directory: 'a.yaml')"),
    ],
)
def test_a_system_error_stands_without_number_and_without_a_second_file_name(message, readable):
    with pytest.raises(FileNotFoundError) as caught:
        Path("a.yaml").read_text()
    assert str(InputError(message.format(caught.value))) == readable


@pytest.mark.parametrize(
    "error", [UnavailableError("http://cloud:8340: [Errno 111] Connection refused", 3.0), PacketConflictError("two", 7)]
)
def test_an_error_crosses_processes_with_all_that_it_says(error):
    copy = pickle.loads(pickle.dumps(error))
    assert (type(copy), str(copy), vars(copy)) == (type(error), str(error), vars(error))
