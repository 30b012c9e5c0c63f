"""Pictures of MuJoCo's cameras, which need OpenGL, unlike fluoroscopy."""

import copy
import functools
import os
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import mujoco
import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy import Surface
from cathsim_dmc.imaging.options import VIEW_ANGLE
from cathsim_dmc.physics.effects import World
from cathsim_dmc.physics.motion import Moving
from cathsim_dmc.physics.readings import Readings
from cathsim_dmc.physics.stepper import Stepper
from cathsim_dmc.tasks.render_thread import render_thread

# Two cameras of `scene.Scene`, and one in the head of the device, see `Cameras`.
NAMES = ("top", "side", "tip")
KINDS = ("rgb", "depth")  # names of observations
# Near and far clipping plane, m: a wall that the head touches is a radius of the device
# away, and the top view 0.7 m.
NEAREST, FARTHEST = 0.3e-3, 10.0
_EXTENT = 1.0  # m, of the drawn model: the unit of `znear` and `zfar`
# Values of MUJOCO_GL with which MuJoCo loads no OpenGL.
_DISABLED = ("disable", "disabled", "off", "false", "0")
# Fields of the model that, with `qpos`, decide how bodies are drawn; and those that
# decide from where, which several anatomies set themselves.
_DRAWN = frozenset(
    {"body_pos", "body_quat", "jnt_pos", "jnt_axis", "mat_rgba"}
    | {"geom_pos", "geom_quat", "geom_size", "geom_rgba"}
    | {"light_pos", "light_dir", "light_diffuse"}
)
_AIMED = frozenset({"cam_pos", "cam_quat", "cam_fovy"})
_OUT_OF_SIGHT = 1e3  # m; a transparent geom would still be in the depth image


@dataclass(frozen=True)
class CameraOptions:
    """Options of the observations `rgb` and `depth`.

    Attributes:
        names: names of the cameras: "top", the published view; "side"; "tip", an
            endoscope.
        size: pixels along a side of the image, or (rows, columns).
    """

    names: Sequence[str] = ("top",)
    size: Any = (128, 128)

    def __post_init__(self):
        named = [self.names] if isinstance(self.names, str) else self.names
        listed = isinstance(named, Sequence) and len(set(map(str, named))) == len(named)
        if not listed or not named or any(name not in NAMES for name in named):
            allowed = f"different ones of {', '.join(NAMES)}"
            bounds.refuse("names of cameras", self.names, allowed)
        size = bounds.pixels("size of cameras", self.size)
        vars(self).update(names=tuple(named), size=size)


class Meshes(Protocol):
    """Shows anatomies in a model, see `case_meshes.CaseMeshes`."""

    def compiled(self, simulated: mujoco.MjModel) -> mujoco.MjModel: ...  # noqa: D102
    def enter(self, model: mujoco.MjModel, number: int) -> None: ...  # noqa: D102
    def draw(self, model: mujoco.MjModel, number: int) -> None: ...  # noqa: D102
    def reshape(  # noqa: D102
        self, model: mujoco.MjModel, number: int, surface: Surface
    ) -> int: ...


