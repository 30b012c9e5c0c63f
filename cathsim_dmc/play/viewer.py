"""The task in MuJoCo's own viewer, which needs OpenGL and a display."""

import threading
from typing import Any

import mujoco
import numpy as np

from cathsim_dmc.play import readout
from cathsim_dmc.play.controls import CoaxialControls, Controls

# GLFW's codes by command. The viewer has letters and space for itself, so the keys
# are those it leaves alone.
KEYS = {
    266: "push",  # page up
    267: "pull",  # page down
    262: "right",
    263: "left",
    265: "up",
    264: "down",
    268: "turn_left",  # home
    269: "turn_right",  # end
    261: "straight",  # delete
    257: "restart",  # enter
}
HELP = (
    "arrows: bend the tip   page up/down: push/pull\n"
    "home/end: rotate   delete: straighten   enter: again\nclose the window to quit"
)
COAXIAL_HELP = (
    "up/down: push/pull the guidewire   left/right: rotate it\n"
    "page up/down: push/pull the catheter   home/end: rotate it   enter: again\n"
    "close the window to quit"
)
# The viewer reports presses and no releases, so a press counts for a moment, s.
_HOLD = 0.2
_PATIENCE = 5.0  # s, for the viewer's thread to end


class MujocoViewer:
    """Shows the task in three dimensions and turns keys into commands."""

    def __init__(self, task: Any, controls: Controls | CoaxialControls):
        """Prepares; the window opens with the first `show`."""
        self._controls = controls
        coaxial = isinstance(controls, CoaxialControls)
        self._help = COAXIAL_HELP if coaxial else HELP
        self._focus = np.array(task.scene.placement.inlet + task.goal_position) / 2
        self._size = float(
            np.linalg.norm(task.goal_position - task.scene.placement.inlet)
        )
        self._viewer = self._model = None
        self._threads: set[threading.Thread] = set()
        # Keys arrive on the viewer's own thread.
        self._lock = threading.Lock()
        self._pressed: list[str] = []

    def open(self, physics: Any) -> None:
        """Opens the window on a simulation.

        Raises:
            ValueError: if there is no OpenGL or no display.
        """
        model, data = physics.model.ptr, physics.data.ptr
        if self._model is model:
            return
        self.close()
        others = set(threading.enumerate())
        try:
            import mujoco.viewer

            self._viewer = mujoco.viewer.launch_passive(
                model,
                data,
                key_callback=self._key,
                show_left_ui=False,
                show_right_ui=False,
            )
        except Exception as error:  # GLFW and GL fail in their own ways
            raise ValueError(
                f"the MuJoCo viewer does not open ({error}); it needs a display and "
                "OpenGL. Play with mode='fluoroscopy', which needs no OpenGL."
            ) from error
        self._model = model
        self._threads = set(threading.enumerate()) - others
        camera = self._viewer.cam
        camera.lookat[:] = self._focus
        camera.distance = 2.2 * self._size
        # From the front: the patient's left is on the right.
        camera.azimuth, camera.elevation = 90.0, 0.0

    def _key(self, code: int):
        command = KEYS.get(code)
        if command is not None:
            with self._lock:
                self._pressed.append(command)

    @property
    def closed(self) -> bool:
        """Whether the operator has closed the window."""
        return self._viewer is not None and not self._viewer.is_running()

    def poll(self) -> None:
        """Reads the keys pressed since the last call."""
        with self._lock:
            pressed, self._pressed = self._pressed, []
        for command in pressed:
            self._controls.press(command, _HOLD)

    def show(self, task: Any, message: str = "") -> None:
        """Draws the state of a task."""
        if self._viewer is None or self.closed:
            return
        names, values = zip(*readout.lines(task), strict=True)
        font, grid = mujoco.mjtFontScale.mjFONTSCALE_150, mujoco.mjtGridPos
        self._viewer.set_texts(
            [
                (font, grid.mjGRID_TOPLEFT, "\n".join(names), "\n".join(values)),
                (font, grid.mjGRID_BOTTOMLEFT, message or self._help, ""),
            ]
        )
        self._viewer.sync()

    def close(self) -> None:
        """Closes the window."""
        if self._viewer is not None:
            self._viewer.close()
            # GLFW must not be shut down, as at the end of Python, while they draw.
            for thread in self._threads:
                thread.join(_PATIENCE)
        self._viewer = self._model = None
