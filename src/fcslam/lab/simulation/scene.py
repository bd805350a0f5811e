"""The building as a MuJoCo model. Group 0 is visible to lasers and cameras, group 1 only to cameras."""

import math
from collections.abc import Iterator
from itertools import pairwise, product
from typing import Any

import numpy as np

from fcslam.lab.simulation.decoration import DOOR_HEIGHT_M, LAMP_HEIGHT_M, WALL_HEIGHT_M, Decoration, Light
from fcslam.lab.simulation.engine import mujoco
from fcslam.lab.simulation.floorplan import FloorPlan, Piece, PieceKind
from fcslam.lab.simulation.textures import Image
from fcslam.records import FloatArray

SOLID, SEEN = 0, 1
CAMERA = "camera"
LIGHTS = 5
"""Number of lights, which move to the lamps nearest to the robot; software GL supports eight at most."""

_TEXTURE_M = WALL_HEIGHT_M
"""Size of one repeat of a wall or floor texture."""


def bare_model(plan: FloorPlan) -> Any:
    """Model of a building for lasers: walls and furniture without textures."""
    builder = _Builder()
    for _, piece in _standing(plan):
        builder.piece(piece, WALL_HEIGHT_M, "")
    return builder.compile()


def furnished_model(
    plan: FloorPlan, decoration: Decoration, light: Light, image_size: tuple[int, int], fov_y_rad: float
) -> Any:
    """Model of a building for cameras, with one camera called ``CAMERA``."""
    builder = _Builder()
    builder.view(light, image_size, fov_y_rad)
    for kind, images in (("wall", decoration.walls), ("floor", decoration.floors)):
        for number, image in enumerate(images):
            builder.material(f"{kind} {number}", image, repeats_per_m=1.0 / _TEXTURE_M)
    for number, image in enumerate(decoration.fronts):
        builder.material(f"front {number}", image, cube=True)
    builder.material("corridor", decoration.corridor_floor, repeats_per_m=1.0 / _TEXTURE_M)
    builder.material("ceiling", decoration.ceiling, repeats_per_m=1.0 / _TEXTURE_M)
    for number, piece in _standing(plan):
        look = "wall" if piece.kind in (PieceKind.WALL, PieceKind.LINTEL) else "front"
        builder.piece(piece, decoration.heights_m[number], f"{look} {decoration.looks[number]}")
    for low, high in _squares(plan.size_m):
        builder.slab(low, high, -0.008, "corridor")
        builder.slab(low, high, WALL_HEIGHT_M + 0.02, "ceiling")
    for room, number in zip(plan.rooms, decoration.room_floors, strict=True):
        builder.slab(room.low, room.high, 0.0, f"floor {number}")
    for number, picture in enumerate(decoration.pictures):
        builder.material(f"picture {number}", picture.image)
        half = (picture.size[0] / 2.0, picture.size[1] / 2.0, 0.008)
        builder.upright(half, picture.centre, picture.heading_rad, f"picture {number}", SEEN)
    builder.lamps(light)
    return builder.compile()


