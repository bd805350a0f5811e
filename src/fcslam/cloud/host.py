"""One host of a fleet: what the worker of a service, a mission of recordings and a robot alone have in common."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from fcslam.cloud.edits import in_force, needs_new_fleet
from fcslam.cloud.fleet import Fleet
from fcslam.cloud.packet_log import PacketLog, PacketNumber
from fcslam.cloud.report import fuse_members
from fcslam.cloud.result import FleetResult, MappedRobot
from fcslam.cloud.settings import CloudConfig
from fcslam.errors import PacketError
from fcslam.geometry import se2, se3
from fcslam.geometry.groups import group_of, to_space
from fcslam.lidar.pair_verification import VerifyPairs, verify_here
from fcslam.maps.fusion import fuse
from fcslam.maps.joint_voxels import joint_voxels
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.records import ClosureStatus, Edit, FloatArray, frozen
from fcslam.storage.snapshot import from_state, to_state
from fcslam.storage.state_file import State
from fcslam.wire.messages import Packet


class FleetHost:
    """Owns a fleet: applies packets in their order, follows edits, and answers what the map of a session is."""

    def __init__(
        self, config: CloudConfig, read: Callable[[PacketNumber], Packet], verify_pairs: VerifyPairs = verify_here
    ) -> None:
        self._settings, self._read, self._verify_pairs = config, read, verify_pairs
        self.edits: tuple[Edit, ...] = ()
        """Those that it follows, in their order."""
        self._begin()

    def _begin(self) -> None:
        self.fleet = Fleet(self._settings.fleet, self._settings.seed, self._verify_pairs)
        self.log = PacketLog()

    def state(self) -> State:
        """The state after the packets so far, without these."""
        return {"fleet": self.fleet.state(), "log": to_state(self.log)}

    def restore(self, state: State, edits: Sequence[Edit] = ()) -> None:
        """Take over a state of the same configuration, which had followed ``edits``."""
        settings = self._settings
        fleet = Fleet.restored(
            settings.fleet, settings.seed, state["fleet"], self._read, self._verify_pairs, in_force(edits)
        )
        self.fleet, self.log, self.edits = fleet, from_state(PacketLog, state["log"]), tuple(edits)

    def follow(self, edits: Sequence[Edit]) -> bool:
        """Follow further edits; True if the fleet is a new one, because the edits change what applied packets do."""
        before, self.edits = in_force(self.edits), (*self.edits, *edits)
        now = in_force(self.edits)
        is_new = needs_new_fleet(before, now)
        if is_new:
            self._begin()
        self.fleet.edit(now)
        return is_new

    def apply_next(self, number: PacketNumber, packet: Packet) -> None:
        """Apply the packet that the log gives next; the number of one that is refused is used up."""
        try:
            self.fleet.apply(packet)
        except PacketError:
            self.log.refuse(number)
            raise

    def conclude(self, arrived: Iterable[tuple[float, PacketNumber]]) -> FleetResult:
        """The result of all packets that took effect, of which ``arrived`` has the times; it depends on their set."""
        return self.fleet.finalize(self.log, arrived, self._read)

    def poses(self, session: str) -> FloatArray:
        """``T_map_base`` of the session's keyscans so far, shape (K, P), metres and radians."""
        found = (mapped for mapped in self.fleet.estimate().robots if mapped.robot == session)
        paths = (mapped.T_map_base if mapped.space is None else mapped.space.T_map_base for mapped in found)
        return next(paths, np.empty((0, self._settings.fleet.group.size)))

    def draw(self, session: str, T_other_map: FloatArray) -> OccupancyMap:
        """The map that a session is in, in another frame, seen from above."""
        T_other_map = group_of(T_other_map).to_plane(T_other_map)
        members = [
            replace(mapped, T_map_base=frozen(se2.compose(T_other_map, mapped.T_map_base)))
            for mapped in _in_map_of(session, self.fleet.estimate()).values()
        ]
        grid = self._settings.map
        return fuse_members(members, grid) if members else fuse((), np.empty((0, 3)), {}, grid)

    def points(self, session: str, T_other_map: FloatArray) -> FloatArray:
        """A point for each voxel of the map that a session is in, in another frame, shape (N, 3)."""
        paths = [mapped.space for mapped in _in_map_of(session, self.fleet.estimate()).values()]
        placed = [(voxels, path.T_map_base[voxels.id.number]) for path in paths if path for voxels in path.voxel_maps]
        return se3.transform(to_space(T_other_map), joint_voxels(placed)[0]) if placed else np.empty((0, 3))

    def closures(self, session: str, T_other_map: FloatArray) -> FloatArray:
        """Both ends of each accepted closure in the map of a session, shape (N, 2, 2), metres in another frame."""
        T_other_map = group_of(T_other_map).to_plane(T_other_map)
        result = self.fleet.estimate()
        members = _in_map_of(session, result)
        ends = [
            [members[end.robot].T_map_base[end.number] for end in (closure.i, closure.j)]
            for closure in result.closures
            if closure.status is ClosureStatus.ACCEPTED and {closure.i.robot, closure.j.robot} <= members.keys()
        ]
        return se2.compose(T_other_map, np.array(ends).reshape(-1, 2, 3))[..., :2]


def _in_map_of(session: str, result: FleetResult) -> dict[str, MappedRobot]:
    index = next((mapped.map_index for mapped in result.robots if mapped.robot == session), None)
    return {mapped.robot: mapped for mapped in result.robots if mapped.map_index == index}
