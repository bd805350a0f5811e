"""A cloud that keeps to the contract of docs/reference/wire.md, in memory, and the faults of a network before it."""

from dataclasses import dataclass, field, replace

from fcslam.errors import CloudError, OversizeError, UnavailableError
from fcslam.records import DetectorFile
from fcslam.wire.http_transport import CloudState, HttpResponse
from fcslam.wire.messages import Acknowledgement, DetectorUpdate
from fcslam.wire.packets import decode, encode, readdress
from tests.wire.examples import CLOSURE, CORRECTION, HELLO, packet


def said(ordinal, body=CLOSURE, time=1042.5):
    """Output of a front end, which knows no epoch."""
    body = replace(body, epoch=0) if body is HELLO else body
    return replace(packet(body), epoch=0, sequence=ordinal, time=time)


@dataclass
class FakeCloud:
    """Stores packets by epoch and sequence."""

    stored: dict[tuple[int, int], bytes] = field(default_factory=dict)
    correction: int = -1
    unwanted: set[bytes] = field(default_factory=set)
    """Contents of packets that it will never take."""
    refused: dict[tuple[int, int], str] = field(default_factory=dict)
    """Their numbers, which are used up, and why."""
    most: int = 1024
    """Packets that it takes at once."""

    detector_updates: dict[DetectorFile, bytes] = field(default_factory=dict)
    """Detectors that it announces all the time, and their contents; one without cannot be had."""
    removed: bool = False
    """Whether the session is removed."""
    has_ended: bool = False
    """Whether the robot said that it ends."""
    fetched: list[str] = field(default_factory=list)

    def detector(self, channel, version):
        self.fetched.append(version)
        content = {(file.channel, file.version): content for file, content in self.detector_updates.items()}[
            channel, version
        ]
        if content is None:
            raise CloudError("there is none")
        return content

    def end(self):
        self.has_ended = True

    def state(self):
        epochs = {epoch for epoch, _ in (*self.stored, *self.refused)}
        return CloudState({epoch: self.next(epoch) for epoch in epochs}, dict(self.refused), len(self.refused))

    def next(self, epoch):
        sequence = 0
        while (epoch, sequence) in self.stored or (epoch, sequence) in self.refused:
            sequence += 1
        return sequence

    def send(self, packets, correction):
        if len(packets) > self.most:
            raise OversizeError("too much")
        for index, data in enumerate(packets):
            sent = decode(data)
            key = sent.epoch, sent.sequence
            if content(data) in self.unwanted:
                self.refused[key] = "unwanted"
                return HttpResponse(refusal=(index, "unwanted"))
            assert self.stored.setdefault(key, data) == data, "two packets of one number"
        epoch = decode(packets[0]).epoch if packets else max((e for e, _ in self.stored), default=0)
        answer = []
        if self.next(epoch):
            acknowledgement = Acknowledgement("alice", epoch, self.next(epoch) - 1)
            answer.append(encode(replace(packet(acknowledgement), epoch=epoch)))
        if self.stored:  # nobody knows what detectors a robot has that never said hello
            answer += [encode(packet(DetectorUpdate("alice", file))) for file in self.detector_updates]
        if self.correction > correction:
            answer.append(encode(replace(packet(replace(CORRECTION, version=self.correction)), epoch=epoch)))
        return HttpResponse(tuple(answer), refused=len(self.refused), removed=self.removed)


class Network:
    """Between a robot and its cloud: each request meets the next fault of ``faults``; then all is well."""

    FAULTS = ("none", "request lost", "answer lost", "cut", "twice", "busy", "noise")

    def __init__(self, cloud, faults=()):
        self.cloud = cloud
        self.faults = list(faults)
        self.requests = 0

    def state(self):
        if self._next() in ("none", "twice"):
            return self.cloud.state()
        raise UnavailableError("no answer")

    def send(self, packets, correction):
        fault = self._next()
        match fault:
            case "busy":
                raise UnavailableError("busy", 2.0)
            case "cut":  # the cloud stored some of them and was killed
                self.cloud.send(packets[: len(packets) // 2], correction)
            case "answer lost" | "twice" | "noise":
                self.cloud.send(packets, correction)
        if fault == "noise":
            return HttpResponse((b"noise",))
        if fault in ("none", "twice"):
            return self.cloud.send(packets, correction)
        raise UnavailableError("no answer")

    def end(self):
        self.cloud.end()

    def detector(self, channel, version):
        return self.cloud.detector(channel, version)

    def _next(self):
        self.requests += 1
        return self.faults.pop(0) if self.faults else "none"


def content(data):
    """A packet without what the outbox put on its envelope."""
    return readdress(data, 0, 0)
