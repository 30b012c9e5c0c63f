"""Views of the cameras and from the head, of N simulations."""

from collections.abc import Sequence

import numpy as np

from cathsim_dmc.imaging import endoluminal
from cathsim_dmc.physics.effects import Effect, World, of_kind
from cathsim_dmc.physics.motion import Moving
from cathsim_dmc.physics.readings import Readings
from cathsim_dmc.physics.stepper import Stepper
from cathsim_dmc.tasks import observations
from cathsim_dmc.tasks.cameras import KINDS, Cameras
from cathsim_dmc.tasks.case_meshes import CaseMeshes
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.config import NavigationConfig


class Views:
    """Renders the views that observations ask for.

    Attributes:
        wanted: Whether any observation asks for a view.
    """

    def __init__(
        self,
        names: Sequence[str],
        config: NavigationConfig,
        world: World,
        effects: Sequence[Effect],
        cases: Sequence[Case],
    ):
        """Prepares the views for observations of these names.

        Args:
            cases: Anatomies that the simulations may be in.
            effects: All effects, which may change the model of a simulation.

        Raises:
            ValueError: if a camera needs OpenGL, which is disabled.
        """
        names = observations.with_images(names)
        self._size, self._cases = config.endoluminal_size, cases
        self._inside = any(name.startswith("endoluminal") for name in names)
        self._cameras: Cameras | None = None
        if kinds := [kind for kind in KINDS if kind in names]:
            written = {name for effect in effects for name in effect.model_fields}
            moved = of_kind(effects, Moving) is not None
            meshes = CaseMeshes(cases) if moved or len(cases) > 1 else None
            self._cameras = Cameras(world, config.cameras, kinds, written, meshes)
        self.wanted = self._inside or self._cameras is not None
        self._left_out = False

    def open(self) -> None:
        """Starts OpenGL if a camera needs it; the first image does so otherwise.

        Raises:
            ValueError, RuntimeError: as of `Cameras.open`.
        """
        if self._cameras is not None:
            self._cameras.open()

    def leave_out_cameras(self) -> None:
        """Cameras give images of zeros from now on, and do not start OpenGL."""
        self._left_out = True

    def see(
        self,
        rows: np.ndarray,
        case_of: np.ndarray,
        stepper: Stepper,
        readings: Readings,
        moving: Moving | None,
        begun: bool,
    ) -> dict[str, np.ndarray]:
        """Renders the views of some simulations.

        Args:
            rows: (K,) numbers of these simulations, K > 0.
            case_of: (N,) number of the case of each of all N simulations.
            stepper: Stepper of all N simulations.
            readings: State of the devices of all N simulations.
            moving: Effect that moves the vessels; None if they rest.
            begun: Whether an episode has begun. Composer observes at construction too,
                and an environment that has only been made may be forked: its cameras
                give zeros and do not start OpenGL.

        Returns:
            Images (K, ...) by name, see `Cameras.see` and `endoluminal.views`.
        """
        seen: dict[str, np.ndarray] = {}
        if self._cameras is not None and (self._left_out or not begun):
            seen = self._cameras.blank(len(rows))
        elif self._cameras is not None:
            seen = self._cameras.see(rows, case_of, stepper, readings, moving)
        if not self._inside:
            return seen
        grey, distance = endoluminal.views(
            [self._cases[int(case_of[i])].scene.anatomy.lumen for i in rows],
            [moving.warp(i) if moving else endoluminal.AT_REST for i in rows],
            readings.head[rows],
            readings.head_frame[rows],
            self._size,
        )
        return {**seen, "endoluminal": grey, "endoluminal_distance": distance}
