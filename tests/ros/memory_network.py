"""A ROS network in memory: what is published arrives at once, in the thread that publishes."""

from collections import defaultdict

from fcslam.ros.network import Endpoint, Quality
from fcslam.sources.bags.codec import MessageCodec


class MemoryNetwork:
    def __init__(self, others=()):
        """``others``: publishers and subscriptions of somebody else."""
        self.others = list(others)
        self.sent = defaultdict(list)
        self.subscribed = {}
        self._own = []
        self._subscribers = defaultdict(list)
        self._codec = MessageCodec(ros1=False)

    def endpoints(self):
        return [*self.others, *self._own]

    def subscribe(self, topic, kind, quality, deliver):
        self._own.append(Endpoint(topic, kind, False, quality, True))
        self.subscribed[topic] = quality
        self._subscribers[topic].append(deliver)

    def publisher(self, topic, kind, quality):
        self._own.append(Endpoint(topic, kind, True, quality, True))
        return lambda payload: self.sent[topic].append(self._codec.decode(payload, kind))

    def close(self):
        pass

    def say(self, topic, kind, message, publisher=""):
        """Publish as somebody else."""
        for deliver in self._subscribers[topic]:
            deliver(self._codec.encode(message, kind), publisher)


def offered(topic, kind, reliable=True, latched=False):
    """A publisher of somebody else."""
    return Endpoint(topic, kind, True, Quality(reliable, latched))
