"""The page of the REST interface is what the routes say."""

import re

from fcslam.service.http.app import create_app
from tools import reference_pages

PAGE = reference_pages.FOLDER / "rest.md"


def test_the_page_is_up_to_date():
    assert PAGE.read_text(encoding="utf-8") == reference_pages.rest_page(), "run: make docs"


def test_every_request_names_the_roles_that_may_send_it():
    page = reference_pages.rest_page()
    assert "| `GET /healthz` | anybody |" in page
    assert "| `POST /api/v1/robots/{robot}/packets` | robot |" in page
    assert "| `GET /api/v1/detectors/{channel}/{version}` | robot, viewer, admin |" in page
    assert "| `POST /api/v1/finalize` | admin |" in page


def test_every_number_that_viewers_get_has_a_unit():
    described = create_app(reference_pages.Described()).openapi()
    numbers = list(reference_pages.numbers_of(described))
    assert ("SessionSummary", "path_length_m") in {(answer, field) for answer, field, _ in numbers}
    unit = re.compile(r"\b(metres|radians|seconds|bytes|numbers?|version|units?|in \[0, 1\])")
    assert [number for number in numbers if not unit.search(number[2])] == []
