"""Messages of errors."""

import pickle
from pathlib import Path

import pytest

from fcslam.errors import ConfigError, UnavailableError


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
    assert str(ConfigError(message.format(caught.value))) == readable


def test_an_error_crosses_processes():
    error = UnavailableError("http://cloud:8340: [Errno 111] Connection refused")
    assert str(pickle.loads(pickle.dumps(error))) == str(error) == "http://cloud:8340: Connection refused"
