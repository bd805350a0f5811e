"""The page of the REST interface is what the routes say."""

import json
import re
from collections.abc import Iterator
from typing import Any

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


def numbers_of(described: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Answer, field and description of all numbers that viewers get."""
    schemas = described["components"]["schemas"]
    shown = [
        path["get"] for path in described["paths"].values() if path.get("get", {}).get("tags") in (["fleet"], ["maps"])
    ]
    answers = re.findall(r"schemas/(\w+)", json.dumps([operation["responses"]["200"] for operation in shown]))
    for name in sorted(set(answers)):
        for field, schema in schemas[name]["properties"].items():
            meaning = schema.get("description", "")
            if re.search(r'"type": "(number|integer)"', json.dumps(schema)) and not meaning.startswith("number of"):
                yield name, field, meaning


def test_every_number_that_viewers_get_has_a_unit():
    described = create_app(reference_pages.Described()).openapi()
    numbers = list(numbers_of(described))
    assert ("SessionSummary", "path_length_m") in {(answer, field) for answer, field, _ in numbers}
    unit = re.compile(r"\b(metres|radians|seconds|bytes|numbers?|version|units?|in \[0, 1\])")
    assert [number for number in numbers if not unit.search(number[2])] == []
