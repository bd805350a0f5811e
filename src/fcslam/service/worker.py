"""The worker: the process in which the fleet of one mission lives. The service accepts packets without waiting for it.

It reads the store by turn and keeps the fleet in memory. It writes its results to disk: corrections in the store, the
live run folder, and the run folders that users request. From time to time it also writes its state. If it is killed,
the next worker continues from that state, or from turn 0, and reports nothing new before it has caught up.

It compiles its code, then waits for a line with its task (``WorkerTask``). A byte on stdin means that there is work;
the end of stdin means that the service is gone. The worker prints a line when it is ready, for its progress, for
every change of the live run folder and for every answered request.
"""

import fcntl
import gc
import json
import logging
import math
import os
import select
import signal
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from hashlib import blake2b
from importlib import import_module
from pathlib import Path
from typing import IO, Any

import cv2

from fcslam.cloud.host import FleetHost
from fcslam.cloud.packet_log import PacketNumber
from fcslam.cloud.replies import SessionCorrection
from fcslam.cloud.report import TURNS, keyscan_track, run_of, traffic_metrics
from fcslam.cloud.result import FleetResult
from fcslam.cloud.sessions import robot_and_epoch, session_name
from fcslam.cloud.settings import CloudConfig, FusionStrategy
from fcslam.cluster.verifying import verifying
from fcslam.config import dump
from fcslam.errors import InputError, PacketError, StoreError
from fcslam.lidar.pair_verification import VerifyPairs, verify_here
from fcslam.mission.mission_store import CONFIG, Envelope, Finalization, MissionStore, Refusal, StoredPacket
from fcslam.processes import NICENESS, Background, Start, emit_event, start_copy, trim_memory
from fcslam.runs import QUALITY, Metric, Run
from fcslam.service.joint_maps import joint_maps_of, write_joint_maps
from fcslam.service.mission_folder import MissionFolder, keep_newest
from fcslam.service.shared.files import JOINT, LIVE, RESULT, SNAPSHOT, fetch_snapshot, put_file
from fcslam.service.shared.mission_tables import Lease, LeaseLostError, MissionTables
from fcslam.service.supervisor import PROGRESS, READY, WorkerTask
from fcslam.storage.postgres import Postgres
from fcslam.storage.state_file import code_version, read_state, write_state
from fcslam.warmup import warm_up_fleet
from fcslam.wire.ledger import Ledger
from fcslam.wire.messages import Packet
from fcslam.wire.packets import decode

AT_ONCE = 64
AT_ONCE_S = 0.25
"""Packets of each robot, and about the time, between two looks at what else there is to do. So no robot's packets, and
none of its corrections, wait for the queue of another one."""
REPORT_EVERY_S = 0.1
"""Corrections are not stored more often than this: packets that come in wait until they are on the disk."""
PAUSE_S = 30.0
"""After something could not be written."""
SNAPSHOT_EVERY_S = 5.0
"""The snapshot is not written more often than this."""
QUALITY_EVERY_S = 30.0
"""The certificate of the live run is not computed more often than this, unless maps join or part."""
WRITE_EVERY_S = 0.5
"""Least time between two drawings of a map."""
LONGEST_WAIT_S = 5.0
"""Longest time between two drawings of a map that lacks something, whatever they cost."""
LONGEST_COPY_S = 1800.0
"""A copy of the worker that writes for longer is ended."""
MOST_CRASHES = 3
"""Consecutive workers that may end at one task; the next worker leaves the task out."""

LATE = "fcslam.lidar.uniqueness", "fcslam.maps.certificate"
"""Modules with SciPy, which a robot loads late or never; no packet and no copy of the worker should wait for them."""

_log = logging.getLogger(__name__)

EmitEvent = Callable[[str, Any], None]
"""Receives each event with its content."""

Share = Callable[[str, Path], None]
"""Receives the name and the place of each file or run folder that the worker wrote, for other instances."""


