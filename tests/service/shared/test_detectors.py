"""A detector that one instance announces is announced by all."""

import threading

from fcslam.features.detector import BUNDLED_NETWORK
from fcslam.service.shared.files import SharedDetectors
from fcslam.service.shared.instance import Hooks, Instance


def test_other_instances_announce_a_detector_and_have_its_file(postgres, tmp_path):
    one, other = (SharedDetectors(tmp_path / name, postgres) for name in ("one", "other"))
    file = one.announce(BUNDLED_NETWORK.read_bytes())
    assert file.channel not in other.announced()
    other.follow()
    assert other.announced() == {file.channel: file}
    assert other.path(file.channel, file.version).read_bytes() == BUNDLED_NETWORK.read_bytes()


def test_an_instance_follows_the_store_at_each_step(registry, tmp_path):
    followed = threading.Semaphore(0)
    nothing = lambda *_: None  # noqa: E731
    instance = Instance(registry, "one", 0, Hooks(nothing, nothing, nothing, followed.release))
    instance.start()
    try:
        assert all(followed.acquire(timeout=120.0) for _ in range(2))
    finally:
        instance.close()