class Cameras:
    """MuJoCo's cameras of one compiled model, with their own OpenGL context.

    They render the pose of `qpos` and of mocap bodies, so composer and batches give the
    same images. The endoscope "tip" looks ahead from the head of the device and does
    not show it.
    """

    _renderer: Any = None
    _close: Callable[[], None] | None = None  # frees the context

    def __init__(
        self,
        world: World,
        options: CameraOptions,
        kinds: Sequence[str],
        written: Collection[str],
        meshes: "Meshes | None" = None,
    ):
        """Prepares the model; the first image opens the context, or `open`.

        Args:
            kinds: Kinds of images, of `KINDS`.
            written: Fields of the model that differ between simulations.
            meshes: Meshes of several anatomies, or of vessels that move; None for one
                anatomy at rest.

        Raises:
            ValueError: if OpenGL is disabled.
        """
        if os.environ.get("MUJOCO_GL", "").lower().strip() in _DISABLED:
            raise ValueError(_no_opengl("it is disabled"))
        self._size = options.size
        self._names, self._written = options.names, _DRAWN.intersection(written)
        self._kinds = tuple(kinds)
        self._links = set(world.index.geoms.tolist())
        self._simulated, self._meshes = world.model, meshes
        self._number: int | None = None  # of the anatomy that is shown
        if meshes is None:
            self._take(copy.copy(world.model))

    def _take(self, model: mujoco.MjModel) -> None:
        """Takes the model that is drawn."""
        rows, columns = self._size
        self._model = model
        model.vis.global_.offheight, model.vis.global_.offwidth = rows, columns
        model.stat.extent = _EXTENT
        model.vis.map.znear, model.vis.map.zfar = NEAREST, FARTHEST
        self._data, self._options = mujoco.MjData(model), mujoco.MjvOption()
        self._options.sitegroup[:] = 0

    def open(self) -> None:
        """Opens the context, if it is not open; a process is not to be forked then.

        Raises:
            ValueError: if OpenGL does not start.
            RuntimeError: if the process was forked from one that has rendered.
        """
        thread = render_thread()
        if self._renderer is not None:
            return
        if self._meshes is not None:
            self._take(self._meshes.compiled(self._simulated))
        try:
            self._renderer = thread.run(lambda: thread.open(self._model, self._size))
        except Exception as error:  # each back end fails in its own way
            message = _no_opengl(f"{type(error).__name__}: {error}")
            raise ValueError(message) from error
        self._close = functools.partial(thread.close, self._renderer)

    def __del__(self):
        if self._close is not None:
            self._close()

    def see(
        self,
        indices: np.ndarray,
        case_of: np.ndarray,
        stepper: Stepper,
        readings: Readings,
        moving: Moving | None = None,
    ) -> dict[str, np.ndarray]:
        """Pictures of some simulations (K,).

        Args:
            indices: Numbers of these simulations.
            case_of: (N,) number of the anatomy of each of all N simulations.
            stepper: Stepper of all N simulations.
            readings: State of the devices of all N simulations.
            moving: Effect that moves the vessels; None if they rest.

        Returns:
            "rgb": (K, rows, columns, 3 C) uint8 of C cameras; "depth": (K, rows,
            columns, C) float32, m.

        Raises:
            ValueError, RuntimeError: as of `open`.
        """
        self.open()
        seen = render_thread().run(
            lambda: [
                self._see(index, int(case_of[index]), stepper, readings, moving)
                for index in indices
            ]
        )
        return {kind: np.stack([one[kind] for one in seen]) for kind in self._kinds}

    def blank(self, count: int) -> dict[str, np.ndarray]:
        """Pictures of zeros of K = `count` simulations; see `see`."""
        size, cameras = (count, *self._size), len(self._names)
        kinds = {
            "rgb": np.zeros((*size, 3 * cameras), np.uint8),
            "depth": np.zeros((*size, cameras), np.float32),
        }
        return {kind: kinds[kind] for kind in self._kinds}

    def _see(
        self,
        index: int,
        number: int,
        stepper: Stepper,
        readings: Readings,
        moving: Moving | None,
    ) -> dict[str, np.ndarray]:
        """Pictures of one simulation, which is in the anatomy of a number."""
        meshes, anew = self._meshes, number != self._number
        if meshes is not None and anew:
            meshes.enter(self._model, number)
            self._model.stat.extent = _EXTENT
            self._number = number
        written = self._written
        if stepper.has_hooks:
            written = _DRAWN if meshes is not None else _DRAWN | _AIMED
        for name in written:
            getattr(self._model, name)[:] = stepper.field(index, name)
        if meshes is not None and (anew or written):
            meshes.draw(self._model, number)
        if meshes is not None and moving is not None:
            mesh = meshes.reshape(self._model, number, moving.surface(index))
            render_thread().upload(self._renderer, self._model, mesh)
        self._data.qpos[:] = stepper.arrays.qpos[index]
        if self._model.nmocap:
            state = stepper.states(np.array([index]))[0]
            mujoco.mj_setState(
                self._model, self._data, state, mujoco.mjtState.mjSTATE_INTEGRATION
            )
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        seen: dict[str, list[np.ndarray]] = {kind: [] for kind in self._kinds}
        for name in self._names:
            self._aim(name, readings.head[index], readings.head_frame[index])
            for kind, pictures in seen.items():
                if kind == "depth":
                    self._renderer.enable_depth_rendering()
                pictures.append(np.atleast_3d(self._renderer.render()))
                self._renderer.disable_depth_rendering()
        return {kind: np.concatenate(each, axis=-1) for kind, each in seen.items()}

    def _aim(self, name: str, head: np.ndarray, axes: np.ndarray) -> None:
        """Updates the scene for a camera; "tip" has x of the head right and y down."""
        model, data, inside = self._model, self._data, name == "tip"
        camera = model.camera(NAMES[0] if inside else name)
        if inside:  # moves the top camera, whose pose is restored below
            kept = data.cam_xpos[camera.id].copy(), data.cam_xmat[camera.id].copy()
            angle = float(model.cam_fovy[camera.id])
            data.cam_xpos[camera.id], model.cam_fovy[camera.id] = head, VIEW_ANGLE
            # A camera looks along its -z.
            data.cam_xmat[camera.id] = (axes * (1.0, -1.0, -1.0)).ravel()
        self._renderer.update_scene(data, camera.id, self._options)
        if inside:
            data.cam_xpos[camera.id], data.cam_xmat[camera.id] = kept
            model.cam_fovy[camera.id] = angle
        scene = self._renderer.scene
        # From inside, the wall is opaque and seen from behind.
        scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = not inside
        for geom in scene.geoms[: scene.ngeom] if inside else ():
            geom.rgba[3] = 1.0
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.objid in self._links:
                geom.pos[:] = _OUT_OF_SIGHT
        for light in scene.lights[: scene.nlight] if inside else ():
            if light.headlight:  # OpenGL lights the outside of the wall
                light.dir[:] *= -1.0
            else:  # the ceiling of the room
                light.diffuse[:] = 0.0


def _no_opengl(reason: str) -> str:
    """What to do without OpenGL, as the message of an error."""
    chosen = os.environ.get("MUJOCO_GL") or "not set"
    return (
        f"the observations rgb and depth need OpenGL, which does not start here "
        f"(MUJOCO_GL is {chosen}: {reason}). Set MUJOCO_GL to egl (a GPU, or Mesa's "
        "software), osmesa (software) or glfw (with a display) before Python starts, "
        "or observe image or segmentation, which need no OpenGL"
    )
