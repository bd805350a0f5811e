"""How commands refuse what they cannot do."""

import pytest

from fcslam.cli import BAD_INPUT, main


@pytest.fixture
def refused(capsys, tmp_path):
    """Runs a command that is refused; returns the one line that it says. It leaves nothing half-written."""

    def refused(*words):
        capsys.readouterr()
        assert main([*map(str, words)]) == BAD_INPUT, words
        error = capsys.readouterr().err
        assert error.startswith("fcslam: ")
        assert error.count("\n") == 1
        assert "Traceback" not in error
        assert "\x1b" not in error
        assert not [path for path in tmp_path.rglob("*") if "partial" in path.name or "retired" in path.name]
        return error

    return refused
