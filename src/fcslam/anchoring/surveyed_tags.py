"""Where the tags of a map are, which of them contradict each other, and maps placed by surveyed tags.

The joint graph decided before which sightings count. A tag whose sightings lie in several places was moved or is there
twice. A robot that sees all tags too near or too far has a wrong calibration, or a wrong size of the tags.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import Field, NonNegativeInt, ValidationError

from fcslam.anchoring.part import LEAST_SIGMA_M, ROUNDS, MapPart, Positions
from fcslam.cloud.result import MappedRobot
from fcslam.config import StrictModel, one_line, parse_yaml
from fcslam.errors import SourceError
from fcslam.geometry import se2
from fcslam.geometry.alignment import n_point_alignment
from fcslam.graph.cluster import DIRECTION_M
from fcslam.graph.consistency import TAG_VIEWS
from fcslam.graph.pose_graph import PoseGraph
from fcslam.records import FloatArray, Tag, TagFamily, TagSighting
from fcslam.untrusted import MOST_TEXT_BYTES, read_text

ONE_VISIT: Final = 40
"""A session that sees a tag again after more keyscans has come back to it."""
ELSEWHERE_M: Final = 0.2
"""Visits that see a tag farther apart contradict each other."""
SCALE_ERROR: Final = 0.05
"""A robot whose distances to tags are off by a larger share is reported."""
SCALE_SIGMAS: Final = 5.0
ALIGNED_M: Final = 0.5
"""A surveyed tag agrees with the map as it is if it lies within this of its place."""
LARGEST_OFF_M: Final = 0.15
"""A surveyed tag that is farther off in the solution does not count."""
MOST_PAIRS: Final = 2000
"""Pairs of surveyed tags that propose a motion of the map; the longest baselines count."""

Survey = Mapping[Tag, tuple[float, float, float | None]]
"""Position of each surveyed tag and the direction that it faces, metres and radians; None: it is not known."""


class _Surveyed(StrictModel):
    x: float
    y: float
    yaw: float | None = None


class _SurveyFile(StrictModel):
    family: TagFamily = TagFamily.APRILTAG_36H11
    tags: dict[NonNegativeInt, _Surveyed] = Field(min_length=1)


def read_survey(path: Path) -> Survey:
    """Read the positions of surveyed tags."""
    try:
        content = _SurveyFile.model_validate(parse_yaml(read_text(path, most=MOST_TEXT_BYTES)))
    except ValidationError as error:
        first = error.errors()[0]
        where = "".join(f"{one_line(str(part))}: " for part in first["loc"])
        raise SourceError(
            f"{path}: {where}{one_line(first['msg'])}; write tags: {{7: {{x: 1.5, y: 0.2, yaw: 1.571}}}}"
        ) from error
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: cannot be read ({error}); give a YAML file of surveyed tags") from error
    return {Tag(content.family, number): (at.x, at.y, at.yaw) for number, at in content.tags.items()}


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    pose: FloatArray
    """Shape (3,), weighted mean of its sightings."""
    sightings: tuple[TagSighting, ...]


class MapTags:
    """The tags of one map, by sightings of its robots."""

    def __init__(self, robots: Sequence[MappedRobot], sightings: Sequence[TagSighting]) -> None:
        self._robots = {robot.robot: robot for robot in robots}
        by_tag: dict[Tag, list[TagSighting]] = {}
        for one in sightings:
            if one.id.robot in self._robots:
                by_tag.setdefault(one.tag, []).append(one)
        self.places = {tag: self._places(seen) for tag, seen in sorted(by_tag.items())}
        """Places by tag, the one with most sightings first."""

    def variable(self, sighting: TagSighting) -> int:
        """Number of the variable of its keyscan."""
        return int(self._robots[sighting.id.robot].variables[sighting.id.number])

    def _pose(self, sighting: TagSighting) -> FloatArray:
        robot, keyscan = sighting.id
        return se2.compose(self._robots[robot].T_map_base[keyscan], sighting.T_base_tag)

    def _places(self, seen: Sequence[TagSighting]) -> list[_Place]:
        """Places at which visits saw one tag; those that lie within ``ELSEWHERE_M`` are one."""
        groups: list[list[TagSighting]] = []
        for one in sorted(seen, key=lambda one: one.id):
            last = groups[-1][-1] if groups else None
            if last is None or not self._is_one_visit(last, one):
                groups.append([])
            groups[-1].append(one)
        places: list[_Place] = []
        for visit in sorted((self._mean(group) for group in groups), key=lambda place: -len(place.sightings)):
            gaps_m = (float(np.hypot(*(other.pose[:2] - visit.pose[:2]))) for other in places)
            near = next((k for k, gap_m in enumerate(gaps_m) if gap_m <= ELSEWHERE_M), None)
            if near is None:
                places.append(visit)
            else:
                places[near] = self._mean([*places[near].sightings, *visit.sightings])
        return sorted(places, key=lambda place: -len(place.sightings))

    def _is_one_visit(self, before: TagSighting, after: TagSighting) -> bool:
        gap_m = float(np.hypot(*(self._pose(before) - self._pose(after))[:2]))
        is_soon = before.id.robot == after.id.robot and after.id.number - before.id.number <= ONE_VISIT
        return is_soon and gap_m <= 2.0 * ELSEWHERE_M

    def _mean(self, sightings: Sequence[TagSighting]) -> _Place:
        poses = np.array([self._pose(one) for one in sightings])
        turns = np.array([np.linalg.inv(one.information)[2, 2] for one in sightings])
        xy = np.average(poses[:, :2], axis=0, weights=[1.0 / _variance(one) for one in sightings])
        heading = np.arctan2(*((np.sin(poses[:, 2]) / turns).sum(), (np.cos(poses[:, 2]) / turns).sum()))
        return _Place(np.append(xy, heading), tuple(sightings))

    def report(self, k: int) -> list[dict[str, Any]]:
        """What ``tags.json`` says about the tags of map ``k``."""
        rows = []
        for tag, places in self.places.items():
            shown = [place for place in places if len(place.sightings) >= TAG_VIEWS] or places[:1]
            x, y, heading = shown[0].pose.tolist()
            rows.append(
                {
                    "family": tag.family,
                    "number": tag.number,
                    "map": k,
                    "x": round(x, 3),
                    "y": round(y, 3),
                    "heading_rad": round(heading, 4),
                    "sightings": sum(len(place.sightings) for place in places),
                    "doubtful": len(shown) > 1,
                    "places": [
                        {
                            "x": round(float(place.pose[0]), 3),
                            "y": round(float(place.pose[1]), 3),
                            "robots": sorted({one.id.robot for one in place.sightings}),
                        }
                        for place in shown
                    ],
                }
            )
        return rows

    def scales(self) -> dict[str, float]:
        """By robot, its measured distances to tags as a share of the true ones, if they are clearly wrong."""
        found = {}
        for robot in self._robots:
            moment = product = 0.0
            for places in self.places.values():
                for place in places:
                    own = [one for one in place.sightings if one.id.robot == robot]
                    if len(own) > 1:
                        parts = self._scale_terms(own)
                        moment, product = moment + parts[0], product + parts[1]
            scale = 1.0 - product / moment if moment > 0.0 else 1.0
            sigma = moment**-0.5 if moment > 0.0 else np.inf
            if scale > 0.0 and abs(scale - 1.0) > max(SCALE_ERROR, SCALE_SIGMAS * sigma):
                found[robot] = 1.0 / scale
        return found

    def _scale_terms(self, seen: Sequence[TagSighting]) -> tuple[float, float]:
        """Sums of the weighted squares of the distances to one tag, and of their products with the residuals; both
        without the part that another position of the tag explains."""
        bases = np.array([self._robots[one.id.robot].T_map_base[one.id.number, :2] for one in seen])
        ends = np.array([self._pose(one)[:2] for one in seen])
        weights = np.array([1.0 / _variance(one) for one in seen])
        arms = ends - bases
        arms = arms - np.average(arms, axis=0, weights=weights)
        off = ends - np.average(ends, axis=0, weights=weights)
        return float(weights @ (arms**2).sum(axis=1)), float(weights @ (arms * off).sum(axis=1))


def survey_report(reason: str, used: Sequence[Tag] = (), off_m: Mapping[Tag, float] | None = None) -> dict[str, Any]:
    """What ``tags.json`` says about a map and the survey: why it is not placed, or by which tags.

    ``off_m``: how far each surveyed tag that was seen is from where it should be.
    """
    ignored = {str(tag.number): round(its_m, 3) for tag, its_m in (off_m or {}).items() if tag not in used}
    return {"reason": reason, "used": [tag.number for tag in used], "ignored": ignored}


def placed_by_tags(part: MapPart, sightings: Sequence[TagSighting], survey: Survey) -> tuple[MapPart, dict[str, Any]]:
    """Place a map by surveyed tags, and straighten it. Tags that are not where they should be do not count."""
    tags = MapTags(part.robots, sightings)
    known = [tag for tag in tags.places if tag in survey]
    if not known:
        return part, survey_report("no robot in it saw a surveyed tag")
    seen = {tag: tags.places[tag][0].pose for tag in known}
    T, used = _aligned(seen, survey)
    if T is None:
        return part, survey_report(_why_not_aligned(seen, survey))
    start = se2.compose(T, part.graph.poses())
    while True:
        # Of two tags, no third one shows which is wrong, and the solution would bend the map between them.
        if len(used) == 2 and abs(np.subtract(*_distances_m(seen, survey, *used))) > 2.0 * LARGEST_OFF_M:
            return part, survey_report(_contradiction(seen, survey, *used))
        moved = part.at(_solve(part.graph, start, tags, used, survey))
        places = MapTags(moved.robots, sightings).places
        off_m = {tag: float(np.hypot(*(places[tag][0].pose[:2] - np.array(survey[tag][:2])))) for tag in known}
        worst = max(used, key=lambda tag: off_m[tag])
        if off_m[worst] <= LARGEST_OFF_M or len(used) <= 2:
            return moved, survey_report("", used, off_m)
        used = [tag for tag in used if tag != worst]


def _aligned(seen: Mapping[Tag, FloatArray], survey: Survey) -> tuple[FloatArray | None, list[Tag]]:
    """The motion of the map with which most surveyed tags agree, and these."""
    tags, here = list(seen), np.array(list(seen.values()))
    there = np.array([survey[tag][:2] for tag in tags])
    pairs = np.column_stack(np.triu_indices(len(tags), 1))
    baselines_m = np.hypot(*(here[pairs[:, 0], :2] - here[pairs[:, 1], :2]).T)
    longest = np.argsort(-baselines_m, kind="stable")[:MOST_PAIRS]
    pairs = pairs[longest[baselines_m[longest] >= DIRECTION_M]]
    motions = list(n_point_alignment(there[pairs], here[pairs, :2]))
    least = 2
    if not motions:
        faced = [(survey[tag], seen[tag]) for tag in tags if survey[tag][2] is not None]
        motions = [se2.compose(np.array(at), se2.inverse(pose)) for at, pose in faced]
        least = 1
    best: tuple[FloatArray | None, list[Tag]] = None, []
    for T in motions:
        off_m = np.hypot(*(se2.compose(T, here)[:, :2] - there).T)
        agreeing = np.flatnonzero(off_m <= ALIGNED_M)
        if len(agreeing) >= max(least, len(best[1]) + 1):
            best = T, [tags[k] for k in agreeing]
    return best


def _why_not_aligned(seen: Mapping[Tag, FloatArray], survey: Survey) -> str:
    if len(seen) == 1:
        return "one tag without yaw fixes no heading; give its yaw, or survey a second tag"
    a, b = max(combinations(seen, 2), key=lambda pair: _distances_m(seen, survey, *pair)[0])
    if _distances_m(seen, survey, a, b)[0] < DIRECTION_M:
        return (
            f"the tags that were seen are less than {DIRECTION_M:g} m apart and fix no heading; give the yaw of one, "
            "or survey a tag farther away"
        )
    return _contradiction(seen, survey, a, b)


def _contradiction(seen: Mapping[Tag, FloatArray], survey: Survey, a: Tag, b: Tag) -> str:
    mapped_m, surveyed_m = _distances_m(seen, survey, a, b)
    return (
        f"tags {a.number} and {b.number} are {mapped_m:.2f} m apart in the map and {surveyed_m:.2f} m in the survey; "
        "check both"
    )


def _distances_m(seen: Mapping[Tag, FloatArray], survey: Survey, a: Tag, b: Tag) -> tuple[float, float]:
    here, there = seen[a][:2] - seen[b][:2], np.subtract(survey[a][:2], survey[b][:2])
    return float(np.hypot(*here)), float(np.hypot(*there))


def _solve(graph: PoseGraph, poses: FloatArray, tags: MapTags, used: Sequence[Tag], survey: Survey) -> FloatArray:
    """Solve with the positions of surveyed tags; all sightings of a tag count as one measurement."""
    if len(used) < 2:
        return poses
    seen = [(one, len(place.sightings)) for place in (tags.places[tag][0] for tag in used) for one in place.sightings]
    positions = Positions(
        np.array([tags.variable(one) for one, _ in seen]),
        np.array([one.T_base_tag[:2] for one, _ in seen]),
        np.array([survey[one.tag][:2] for one, _ in seen]),
        np.array([((_variance(one) + LEAST_SIGMA_M**2) * count) ** 0.5 for one, count in seen]),
    )
    for _ in range(ROUNDS):
        poses = positions.solved(graph, poses)
    return poses


def _variance(sighting: TagSighting) -> float:
    """Mean variance of the position along both axes."""
    return float(np.linalg.inv(sighting.information)[:2, :2].trace()) / 2.0


def tag_lines(report: Mapping[str, Any]) -> Iterator[str]:
    """What ``tags.json`` says that a user should know, one sentence each."""
    wrong = report["distances"].keys()
    for row in report["tags"]:
        if row["doubtful"] and not any(wrong & set(at["robots"]) for at in row["places"]):
            places = [f"{', '.join(at['robots'])} at ({at['x']:.2f}, {at['y']:.2f})" for at in row["places"]]
            gap_m = max(float(np.hypot(a["x"] - b["x"], a["y"] - b["y"])) for a, b in combinations(row["places"], 2))
            yield (
                f"tag {row['family']} {row['number']} was moved or hangs twice: seen by {' and by '.join(places)}, "
                f"{gap_m:.2f} m apart"
            )
    for robot, scale in report["distances"].items():
        yield (
            f"{robot} measures tags at {scale:.2f} times their distance; check robot.tags.size_m and the camera's "
            "calibration"
        )
    for row in report.get("surveyed", ()):
        if row["reason"]:
            yield f"map {row['map']} is not placed by surveyed tags: {row['reason']}"
            continue
        yield f"map {row['map']} is placed by surveyed tags: {', '.join(map(str, row['used']))}"
        for number, off_m in row["ignored"].items():
            yield f"tag {number} is {off_m:.2f} m from where it was surveyed, and does not count"