class Worker:
    """One mission's fleet; ``step`` by ``step`` it follows what the store holds."""

    def __init__(
        self,
        folder: MissionFolder,
        store: MissionStore,
        clock: Callable[[], float],
        emit_event: EmitEvent,
        start: Start,
        verify_pairs: VerifyPairs = verify_here,
        share: Share = lambda *_: None,
        make_host: Callable[[CloudConfig, Callable[[PacketNumber], Packet], VerifyPairs], FleetHost] = FleetHost,
    ) -> None:
        config, now = store.fact(CONFIG), clock()
        self._config = CloudConfig() if config is None else CloudConfig.model_validate_json(config)
        self._folder, self._store, self._clock, self._emit_event = folder, store, clock, emit_event
        self._start, self._share = start, share
        self._crashes = CrashLog(folder.worker_task)
        self._queues: dict[str, deque[tuple[int, tuple[str, int, int], StoredPacket | None]]] = {}
        """By robot, its packets that may take effect: how many could before, its number, and the packet or None."""
        self._ready: deque[StoredPacket] = deque()
        """Packets that take effect next; they are in no queue."""
        self._waiting = 0
        """How many packets may take effect and did not yet."""
        self._refusals: list[Refusal] = []
        """Packets that were refused and are not yet stored as such."""
        self._host = make_host(self._config, self._read, verify_pairs)
        self._arrivals = 0
        """How many packets were read."""
        self._read_hash = b""
        """Hash of all packets that were read, in their order."""
        self._resumed_at = store.applied()
        """How many packets took effect before a restart: their results are stored already."""
        self._times: dict[tuple[str, int], float] = {}
        """Newest time of each session."""
        joint = "the joint maps", JOINT, folder.joint_maps
        self._joint_maps = _Output(
            *joint, busy_share=0.5, niceness=NICENESS, writer=self._joint_maps_writer, ended_s=now
        )
        live = "the live map", LIVE, folder.live
        # With less right to the processor, it would come minutes late on a busy machine.
        self._live = _Output(*live, busy_share=0.1, niceness=0, writer=self._live_writer, ended_s=now)
        self._outputs = self._joint_maps, self._live
        self._certified: dict[str, int] = {}
        """The map of each session as the certificate of the live run folder was computed."""
        self._certified_packets, self._certify_at = -1, now
        """How many packets that certificate is of, and when it is due again."""
        self._heard: dict[tuple[str, int], float] = {}
        """When the newest packet of each session took effect, seconds since 1970."""
        self._concluded: tuple[tuple[int, int], FleetResult] | None = None
        """The last result, and how many packets and edits it is of."""
        self._resume()
        self._reported, self._report_at = self._resumed_at, -math.inf
        self._finalize_at = -math.inf
        self._written, self._write_at = self._applied, now + SNAPSHOT_EVERY_S
        emit_event(PROGRESS, self._applied)

    def step(self) -> bool:
        """Do one piece of work; False if nothing is left to do."""
        return (
            self._take_edits()
            or self._write_snapshot()
            or any(self._write(output, is_busy=True) for output in self._outputs)
            or self._take_packets()
            or self._report()
            or self._finalize()
            or any(self._write(output) for output in self._outputs)
        )

    def wait_s(self) -> float:
        """How long there is nothing to do unless something comes in."""
        now, waits_s = self._clock(), [1.0]
        for output in self._outputs:
            if output.copy is not None:
                waits_s.append(0.05)
            elif output.shown < self._applied:
                waits_s.append(output.due_s() - now)
        if self._reported < self._applied:
            waits_s.append(self._report_at - now)
        return max(min(waits_s), 0.0)

    def _take_edits(self) -> bool:
        edits = self._store.edits(self._newest_edit)
        if not edits:
            return False
        applied = self._applied
        if self._host.follow(edits):  # as a worker without a snapshot does: all packets are applied again
            self._resumed_at = max(self._resumed_at, applied)
            self._written = 0
            self._ready.clear()
            self._queues.clear()
            self._waiting = 0
            self._arrivals, self._read_hash = 0, b""
            self._times.clear()
            self._emit_event(PROGRESS, 0)
        self._joint_maps.shown = self._live.shown = -1
        self._live.ended_s = -math.inf  # who edits the map waits for it
        self._certified_packets = -1
        self._reported = min(self._reported, max(self._applied, self._resumed_at) - 1)
        return True

    @property
    def _newest_edit(self) -> int:
        return self._host.edits[-1].number if self._host.edits else 0

    @property
    def _applied(self) -> int:
        """How many packets took effect or were refused."""
        return self._host.log.released - self._waiting

    def _take_packets(self) -> bool:
        """Apply packets for about ``AT_ONCE_S``; False if no packet waits."""
        began = self._clock()
        applied, arrivals = self._applied, self._arrivals
        while self._read_arrivals() and self._clock() <= began + AT_ONCE_S:
            pass
        if not self._ready:
            self._begin_round()
        while self._ready:
            self._waiting -= 1
            self._apply(self._ready.popleft())
            if self._clock() > began + AT_ONCE_S:
                break
        self._crashes.end()
        self._report()
        if self._applied > applied:
            self._emit_event(PROGRESS, self._applied)
        return self._arrivals > arrivals or self._applied > applied

    def _report(self) -> bool:
        """Store how many packets took effect, and new corrections, if the last time is long enough ago."""
        now = self._clock()
        if self._reported >= self._applied or now < self._report_at:
            return False
        try:
            waiting = Counter(packet.robot for packet in self._ready)
            waiting.update({robot: len(queue) for robot, queue in self._queues.items()})
            self._store.progress(self._applied, self._corrections(), waiting, self._refusals)
        except StoreError as error:  # a new worker would have to build the fleet in memory again
            _log.error("corrections are stored later: %s", error)
            self._report_at = now + PAUSE_S
            return False
        self._refusals.clear()
        self._reported, self._report_at = self._applied, now + REPORT_EVERY_S
        return True

    def _read_arrivals(self) -> bool:
        """Read some packets that arrived, and queue those that may take effect now; False if there are none."""
        read = self._store.arrivals(self._arrivals, AT_ONCE)
        arrived = {(packet.robot, packet.epoch, packet.sequence): packet for _, packet in read}
        for self._arrivals, packet in read:
            self._read_hash = _chained(self._read_hash, packet.data)
            number = _number(packet)
            if packet.refusal is None:
                self._host.log.add(number, packet.time)
            else:
                self._host.log.refuse(number)
            for _, sequence in self._host.log.ready(number.session):
                key, queue = (packet.robot, packet.epoch, sequence), self._queues.setdefault(packet.robot, deque())
                kept = arrived.get(key) if len(queue) < AT_ONCE else None
                queue.append((self._host.log.released, key, kept))
                self._waiting += 1
        return bool(read)

    def _begin_round(self) -> None:
        """Choose what takes effect next: some packets of each robot, in the order in which they could."""
        queues = list(self._queues.values())
        chosen = sorted(queue.popleft() for queue in queues for _ in range(min(len(queue), AT_ONCE)))
        if any(queue and queue[0][0] < chosen[-1][0] for queue in queues):
            self._host.log.is_canonical = False
        read = self._store.packets([key for _, key, packet in chosen if packet is None])
        self._ready.extend(packet or read[key] for _, key, packet in chosen)
        self._queues = {robot: queue for robot, queue in self._queues.items() if queue}

    def _store_refusals(self) -> None:
        if self._refusals:
            self._store.refuse(self._refusals)
            self._refusals.clear()

    def _write_snapshot(self) -> bool:
        """Write the worker's state, if it is new, no packet waits and the last time is long enough ago."""
        began = self._clock()
        if self._ready or self._written == self._applied or began < self._write_at:
            return False
        state = {
            "host": self._host.state(),
            "arrivals": self._arrivals,
            "waiting": [key for _, key, _ in sorted(one for queue in self._queues.values() for one in queue)],
            "edits": self._newest_edit,
            "hash": self._read_hash.hex(),
            "times": [(*session, time_s) for session, time_s in self._times.items()],
            "heard": [(*session, time_s) for session, time_s in self._heard.items()],
        }
        try:
            self._store_refusals()
            write_state(self._folder.snapshot, self._fits(), state)
            self._share(SNAPSHOT, self._folder.snapshot)
        except (OSError, StoreError) as error:  # a restart takes longer then, and no more
            _log.error("no snapshot of the worker was written: %s", error)
        trim_memory()  # gaps would grow for days
        self._written = self._applied
        self._write_at = self._clock() + max(20.0 * (self._clock() - began), SNAPSHOT_EVERY_S)  # 5 % of the time
        return True

    def _resume(self) -> None:
        """Go on from the snapshot if there is one that fits this program, configuration and mission."""
        try:
            state = read_state(self._folder.snapshot, self._fits())
            if state is None:
                return
            read_hash = b""
            for data in self._store.contents(state["arrivals"]):
                read_hash = _chained(read_hash, data)
            edits = [edit for edit in self._store.edits() if edit.number <= state["edits"]]
            if read_hash.hex() != state["hash"] or state["edits"] > (edits[-1].number if edits else 0):
                raise InputError(f"{self._folder.snapshot}: belongs to other packets")
            self._host.restore(state["host"], edits)
        except Exception as error:  # a mission must never depend on its snapshot
            _log.warning("%s; the worker applies all packets again", str(error) or type(error).__name__)
            return
        self._arrivals, self._read_hash, self._waiting = state["arrivals"], read_hash, len(state["waiting"])
        for turn, (robot, epoch, sequence) in enumerate(state["waiting"], self._applied):
            self._queues.setdefault(robot, deque()).append((turn, (robot, epoch, sequence), None))
        self._times = {(robot, epoch): time_s for robot, epoch, time_s in state["times"]}
        self._heard = {(robot, epoch): time_s for robot, epoch, time_s in state["heard"]}

    def _fits(self) -> str:
        return f"{code_version()} {self._config.model_dump_json()}"

    def _apply(self, packet: StoredPacket) -> None:
        """One packet takes effect, or is refused and from now on counts as refused."""
        if packet.refusal is not None:  # by a worker before, since it arrived
            self._host.log.refuse(_number(packet))
            return
        task = f"packet {packet.sequence} of {session_name(packet.robot, packet.epoch)}"
        if self._crashes.is_fatal(task):
            self._refuse(packet, f"{MOST_CRASHES} workers in a row ended while they applied it")
            return
        self._crashes.begin(task)
        try:
            self._host.apply_next(_number(packet), decode(packet.data))
        except PacketError as error:
            self._refuse(packet, str(error))
        except MemoryError:
            raise  # most often the machine's fault, not the packet's: the next workers try again
        except Exception as error:
            # Its state is unknown then: the next worker starts again without it.
            self._refuse(packet, f"the cloud failed on it: {type(error).__name__}: {error}")
            self._store_refusals()
            raise
        else:
            self._times[packet.robot, packet.epoch] = packet.time
            if self._applied > self._resumed_at:  # else it took effect before, at a time that only a snapshot knows
                self._heard[packet.robot, packet.epoch] = time.time()

    def _refuse(self, packet: StoredPacket, reason: str) -> None:
        self._refusals.append((packet.robot, packet.epoch, packet.sequence, reason))
        self._host.log.refuse(_number(packet))

    def _corrections(self) -> list[SessionCorrection]:
        by_session = {correction.robot: correction for correction in self._host.fleet.corrections()}
        return [
            SessionCorrection(robot, epoch, time_s, by_session[name])
            for (robot, epoch), time_s in self._times.items()
            if (name := session_name(robot, epoch)) in by_session
        ]

    def _finalize(self) -> bool:
        """Answer the oldest request whose packets and edits have all taken effect."""
        if self._clock() < self._finalize_at:
            return False
        for asked in self._store.finalizations():
            if asked.run or asked.failure or asked.arrivals > self._arrivals or asked.edits > self._newest_edit:
                continue
            try:
                self._answer(asked)
            except StoreError as error:  # the disk may be freed
                _log.error("the request for result %d stays: %s", asked.number, error)
                self._finalize_at = self._clock() + PAUSE_S
            return True
        return False

    def _answer(self, asked: Finalization) -> None:
        name = str(asked.number)
        task = f"result {name}"
        if self._crashes.is_fatal(task):
            self._store.answer(asked.number, None, f"{MOST_CRASHES} workers in a row ended while they computed it")
            return
        self._crashes.begin(task)
        self._store_refusals()
        try:
            result = self._result()
            self._run(result, self._store.traffic()).save(self._folder.run(name), force=True)
            self._concluded = (self._applied, self._newest_edit), result
            self._share(RESULT + name, self._folder.run(name))
        except Exception as error:  # asked for again, it would fail at the next worker too, and nothing else go on
            _log.exception("result %s failed", name)
            self._store.answer(asked.number, None, str(error) or type(error).__name__)
        else:
            self._store.answer(asked.number, name)
            keep_newest(self._folder.run(name).parent)
        self._crashes.end()
        self._joint_maps.shown = self._live.shown = -1
        self._emit_event("finalized", asked.number)

    def _result(self) -> FleetResult:
        envelopes = self._store.envelopes(self._arrivals)
        return self._host.conclude((one.time, _number(one)) for one in envelopes if not one.is_refused)

    def _read(self, number: PacketNumber) -> Packet:
        key = (*robot_and_epoch(number.session), number.sequence)
        return decode(self._store.packets([key])[key].data)

    def _write(self, output: "_Output", is_busy: bool = False) -> bool:
        """Write an output in a copy of this process, if something is new and the last time is long enough ago.

        ``is_busy``: packets may wait.
        """
        if output.copy is not None:
            exitcode = output.copy.exitcode
            if exitcode is None and self._clock() > output.began_s + LONGEST_COPY_S:
                output.copy.terminate()  # it hangs, and another one is to write the output
            return exitcode is not None and self._end_writing(output, exitcode)
        is_new = output.shown != self._applied or (output is self._live and self._certifies())
        if not is_new or self._applied < self._resumed_at or self._clock() < output.due_s(is_busy):
            return False
        try:
            if self._host.fleet.read_ahead(AT_ONCE):  # after a restart, in small steps
                return True
            write = output.writer()
            output.began_s = self._clock()
            output.copy = self._start(lambda: _written(output.name, write), output.niceness)
        except Exception as error:  # packets matter more, and there may be memory later
            return self._postpone(output, f"{type(error).__name__}: {error}")
        output.shown = output.begun = self._applied
        return True

    def _end_writing(self, output: "_Output", exitcode: int) -> bool:
        output.ended_s, output.copy = self._clock(), None
        if exitcode:  # packets matter more, and the disk may be freed
            return self._postpone(output, f"the writer ended with code {exitcode}")
        try:
            self._share(output.shared_as, output.place)
        except StoreError as error:
            return self._postpone(output, str(error))
        if output is self._live:
            self._emit_event("live", output.begun)
        return True

    def _postpone(self, output: "_Output", reason: str) -> bool:
        _log.error("%s will be written later: %s", output.name, reason)
        output.shown, output.ended_s = -1, self._clock() + PAUSE_S
        return False

    def _joint_maps_writer(self) -> Callable[[], None]:
        """What writes the joint maps as they are now. A copy of this process must not use the store."""
        known = self._concluded
        is_final = known is not None and known[0] == (self._applied, self._newest_edit)
        result = known[1] if known is not None and is_final else self._host.fleet.estimate()
        heard_s, place = dict(self._heard), self._folder.joint_maps
        return lambda: write_joint_maps(place, joint_maps_of(result, heard_s, self._config.map))

    def _certifies(self) -> bool:
        """Whether the live map is to be drawn with a new certificate. A map with news is first drawn without."""
        is_old = self._clock() >= self._certify_at and self._certified_packets < self._applied
        return is_old and (self._live.shown == self._applied or self._certify_at < self._clock() - LONGEST_WAIT_S)

    def _live_writer(self) -> Callable[[], None]:
        result, traffic = self._host.fleet.estimate(), self._store.traffic()
        maps = {robot.robot: robot.map_index for robot in result.robots}
        if certifies := self._certifies():
            self._certified, self._certified_packets = maps, self._applied
            self._certify_at = self._clock() + QUALITY_EVERY_S
        elif maps != self._certified:
            self._certified_packets, self._certify_at = -1, min(self._certify_at, self._clock())
        return lambda: self._write_live(result, traffic, certifies)

    def _write_live(self, result: FleetResult, traffic: Ledger, certifies: bool) -> None:
        run = self._run(result, traffic, with_local_maps=False, with_certificates=certifies)
        if not certifies and self._certified == {name: robot.map_index for name, robot in run.trajectories.items()}:
            before = self._folder.live / QUALITY
            run = replace(run, quality=before.read_bytes() if before.exists() else b"")
        self._folder.publish(run)

    def _run(
        self, result: FleetResult, traffic: Ledger, with_local_maps: bool = True, with_certificates: bool = True
    ) -> Run:
        counts: Counter[str] = Counter()  # over all floors
        for state in self._host.fleet.vocabularies():
            counts[f"words_{state.channel}_{state.detector_version}"] += state.words
        words = [Metric(name, count, "1") for name, count in counts.items()]
        tracks = {robot.robot: keyscan_track(robot) for robot in result.robots}
        metrics = [Metric(TURNS, self._applied, "1"), *words, *traffic_metrics(traffic, tracks)]
        return run_of(
            result,
            tracks,
            metrics,
            dump(self._config),
            self._config.map,
            with_local_maps=with_local_maps,
            with_certificates=with_certificates and self._config.fleet.fusion is FusionStrategy.JOINT,
        )


