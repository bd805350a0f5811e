"""Which robot is behind which of Flower's nodes: their numbers are drawn anew whenever a robot joins, names stay."""

from collections.abc import Iterable, Sequence

import numpy as np

from fcslam.federated.flower import Grid, Message, MessageType, RecordDict
from fcslam.federated.messages import reply_sender


class RobotRegistry:
    """Asks every node once for its name."""

    def __init__(self, grid: Grid, deadline_s: float) -> None:
        self._grid, self._deadline_s = grid, deadline_s
        self._names: dict[int, str] = {}
        self.duplicates: tuple[str, ...] = ()
        """Names that more than one of those present had when last looked."""

    def present(self) -> dict[str, int]:
        """Nodes by the names of the robots that are there now, in the names' order; of two with one name, the first."""
        nodes = sorted(self._grid.get_node_ids())
        self._meet([node for node in nodes if node not in self._names])
        found: dict[str, int] = {}
        duplicates: dict[str, int] = {}
        for name, node in sorted((self._names[node], node) for node in nodes if node in self._names):
            (duplicates if name in found else found)[name] = node
        self.duplicates = tuple(duplicates)
        return found

    def _meet(self, nodes: Sequence[int]) -> None:
        if not nodes:
            return
        questions = [Message(RecordDict({}), node, MessageType.QUERY) for node in nodes]
        for reply in self._grid.send_and_receive(questions, timeout=self._deadline_s):
            if reply.has_error():
                continue
            try:
                self._names[reply.metadata.src_node_id], _ = reply_sender(reply.content)
            except ValueError:
                continue


def sample_robots(names: Iterable[str], share: float, fewest: int, rng: np.random.Generator) -> list[str]:
    """Some of the robots, in the order of their names: a share of them, and no fewer than ``fewest`` if there are."""
    everyone = sorted(names)
    count = min(max(int(np.ceil(share * len(everyone))), fewest), len(everyone))
    return [everyone[index] for index in sorted(rng.choice(len(everyone), count, replace=False))]
