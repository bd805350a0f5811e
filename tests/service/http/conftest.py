import pytest

from tests.service.http.desk import Desk


@pytest.fixture
def desk(tmp_path, scripted):
    """A service over scripted robots a and b, with a token for each role."""
    from tests.service.http.desk import SCRIPT

    scripted(SCRIPT)
    with Desk(tmp_path / "data") as desk:
        yield desk
