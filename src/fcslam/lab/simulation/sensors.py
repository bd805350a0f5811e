"""A LiDAR and a camera in a MuJoCo model. Only the camera needs a GL library."""

import math
from types import TracebackType
from typing import Any

import numpy as np

from fcslam.geometry import se2
from fcslam.lab.simulation.decoration import Light
from fcslam.lab.simulation.engine import GL_LOCK, gl_context, mujoco
from fcslam.lab.simulation.scene import SEEN, SOLID
from fcslam.lab.simulation.textures import Image
from fcslam.records import CameraModel, FloatArray, LaserModel

LASER_HEIGHT_M = 0.25
_UNSEEN = SEEN + 1
"""Group of geoms that are not drawn."""


class RayCaster:
    """Casts beams."""

    def __init__(self, model: Any) -> None:
        self._mujoco = mujoco()
        self._model = model
        self._data = self._mujoco.MjData(model)
        self._mujoco.mj_forward(model, self._data)
        self._groups = np.zeros(6, dtype=np.uint8)
        self._groups[SOLID] = 1

    def cast(self, T_building_base: FloatArray, laser: LaserModel) -> FloatArray:
        """Ranges (beam_count,) in metres without noise; ``max_range_m`` without a hit.

        The pose (3,) of the robot, or its poses at each beam, shape (beam_count, 3).
        """
        x, y, heading = se2.compose(T_building_base, np.array(laser.T_base_laser)).T
        angles = heading + laser.angles_rad()
        directions = np.column_stack((np.cos(angles), np.sin(angles), np.zeros_like(angles)))
        count, far = laser.beam_count, laser.max_range_m
        hits, distances = np.empty(count, dtype=np.int32), np.empty(count)
        if T_building_base.ndim > 1:
            origins = np.column_stack((x, y, np.full(count, LASER_HEIGHT_M)))
            for k in range(count):
                distances[k] = self._mujoco.mj_ray(
                    self._model, self._data, origins[k], directions[k], self._groups, True, -1, hits[:1]
                )
        else:
            self._mujoco.mj_multiRay(
                self._model,
                self._data,
                np.array([x, y, LASER_HEIGHT_M]),
                directions.ravel(),
                self._groups,
                True,
                -1,
                hits,
                distances,
                None,
                count,
                far,
            )
        return np.where(distances < 0.0, far, np.minimum(distances, far))

    def scan(self, T_building_base: FloatArray, laser: LaserModel, rng: np.random.Generator) -> FloatArray:  # noqa: ARG002
        """The ranges of a scan without noise, which in a building are those of ``cast``."""
        return self.cast(T_building_base, laser)


class Camera:
    """Renders images of the model's camera; close it, or use it in a ``with``."""

    def __init__(self, model: Any, camera: CameraModel, light: Light) -> None:
        self._mujoco = mujoco()
        self._model, self._camera, self._lamps = model, camera, light.lamps
        with GL_LOCK:
            self._gl = gl_context(camera.width, camera.height)
            self._context = self._mujoco.MjrContext(model, self._mujoco.mjtFontScale.mjFONTSCALE_100.value)
            self._mujoco.mjr_setBuffer(self._mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._data = self._mujoco.MjData(model)
        self._mujoco.mj_forward(model, self._data)
        self._scene = self._mujoco.MjvScene(model, maxgeom=model.ngeom + 10)
        self._scene.flags[self._mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._scene.flags[self._mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._scene.flags[self._mujoco.mjtRndFlag.mjRND_SKYBOX] = False
        self._option = self._mujoco.MjvOption()
        self._view = self._mujoco.MjvCamera()
        self._view.type, self._view.fixedcamid = self._mujoco.mjtCamera.mjCAMERA_FIXED, 0
        self._option.geomgroup[_UNSEEN] = 0
        self._T_base_optical = _matrix(camera)
        self._sides = _sides(camera)

    def take(self, T_building_base: FloatArray) -> Image:
        """Render the image (height, width, 3), RGB, at the robot's pose (3,)."""
        x, y, heading = T_building_base
        cos, sin = math.cos(heading), math.sin(heading)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        position = turn @ self._T_base_optical[:3, 3] + [x, y, 0.0]
        # MuJoCo's cameras look along -z with y up.
        rotation = turn @ self._T_base_optical[:3, :3] @ np.diag([1.0, -1.0, -1.0])
        self._data.cam_xpos[0], self._data.cam_xmat[0] = position, rotation.ravel()
        self._leave_out_unseen(position, turn @ self._T_base_optical[:3, :3])
        nearest = np.argsort(np.linalg.norm(self._lamps - position, axis=1))
        for number in range(self._model.nlight):
            self._data.light_xpos[number] = self._lamps[nearest[number]]
        everything = self._mujoco.mjtCatBit.mjCAT_ALL.value
        self._mujoco.mjv_updateScene(self._model, self._data, self._option, None, self._view, everything, self._scene)
        frame = self._mujoco.MjrRect(0, 0, self._camera.width, self._camera.height)
        pixels = np.empty((self._camera.height, self._camera.width, 3), dtype=np.uint8)
        with GL_LOCK:
            self._gl.make_current()
            self._mujoco.mjr_render(frame, self._scene, self._context)
            self._mujoco.mjr_readPixels(pixels, None, frame, self._context)
        return np.ascontiguousarray(pixels[::-1])

    def _leave_out_unseen(self, position: FloatArray, rotation: FloatArray) -> None:
        """Exclude geoms outside the field of view from rendering, because MuJoCo has no frustum culling."""
        offsets = (self._data.geom_xpos - position) @ rotation
        seen = np.all(offsets @ self._sides.T > -self._model.geom_rbound[:, None], axis=1)
        self._model.geom_group[:] = np.where(seen, SEEN, _UNSEEN)

    def close(self) -> None:
        """Free the GL resources."""
        with GL_LOCK:
            self._gl.make_current()
            self._context.free()
            self._gl.free()

    def __enter__(self) -> "Camera":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _matrix(camera: CameraModel) -> FloatArray:
    """``T_base_camera`` as a matrix (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = camera.T_base_camera.rotation_matrix()
    matrix[:3, 3] = camera.T_base_camera.translation_m
    return matrix


def _sides(camera: CameraModel) -> FloatArray:
    """Inward normals (4, 3) of the sides of the view frustum, in the optical frame."""
    right, down = math.atan(0.5 * camera.width / camera.fx), math.atan(0.5 * camera.height / camera.fy)
    sideways = [(sign * math.cos(right), 0.0, math.sin(right)) for sign in (-1.0, 1.0)]
    upwards = [(0.0, sign * math.cos(down), math.sin(down)) for sign in (-1.0, 1.0)]
    return np.array(sideways + upwards)