class CrashLog:
    """Remembers what a worker was doing when it ended, so that one task cannot end every worker after it.

    The file outlives the worker, not a loss of power: a task costs no wait for the disk.
    """

    def __init__(self, path: Path) -> None:
        """Read what the worker before was at."""
        self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            before = json.loads(os.pread(self._file, 512, 0))
            self._suspect, self._crashes = str(before["at"]), int(before["crashes"])
        except (ValueError, LookupError, TypeError):
            self._suspect, self._crashes = "", 0
        self._begun = ""

    def is_fatal(self, task: str) -> bool:
        """Whether the task is left out, after ending too many workers in a row."""
        return task == self._suspect and self._crashes >= MOST_CRASHES

    def begin(self, task: str) -> None:
        """Note that the worker begins a task, and has survived the one before."""
        if self._begun == self._suspect:
            self._suspect = ""
        self._begun = task
        state = {"at": task, "crashes": self._crashes + 1 if task == self._suspect else 1}
        with suppress(OSError):  # the disk is full
            os.pwrite(self._file, json.dumps(state).encode().ljust(512), 0)

    def end(self) -> None:
        """Note that the worker has survived its task."""
        self.begin("")


@dataclass
class _Output:
    """Results that copies of the worker write now and then: the live run folder, or the joint maps."""

    name: str
    shared_as: str
    place: Path
    busy_share: float
    """Largest share of the time for writing while packets wait."""
    niceness: int
    writer: Callable[[], Callable[[], None]]
    """Gives what writes the output as it is now."""
    ended_s: float
    """When the newest copy ended, or this worker began."""
    shown: int = -1
    """How many packets it shows, or will when it is written; -1: it is to be written anew."""
    begun: int = -1
    """How many packets the newest copy writes."""
    copy: Background | None = None
    began_s: float = math.inf
    """When the newest copy began."""

    def due_s(self, is_busy: bool = False) -> float:
        """When the next copy may begin; ``is_busy``: while packets wait."""
        took_s = max(self.ended_s - self.began_s, 0.0)
        pause_s = took_s * (1.0 / self.busy_share - 1.0) if is_busy else took_s
        return self.ended_s + min(max(pause_s, WRITE_EVERY_S), LONGEST_WAIT_S)


