"""Pictures of MuJoCo's cameras, which need OpenGL, unlike fluoroscopy."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence

import mujoco
import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.imaging.options import VIEW_ANGLE

CAMERAS = ("top", "side", "tip")
KINDS = ("rgb", "depth")

# A chip-on-tip endoscope: wide angle, in the middle of the rounded end of the device,
# so that a wall which the tip touches is still in front of it.
# That wall is a device radius away; MuJoCo's default clips it at centimetres.
NEAREST = 0.3e-3  # m
FARTHEST = 10.0  # m, the top view stands 0.7 m away

# A geom without opacity would still be in the depth image.
_OUT_OF_SIGHT = 1e3  # m

_SITE_GROUPS = (4, 5)


@dataclasses.dataclass(frozen=True)
class CameraOptions:
    """Which cameras `rgb` and `depth` show, and the size of endoluminal views.

    Attributes:
        names: of `CAMERAS`: "top" as published, "side", and "tip", an endoscope.
        size: pixels along a side of the image, or (rows, columns).
    """

    names: Sequence[str] = ("top",)
    size: int | Sequence[int] = 128

    def __post_init__(self):
        names = (self.names,) if isinstance(self.names, str) else self.names
        if not isinstance(names, Sequence):
            bounds.refuse("camera names", names, f"some of {', '.join(CAMERAS)}")
        names = tuple(names)
        object.__setattr__(self, "names", names)
        unknown = [name for name in names if name not in CAMERAS]
        if unknown or not names or len(set(names)) < len(names):
            raise ValueError(
                f"camera names are {self.names!r}; give different ones of "
                f"{', '.join(CAMERAS)}"
            )
        object.__setattr__(self, "size", bounds.pixels("camera size", self.size))

    @property
    def resolution(self) -> tuple[int, int]:
        """(rows, columns)."""
        rows, columns = bounds.pixels("camera size", self.size)
        return rows, columns


def add_tip_camera(arena, catheter) -> None:
    """Adds the endoscope "tip" to the last link, before the model is compiled."""
    arena.mjcf_model.visual.map.znear = NEAREST
    arena.mjcf_model.visual.map.zfar = FARTHEST
    # Near and far planes are in units of the extent.
    arena.mjcf_model.statistic.extent = 1.0
    catheter.links[-1].add(
        "camera",
        name="tip",
        pos=(0, 0, catheter.link_lengths[-1]),
        xyaxes=(1, 0, 0, 0, -1, 0),  # a camera looks along its -z
        fovy=VIEW_ANGLE,
    )


class Cameras:
    """The cameras of a compiled model, on one off-screen context.

    They look at the configuration itself, not at the simulator's derived quantities,
    so composer and the batched path see the same.
    """

    def __init__(self, model: mujoco.MjModel, options: CameraOptions, catheter: str):
        """Opens the context.

        Args:
            catheter: MJCF scope of the catheter, which carries the endoscope.

        Raises:
            ValueError: if there is no OpenGL here.
        """
        rows, columns = options.resolution
        model.vis.global_.offheight = max(rows, model.vis.global_.offheight)
        model.vis.global_.offwidth = max(columns, model.vis.global_.offwidth)
        self._model, self._data = model, mujoco.MjData(model)
        self._cameras = {
            name: model.camera(f"{catheter}/tip" if name == "tip" else name).id
            for name in options.names
        }
        self._device = [
            i for i in range(model.ngeom) if model.geom(i).name.startswith(catheter)
        ]
        self._renderer = _renderer(model, rows, columns)
        self._options = mujoco.MjvOption()
        for group in _SITE_GROUPS:
            self._options.sitegroup[group] = 0

    def __del__(self):
        # MuJoCo frees the textures and buffers of whatever context is current, which
        # may be that of other cameras.
        renderer = getattr(self, "_renderer", None)
        if renderer is None:
            return
        context = renderer._gl_context  # noqa: SLF001
        if context is not None:
            context.make_current()
            renderer.close()

    def see(self, kinds: Sequence[str], qpos: np.ndarray) -> dict[str, np.ndarray]:
        """Pictures of N configurations.

        Args:
            qpos: (N, nq).

        Returns:
            "rgb_<camera>": (N, rows, columns, 3) uint8; "depth_<camera>": (N, rows,
            columns, 1) float32, m.
        """
        pictures: dict[str, list[np.ndarray]] = {}
        for row in qpos:
            self._data.qpos[:] = row
            mujoco.mj_kinematics(self._model, self._data)
            mujoco.mj_camlight(self._model, self._data)
            for kind in kinds:
                for name, camera in self._cameras.items():
                    picture = self._picture(kind, camera, name)
                    pictures.setdefault(f"{kind}_{name}", []).append(picture)
        return {key: np.stack(rows) for key, rows in pictures.items()}

    def _picture(self, kind: str, camera: int, name: str) -> np.ndarray:
        renderer = self._renderer
        renderer.update_scene(self._data, camera, self._options)
        # From inside, the wall is opaque, its back faces are drawn and the device,
        # in which the camera is, does not hide it.
        inside = name == "tip"
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = not inside
        if inside:
            for geom in renderer.scene.geoms[: renderer.scene.ngeom]:
                geom.rgba[3] = 1.0
                if geom.objid in self._device:
                    geom.pos[:] = _OUT_OF_SIGHT
        if kind == "rgb":
            return renderer.render()
        renderer.enable_depth_rendering()
        try:
            return renderer.render()[..., None]
        finally:
            renderer.disable_depth_rendering()


def _renderer(model: mujoco.MjModel, rows: int, columns: int) -> mujoco.Renderer:
    try:
        return mujoco.Renderer(model, rows, columns)
    except Exception as error:  # every backend fails in its own way
        chosen = os.environ.get("MUJOCO_GL", "not set")
        raise ValueError(
            f"the observations rgb and depth need OpenGL, which does not start here "
            f"(MUJOCO_GL is {chosen}: {type(error).__name__}: {error}). Set MUJOCO_GL "
            "to egl (with a GPU), osmesa (software) or glfw (with a display) before "
            "Python starts, or observe image or segmentation, which need no OpenGL."
        ) from error