def _squares(size_m: tuple[float, float]) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Corners of squares that cover the floor. Light is computed at the corners of faces, so large faces stay dark."""
    edges = [np.append(np.arange(0.0, size, 2.0 * _TEXTURE_M), size) for size in size_m]
    for (west, east), (south, north) in product(*map(pairwise, edges)):
        yield np.array([west, south]), np.array([east, north])


def _standing(plan: FloorPlan) -> Iterator[tuple[int, Piece]]:
    """Pieces with their numbers, without walls inside other walls, because coincident faces would flicker."""
    boxes = [(piece.outline.min(axis=0), piece.outline.max(axis=0)) for piece in plan.pieces]
    kept: list[int] = []
    walls = [k for k, piece in enumerate(plan.pieces) if piece.kind is PieceKind.WALL]
    for k in sorted(walls, key=lambda k: -float(np.linalg.norm(boxes[k][1] - boxes[k][0]))):
        low, high = boxes[k]
        if not any(np.all(boxes[j][0] < low + 1e-6) and np.all(boxes[j][1] > high - 1e-6) for j in kept):
            kept.append(k)
    left_out = set(walls) - set(kept)
    yield from ((k, piece) for k, piece in enumerate(plan.pieces) if k not in left_out)


class _Builder:
    def __init__(self) -> None:
        self._mujoco = mujoco()
        self._spec = self._mujoco.MjSpec()
        self._world = self._spec.worldbody

    def compile(self) -> Any:
        return self._spec.compile()

    def view(self, light: Light, image_size: tuple[int, int], fov_y_rad: float) -> None:
        """Add the camera and the lights, and set the clipping planes."""
        visual = self._spec.visual
        self._spec.stat.extent = 1.0
        visual.map.znear, visual.map.zfar = 0.05, 100.0
        visual.global_.offwidth, visual.global_.offheight = image_size
        # Antialiasing and finer shading would cost more than everything else.
        visual.quality.offsamples, visual.quality.numquads = 0, 2
        visual.headlight.ambient = light.ambient_rgb
        visual.headlight.diffuse, visual.headlight.specular = (0.08,) * 3, (0.0,) * 3
        self._world.add_camera(name=CAMERA, fovy=math.degrees(fov_y_rad))
        for _ in range(min(LIGHTS, len(light.lamps))):
            self._world.add_light(
                type=self._mujoco.mjtLightType.mjLIGHT_SPOT,
                dir=(0.0, 0.0, -1.0),
                cutoff=90.0,
                exponent=0.0,
                castshadow=False,
                diffuse=light.lamp_rgb,
                ambient=(0.0,) * 3,
                specular=(0.05,) * 3,
                attenuation=(0.6, 0.0, 0.05),
            )

    def material(self, name: str, image: Image, repeats_per_m: float | None = None, cube: bool = False) -> None:
        """Add a material that shows an image: repeated, once on each face of a cube, or once."""
        kinds = self._mujoco.mjtTexture
        height, width = image.shape[:2]
        # Quarter turns of the image on each face of a cube make it upright.
        faces = [np.rot90(image, turns) for turns in (1, -1, 2, 0, 0, 0)] if cube else [image]
        texture = self._spec.add_texture(
            name=name,
            type=kinds.mjTEXTURE_CUBE if cube else kinds.mjTEXTURE_2D,
            width=width,
            height=height * len(faces),
            nchannel=3,
        )
        texture.data = b"".join(face.tobytes() for face in faces)
        material = self._spec.add_material(name=name, specular=0.1, shininess=0.1)
        material.textures[self._mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        if repeats_per_m is not None:
            # MuJoCo counts the repeats per half metre.
            material.texuniform, material.texrepeat = True, (2.0 * repeats_per_m,) * 2

    def piece(self, piece: Piece, height_m: float, material: str) -> None:
        """Add a wall, a lintel, or a piece of furniture."""
        x, y = piece.centre
        if piece.kind is PieceKind.COLUMN:
            kinds = self._mujoco.mjtGeom
            half = (piece.size[0] / 2.0, height_m / 2.0, 0.0)
            self._geom(kinds.mjGEOM_CYLINDER, half, (x, y, height_m / 2.0), (1.0, 0.0, 0.0, 0.0), material, SOLID)
        elif piece.kind is PieceKind.CABINET:
            half = (piece.size[0] / 2.0, piece.size[1] / 2.0, height_m / 2.0)
            turn = (math.cos(piece.heading_rad / 2.0), 0.0, 0.0, math.sin(piece.heading_rad / 2.0))
            self._box(half, (x, y, height_m / 2.0), turn, material, SOLID)
        else:
            (length, thick), heading = piece.size, piece.heading_rad
            if length < thick:
                length, thick, heading = thick, length, heading + math.pi / 2.0
            low = DOOR_HEIGHT_M if piece.kind is PieceKind.LINTEL else 0.0
            # A millimetre shorter, because coplanar faces would flicker.
            half = (length / 2.0 - 0.001, (height_m - low) / 2.0, thick / 2.0)
            group = SEEN if piece.kind is PieceKind.LINTEL else SOLID
            self.upright(half, (x, y, (low + height_m) / 2.0), heading, material, group)

    def upright(
        self,
        half: tuple[float, float, float],
        centre: tuple[float, float, float],
        heading_rad: float,
        material: str,
        group: int,
    ) -> None:
        """Add a box with x along ``heading_rad`` and y up, so that its image is upright."""
        cos, sin = (math.sqrt(0.5) * f(heading_rad / 2.0) for f in (math.cos, math.sin))
        self._box(half, centre, (cos, cos, sin, sin), material, group)

    def slab(self, low: FloatArray, high: FloatArray, top_m: float, material: str) -> None:
        """Add a floor or ceiling between two corners (2,)."""
        (x, y), (half_x, half_y) = (low + high) / 2.0, (high - low) / 2.0
        self._box((half_x, half_y, 0.01), (x, y, top_m - 0.01), (1.0, 0.0, 0.0, 0.0), material, SEEN)

    def lamps(self, light: Light) -> None:
        """Add the lamps as panels under the ceiling."""
        self._spec.add_material(name="lamp", emission=1.0, rgba=(1.0, 0.98, 0.9, 1.0))
        for x, y, _ in light.lamps:
            half = (0.3, 0.15, (WALL_HEIGHT_M - LAMP_HEIGHT_M) / 4.0)
            self._box(half, (x, y, WALL_HEIGHT_M - half[2]), (1.0, 0.0, 0.0, 0.0), "lamp", SEEN)

    def _box(self, half: Any, centre: Any, turn: Any, material: str, group: int) -> None:
        self._geom(self._mujoco.mjtGeom.mjGEOM_BOX, half, centre, turn, material, group)

    def _geom(self, kind: Any, size: Any, centre: Any, turn: Any, material: str, group: int) -> None:
        self._world.add_geom(
            type=kind, size=size, pos=centre, quat=turn, material=material, group=group, contype=0, conaffinity=0
        )
