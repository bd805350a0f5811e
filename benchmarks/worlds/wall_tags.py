"""Tags on the walls of a simulated building, drawn into the images of its cameras."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.lab.simulation.floorplan import WALL_M, FloorPlan, Room
from fcslam.records import CameraModel, FloatArray, TagFamily

FAMILY: Final = TagFamily.APRILTAG_36H11
SIZE_M: Final = 0.3
"""Side of the black square."""
HEIGHT_M: Final = 1.0
"""Height of the middle above the floor."""
_OFF_M: Final = WALL_M / 2.0 + 0.02
_CELL_PX: Final = 24
_CELLS: Final = 10
"""Black square and white border, in cells of the code."""
_FINER: Final = 4
"""Samples of a pixel along each axis."""
_FARTHEST_M: Final = 10.0


@dataclass(frozen=True, slots=True)
class WallTag:
    """A tag on a wall."""

    number: int
    T_building_tag: tuple[float, float, float]
    """Position, and the direction that it faces."""
    size_m: float = SIZE_M
    height_m: float = HEIGHT_M
    family: TagFamily = FAMILY


def hang_tags(plan: FloorPlan, count: int, rng: np.random.Generator) -> tuple[WallTag, ...]:
    """Tags beside doors, in corridors, and on the walls opposite of doors, in rooms; not more than there are places."""
    places = [place for room in plan.rooms for place in _places(room)]
    chosen = rng.permutation(len(places))[:count]
    return tuple(WallTag(number, places[row]) for number, row in enumerate(chosen.tolist()))


def _places(room: Room) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    inward = float(np.sign(room.inside[1] - room.doorway[1]))
    front, back = (room.low[1], room.high[1]) if inward > 0 else (room.high[1], room.low[1])
    beside = float(room.doorway[0]) - 0.8, float(front) - inward * _OFF_M, -inward * np.pi / 2.0
    return beside, (float(room.doorway[0]), float(back) - inward * _OFF_M, -inward * np.pi / 2.0)


def draw_tags(
    pixels: NDArray[np.floating],
    camera: CameraModel,
    T_building_base: FloatArray,
    tags: Sequence[WallTag],
    walls: FloatArray,
) -> None:
    """Draw the tags that a camera sees into its image.

    Args:
        pixels: the image, shape (height, width, channels), grey levels up to 255; changed.
        camera: the camera.
        T_building_base: pose of the robot, shape (3,).
        tags: the tags.
        walls: what hides tags, x1 y1 x2 y2, shape (S, 4), metres.
    """
    import cv2

    R_base_camera = camera.T_base_camera.rotation_matrix()
    eye = np.array(camera.T_base_camera.translation_m)
    for tag in tags:
        T_base_tag = se2.between(T_building_base, np.array(tag.T_building_tag))
        facing = np.array((np.cos(T_base_tag[2]), np.sin(T_base_tag[2])))
        to_eye = eye[:2] - T_base_tag[:2]
        near = np.hypot(*to_eye) < _FARTHEST_M and to_eye @ facing > 0.1 * np.hypot(*to_eye)
        if not near or _is_hidden(
            se2.transform(T_building_base, eye[None, :2])[0], np.array(tag.T_building_tag), walls
        ):
            continue
        # Seen from the front, x of the tag is to the right.
        half = 0.5 * tag.size_m * _CELLS / (_CELLS - 2)
        right = np.array((-facing[1], facing[0], 0.0))
        centre = np.array((T_base_tag[0], T_base_tag[1], tag.height_m))
        up = np.array((0.0, 0.0, 1.0))
        corners = [centre + half * (x * right + y * up) for x, y in ((-1, 1), (1, 1), (1, -1), (-1, -1))]
        in_camera = (np.array(corners) - eye) @ R_base_camera
        if (in_camera[:, 2] < 0.1).any():
            continue
        at = in_camera[:, :2] / in_camera[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        low = np.clip(np.floor(at.min(axis=0)).astype(int) - 1, 0, (camera.width, camera.height))
        high = np.clip(np.ceil(at.max(axis=0)).astype(int) + 2, 0, (camera.width, camera.height))
        if (high <= low).any():
            continue
        # All images count from the centre of their first pixel, the finer one in quarters.
        code = _code(tag)
        edge = len(code) - 0.5
        given = np.array(((-0.5, -0.5), (edge, -0.5), (edge, edge), (-0.5, edge)), np.float32)
        fine = ((at - low + 0.5) * _FINER - 0.5).astype(np.float32)
        drawn = np.stack((code, np.full(code.shape, 255.0, np.float32)), axis=-1)
        size = tuple((high - low).tolist())
        warped = cv2.warpPerspective(
            drawn, cv2.getPerspectiveTransform(given, fine), (_FINER * size[0], _FINER * size[1])
        )
        shown = cv2.resize(warped, size, interpolation=cv2.INTER_AREA)
        share, part = shown[..., 1:] / 255.0, pixels[low[1] : high[1], low[0] : high[0]]
        part[...] = part * (1.0 - share) + 0.8 * shown[..., :1] + 20.0 * share


def _code(tag: WallTag) -> NDArray[np.float32]:
    """The tag with a white border of one cell."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{tag.family.upper()}"))
    cells = _CELLS - 2
    black = cv2.aruco.generateImageMarker(dictionary, tag.number, cells * _CELL_PX)
    return np.pad(black, _CELL_PX, constant_values=255).astype(np.float32)


def _is_hidden(eye: FloatArray, tag: FloatArray, walls: FloatArray) -> bool:
    """Whether a wall is between a point (2,) and a little in front of a tag (3,)."""
    target = tag[:2] + 0.02 * np.array((np.cos(tag[2]), np.sin(tag[2])))
    ray, along = target - eye, walls[:, 2:] - walls[:, :2]
    cross = ray[0] * along[:, 1] - ray[1] * along[:, 0]
    cross = np.where(np.abs(cross) < 1e-12, np.inf, cross)
    gap = walls[:, :2] - eye
    s = (gap[:, 0] * along[:, 1] - gap[:, 1] * along[:, 0]) / cross
    t = (gap[:, 0] * ray[1] - gap[:, 1] * ray[0]) / cross
    return bool(((s > 0.0) & (s < 1.0) & (t >= 0.0) & (t <= 1.0)).any())
