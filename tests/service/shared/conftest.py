"""A server without missions of other tests."""

import pytest

from fcslam.service.shared.registry import Registry


@pytest.fixture
def registry(postgres) -> Registry:
    """The registry as the instance one sees it."""
    postgres.rows("DELETE FROM missions RETURNING 1")
    postgres.rows("DELETE FROM instances RETURNING 1")
    return Registry(postgres, "one", "process of one", lease_s=3600.0)
