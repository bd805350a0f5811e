"""Maps Flower's nodes to robots."""

from collections.abc import Iterable, Sequence

import numpy as np

from fcslam.learning.federated.flower import Message, MessageType, RecordDict, RobotGrid
from fcslam.learning.federated.messages import reply_sender


class RobotRegistry:
    """The robots that are connected, by name; a node whose name the grid does not know is asked for it once."""

    def __init__(self, grid: RobotGrid, deadline_s: float) -> None:
        self._grid, self._deadline_s = grid, deadline_s
        self._names: dict[int, str] = {}
        self.duplicates: tuple[str, ...] = ()
        """Names that more than one node had at the last call of ``connected``."""

    def connected(self) -> dict[str, int]:
        """Node numbers of the connected robots by name, sorted by name; of two with one name, the lower number."""
        nodes = sorted(self._grid.get_node_ids())
        self._names |= self._grid.robot_names()
        self._identify([node for node in nodes if node not in self._names])
        found: dict[str, int] = {}
        duplicates: dict[str, int] = {}
        for name, node in sorted((self._names[node], node) for node in nodes if node in self._names):
            (duplicates if name in found else found)[name] = node
        self.duplicates = tuple(duplicates)
        return found

    def _identify(self, nodes: Sequence[int]) -> None:
        if not nodes:
            return
        queries = [Message(RecordDict({}), node, MessageType.QUERY) for node in nodes]
        for reply in self._grid.send_and_receive(queries, timeout=self._deadline_s):
            if reply.has_error():
                continue
            try:
                self._names[reply.metadata.src_node_id], _ = reply_sender(reply.content)
            except ValueError:
                continue


def sample_robots(names: Iterable[str], fraction: float, minimum: int, rng: np.random.Generator) -> list[str]:
    """Draw robots for a round.

    Args:
        names: of the connected robots.
        fraction: share of them to draw, in (0, 1].
        minimum: number of robots to draw at least, if enough are connected.
        rng: source of randomness.

    Returns:
        Names in alphabetical order.
    """
    everyone = sorted(names)
    count = min(max(int(np.ceil(fraction * len(everyone))), minimum), len(everyone))
    return [everyone[index] for index in sorted(rng.choice(len(everyone), count, replace=False))]
