"""Map recordings, or localize in a map, with one function call; the commands call the same functions."""

import logging
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from fcslam import sources
from fcslam.anchoring.anchors import Anchors
from fcslam.config import load, parse
from fcslam.errors import SourceError
from fcslam.lidar.frontend import LidarConfig
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.mission.driving import side_by_side
from fcslam.mission.mission import (
    MissionConfig,
    MissionInputs,
    Watch,
    continued_config,
    doubted,
    run_mission,
)
from fcslam.mission.mission_file import EMPTY, read_mission
from fcslam.records import StrPath, Veto
from fcslam.robot.calibrating import calibrated
from fcslam.runs import Run, open_run, prepare_output
from fcslam.sources import BagOptions, Source

if TYPE_CHECKING:
    from fcslam.maps.changes import Changes
    from fcslam.mission.localization import FinishedMap, LocalizationProgress

Recordings = StrPath | Iterable[StrPath | Source] | Mapping[str, StrPath]

_log = logging.getLogger(__name__)


def map_recordings(
    recordings: Recordings,
    *,
    config: MissionConfig | Mapping[str, Any] | StrPath | None = None,
    output: StrPath | None = None,
    split: int = 1,
    vetoes: Iterable[Veto] = (),
    bag_options: BagOptions | None = None,
    progress: Watch | None = None,
    force: bool = False,
    processes: int = 1,
    onto: StrPath | None = None,
    floors: str | Mapping[str, str] = "",
    anchors: Anchors = Anchors(),  # noqa: B008
) -> Run:
    """Map the recordings of several robots together, one robot per recording.

    The same recordings, configuration and seed give the same run. Lesser faults of a recording are logged as warnings.

    Args:
        recordings: one path, several, or a mapping of robot names to paths, in any known format. Without a mapping,
            each robot is named after its file. A bag of several robots gives all of them, and one of them is named as
            in ``fleet.bag:/robot1``. Objects of your own that implement ``Source`` can stand for paths.
        config: a ``MissionConfig``, a mapping with some of its keys, or the path of a YAML file; missing keys have
            their default values.
        output: run folder to write; by default nothing is written.
        split: number of robots into which a single recording is cut, with equal scan counts; the odometry of each
            starts at zero.
        vetoes: closures that you know to be false.
        bag_options: topics and the pose of the laser, where a ROS bag leaves a choice.
        progress: called every 50 scans, and before the maps are fused, with the state of the mission.
        force: replace a run that is at ``output``.
        processes: number of robots that are mapped at a time, each in a process of its own. With 2 or more, closures of
            a single robot are found in a process beside it. The number does not change the run.
        onto: mission file, or run folder with one, of an earlier mission that goes on. The run is that of all
            recordings at once; the earlier ones are not needed. Without ``config`` the mission keeps its settings of
            the cloud. Without recordings it is mapped again, with the edits that it has.
        floors: the floor on which all recordings were made, or a mapping of robot names to floors. The name
            ``"anna@44"`` is the robot ``anna`` from 44 s after its first scan on, in a new session. Places of different
            floors are never compared, so each floor has maps of its own.
        anchors: what is known about the building, such as its floor plan, from ``read_anchors``.

    Raises:
        InputError: a recording, the configuration, a veto or the output folder cannot be used. The message is one line
            that says what is wrong and what to do. Most errors are found before the mapping begins.
    """
    if output is not None:
        prepare_output(Path(output), force)
    earlier = EMPTY if onto is None else read_mission(Path(onto))
    settings = settings_of(continued_config(earlier) if config is None else config)
    options = in_3d(bag_options, settings)
    opened = _opened(recordings, options, settings.robot.lidar, at_least=1 if onto is None else 0)
    robots = split_recordings(opened, split)
    for note in notes_in_space(opened, settings):
        _log.info("%s", note)
    if isinstance(floors, str):
        floors = {robot.name: floors for robot in robots if floors}
    inputs = MissionInputs(earlier, tuple(vetoes), floors, anchors)
    run = run_mission(robots, settings, progress or (lambda _: None), inputs, side_by_side(processes))
    run = doubted(run, {robot.name: robot.survey() for robot in robots})
    if output is not None:
        run.save(output, force)
    return run