def _number(packet: StoredPacket | Envelope) -> PacketNumber:
    return PacketNumber(session_name(packet.robot, packet.epoch), packet.sequence)


def _written(name: str, write: Callable[[], None]) -> None:
    """Write an output in a copy of the worker, which ends with code 1 if it fails."""
    try:
        write()
    except Exception as error:
        _log.error("%s cannot be written: %s: %s", name, type(error).__name__, error)
        sys.exit(1)


def _chained(before: bytes, data: bytes) -> bytes:
    """Hash of a sequence of packets, by that of all but the last one."""
    return blake2b(before + data, digest_size=16).digest()


def main() -> int:
    """Work until stdin ends."""
    # The service stops first, which ends stdin. It also sends a signal, so nobody has to wait for a compiler.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)  # a copy of this process would wait for threads that it does not have
    warm_up_fleet()
    for late in LATE:
        import_module(late)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    gc.freeze()
    gc.set_threshold(100_000, 50, 100)  # many small arrays and no cycles: looking for some costs a tenth of the time
    task = _task()
    if task is None:
        return 0
    folder = MissionFolder(Path(task.folder))
    look_s = math.inf if task.store is None else 0.25  # nobody notifies of packets that other instances stored
    alone = _alone(folder)
    try:
        with verifying(task.workers, must_connect=False) as verify_pairs, _mission(folder, task) as (store, share):
            worker = Worker(folder, store, time.monotonic, emit_event, start_copy, verify_pairs, share)
            emit_event(READY, None)
            while True:
                wait_s = 0.0 if worker.step() else min(worker.wait_s(), look_s)
                if select.select([sys.stdin], [], [], wait_s)[0] and not os.read(sys.stdin.fileno(), 4096):
                    break
    except (LeaseLostError, StoreError) as error:
        _log.warning("this worker ends: %s", error)
    except BrokenPipeError:
        _log.warning("this worker ends: its service is gone")
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left to write goes nowhere
    alone.close()
    return 0


def _task() -> WorkerTask | None:
    """The task, which may come late; None: stdin ended before."""
    line = b""
    while not line.endswith(b"\n"):
        byte = os.read(sys.stdin.fileno(), 1)
        if not byte:
            return None
        line += byte
    return WorkerTask(**json.loads(line))


@contextmanager
def _mission(folder: MissionFolder, task: WorkerTask) -> Iterator[tuple[MissionStore, Share]]:
    """The mission of a file, or of a server to which the worker has a lease."""
    if task.store is None or task.lease is None:
        yield MissionStore(folder.store, is_checked=True), lambda *_: None  # by the service
        return
    with closing(Postgres(task.store, f"worker of {folder.name}")) as server:
        held = Lease(*task.lease)
        fetch_snapshot(server, held, folder)
        yield MissionStore(MissionTables(server, held.mission, held)), partial(put_file, server, held)


def _alone(folder: MissionFolder) -> IO[str]:
    """Wait until no other worker has this mission: one whose service was killed may still be at its last step.

    The lock is this worker's until the file is closed.
    """
    file = folder.worker_lock.open("w")
    fcntl.flock(file, fcntl.LOCK_EX)
    return file


if __name__ == "__main__":
    sys.exit(main())