def localize(
    recording: StrPath | Source,
    map: "StrPath | OccupancyMap | FinishedMap",  # the word that users expect
    *,
    initial_pose: ArrayLike | None = None,
    config: MissionConfig | Mapping[str, Any] | StrPath | None = None,
    output: StrPath | None = None,
    bag_options: BagOptions | None = None,
    progress: "Callable[[LocalizationProgress], None] | None" = None,
    force: bool = False,
    floor: str = "",
    update: bool = False,
) -> Run:
    """Localize the robot of a recording in a finished map, which does not change meanwhile.

    The robot's starting pose need not be known. A robot that does not know where it is has no pose, never a guess.

    Args:
        recording: a recording of any known format, or an object of your own that implements ``Source``.
        map: a run folder or mission file; the YAML file of a ROS map; or a map.
        initial_pose: about where the recording starts in the map, (x, y, theta), metres and radians; None: anywhere.
        config: as for ``map_recordings``; ``robot`` counts.
        output: as for ``map_recordings``.
        bag_options: as for ``map_recordings``.
        force: as for ``map_recordings``.
        progress: called every 50 scans.
        floor: floor of the recording, whose first map is used; it must be named if the run has maps of several floors.
        update: change the map of the run where at least ``map.contradicting_scans`` scans contradict it. The previous
            map is beside it, as ``map_before``; poses and other cells stay.

    Returns:
        A run whose trajectory has the localized scans; ``localized`` has every scan, with its quality.

    Raises:
        InputError: the recording, the map, the pose, the floor, the configuration or the output folder cannot be used.
    """
    from fcslam.mission.localization import (  # SciPy's images: mapping alone needs none
        FinishedMap,
        pose_in_map,
        read_finished,
        run_localization,
    )

    if output is not None:
        prepare_output(Path(output), force)
    settings = settings_of(config)
    if isinstance(map, FinishedMap):
        finished = map
    else:
        finished = FinishedMap(map) if isinstance(map, OccupancyMap) else read_finished(Path(map), floor)
    if isinstance(recording, str | os.PathLike):
        options = replace(bag_options or BagOptions(), in_3d=True) if finished.ply else bag_options
        opened = sources.whole_clouds(sources.open_source(Path(recording), options), options)
        recording = _checked(calibrated(opened, settings.robot.lidar))
    initial = None if initial_pose is None else pose_in_map("initial_pose", initial_pose, finished.occupancy)
    run = run_localization(recording, finished, settings, initial, progress or (lambda _: None), update)
    if output is not None:
        run.save(output, force)
    return run


def changes(
    run: StrPath,
    *,
    since: str | None = None,
    until: str | None = None,
    map_index: int = 0,
    output: StrPath | None = None,
    force: bool = False,
) -> "Changes":
    """Return the changes in the building of a run between two times.

    Args:
        run: run folder with a mission file.
        since: the earlier time. A session means the end of its period; a number is a stamp in seconds. Else it is a
            date or time of ISO 8601, in UTC if it has no zone; a date means the end of the day. None: the oldest
            period.
        until: the later time; None: the newest period.
        map_index: number of the map in the run folder.
        output: folder to write; by default nothing is written.
        force: replace changes that are at ``output``.

    Raises:
        InputError: the run has no mission file or no such map, a time is wrong, or the output folder cannot be used.
    """
    from fcslam.mission.map_changes import changes_of, check_output, save_changes

    opened, mission = open_run(run), read_mission(Path(run))
    if output is not None:
        check_output(Path(output), force)
    found = changes_of(opened, mission, since, until, map_index, str(Path(run)))
    if output is not None:
        save_changes(found, Path(output), force)
    return found


def in_3d(options: BagOptions | None, settings: MissionConfig) -> BagOptions | None:
    """The options with which recordings are read: clouds whole, if poses are in space."""
    return options if settings.fleet.dimensions == 2 else replace(options or BagOptions(), in_3d=True)


def notes_in_space(recordings: Sequence[Source], settings: MissionConfig) -> list[str]:
    """Lines about what a map in space does not use of the recordings and the settings; none in the plane."""
    if settings.fleet.dimensions == 2:
        return []
    unused = settings.robot.unused_in_space if any(map(sources.is_whole, recordings)) else ""
    planar = ", ".join(source.name for source in recordings if not sources.is_whole(source))
    return [*filter(None, (planar and sources.IN_PLANE.format(planar), unused))]


def split_recordings(recordings: list[Source], parts: int) -> list[Source]:
    """Cut the only one of ``recordings`` into ``parts`` robots; with 1 part, all recordings stay as they are."""
    if parts == 1:
        return recordings
    if len(recordings) != 1:
        raise SourceError(
            f"--split cuts one recording (in Python split={parts}), {len(recordings)} are given; map them one by one"
        )
    return sources.split(recordings[0], parts)


def _opened(recordings: Recordings, options: BagOptions | None, config: LidarConfig, at_least: int) -> list[Source]:
    """The recordings as sources, bags calibrated, each checked as far as can be without reading the ranges."""
    if isinstance(recordings, str | os.PathLike):
        recordings = [recordings]
    named: list[tuple[StrPath | Source, str | None]] = (
        [(path, name) for name, path in recordings.items()]
        if isinstance(recordings, Mapping)
        else [(item, None) for item in recordings]
    )
    if len(named) < at_least:
        raise SourceError("no recording is given; give one for each robot")
    own = {id(item) for item, _ in named}
    given = [(Path(item) if isinstance(item, str | os.PathLike) else item, name) for item, name in named]
    opened = sources.open_fleet(given, options)
    return [source if id(source) in own else _checked(calibrated(source, config)) for source in opened]


def _checked(source: Source) -> Source:
    survey = source.survey()
    for note in survey.notes:
        _log.info("%s: %s", source.name, note)
    if survey.faults:
        _log.warning("%s: %s", source.name, survey.faults)
    return source


def settings_of(config: MissionConfig | Mapping[str, Any] | StrPath | None) -> MissionConfig:
    """A complete configuration from what a user gives."""
    if isinstance(config, str | os.PathLike):
        return load(MissionConfig, Path(config))
    content = config.model_dump() if isinstance(config, MissionConfig) else dict(config or {})
    return parse(MissionConfig, content, "config")
