"""Fluoroscopy in a plain window, without OpenGL."""

import dataclasses
import time
from typing import Any

import numpy as np

from cathsim_dmc import files
from cathsim_dmc.imaging import angiograph
from cathsim_dmc.play.controls import Controls

SIZE = 512  # px

# X repeats a held key as release and press. A release counts if no press follows
# within this time, s.
_REPEAT = 0.06
_PANEL = 230  # px
# Colours of the bar of the largest contact, N: mean tip force of trained navigation,
# budget of safe learning, and proposed threshold of rupture, where the bar ends.
FORCE_LEVELS = ((0.15, "green"), (0.85, "orange"), (1.5, "red"))


class FluoroscopyWindow:
    """Shows fluoroscopy and forces of a task; passes keys on to the controls.

    Attributes:
        closed: Whether the operator has closed the window.
    """

    closed = False

    def __init__(self, task: Any, controls: Controls):
        """Opens the window.

        Args:
            task: Navigation task; its fluoroscopy options are used, with as many
                pixels as the window has and with quantum noise.
            controls: Controls that receive the keys.

        Raises:
            ValueError: if there is no Tk or no display.
        """
        text = "the fluoroscopy window needs tkinter; install your system's python3-tk"
        with files.refused(ValueError, text, ImportError):
            import tkinter as tk
        text = "no window can be opened; set DISPLAY, or run under xvfb-run"
        with files.refused(ValueError, text, tk.TclError):
            root = tk.Tk(className="cathsim")
        self._tk, self._root, self._controls = tk, root, controls
        self._random = np.random.RandomState(0)
        self._released: dict[str, float] = {}
        self._case: Any = None
        planes = self._planes(task)
        rows, columns = planes[0].carm.resolution
        width = columns * len(planes)
        root.configure(background="black")
        root.resizable(False, False)
        root.protocol("WM_DELETE_WINDOW", lambda: setattr(self, "closed", True))
        look: Any = {"height": rows, "highlightthickness": 0}
        self._screen = tk.Canvas(root, width=width, **look)
        self._screen.grid(row=0, column=0)
        self._panel = tk.Canvas(root, width=_PANEL, background="black", **look)
        self._panel.grid(row=0, column=1)
        look = {"foreground": "grey70", "background": "black"}
        label = tk.Label(root, text=controls.help, wraplength=width + _PANEL, **look)
        label.grid(row=1, column=0, columnspan=2)
        root.bind("<KeyPress>", self._pressed)
        root.bind("<KeyRelease>", self._let_go)
        root.update()
        root.focus_force()

    def _pressed(self, event):
        key = _name(event.keysym)
        self._released.pop(key, None)
        self._controls.press(key)

    def _let_go(self, event):
        self._released[_name(event.keysym)] = time.monotonic()

    def poll(self) -> None:
        """Reads the keys since the last call, and the gamepad or SpaceMouse."""
        self._root.update()
        self._controls.poll()
        for key, when in list(self._released.items()):
            if time.monotonic() - when > _REPEAT:
                self._controls.release(key)
                del self._released[key]

    def show(self, task: Any, message: str = "", until: float = 0.0) -> None:
        """Draws the state of a task; reads keys until a time of `time.monotonic`, s."""
        planes = self._planes(task)
        machine = task.rollout.around(planes)
        images = angiograph.images([machine], task.rollout.shadows, [self._random])
        image = np.concatenate(list(np.moveaxis(images[0], -1, 0)), axis=1)
        rows, columns = image.shape
        data = b"P5 %d %d 255 " % (columns, rows) + image.tobytes()
        self._image = self._tk.PhotoImage(data=data, format="PPM", master=self._root)
        self._screen.delete("all")
        self._screen.create_image(0, 0, image=self._image, anchor="nw")
        for number, plane in enumerate(planes):
            (x, y), depth = plane.carm.project(task.goal_position)
            x += number * columns / len(planes)
            radius = task.objective.goal_radius * plane.carm.focal_length / float(depth)
            box = x - radius, y - radius, x + radius, y + radius
            self._screen.create_oval(box, outline="green2")
        self._panel.delete("all")
        force, (most, colour) = float(task.wall_force.mean_max), FORCE_LEVELS[-1]
        colour = next((c for level, c in FORCE_LEVELS if force <= level), colour)
        for share, fill in ((1.0, "grey20"), (min(force / most, 1.0), colour)):
            box = 14, rows - 30, 14 + share * (_PANEL - 28), rows - 14
            self._panel.create_rectangle(*box, fill=fill, width=0)
        for row, (name, value) in enumerate([*lines_of(task), (message, "")]):
            y, write = 24 * (row + 1), self._panel.create_text
            write(14, y, text=name, fill="grey70", anchor="w")
            write(_PANEL - 14, y, text=value, fill="white", anchor="e")
        self.poll()
        while (left := until - time.monotonic()) > 0:
            time.sleep(min(left, 0.005))
            self.poll()

    def close(self) -> None:
        """Closes the window."""
        self._root.destroy()

    def _planes(self, task: Any) -> angiograph.Planes:
        """Returns the planes of the present episode, as a policy sees them."""
        case = task.rollout.case()
        if case is not self._case:
            self._case, options = case, case.fluoroscopy
            rows, columns = options.resolution
            factor = max(1, round(SIZE / max(rows, columns)))
            size = rows * factor, columns * factor
            self._machine = angiograph.Angiograph(
                case.scene.anatomy.surface, dataclasses.replace(options, size=size)
            )
        return self._machine.planes(task.rollout.deviations[0])


def _name(keysym: str) -> str:
    return keysym.lower() if len(keysym) == 1 else keysym


def lines_of(task: Any) -> list[tuple[str, str]]:
    """Returns the names and values of the panel, after a control step or a reset."""
    state, wall, devices = task.readings, task.wall_force, task.devices
    lines = [
        ("goal", task.scene.goal.name),
        ("distance", _millimetres(np.linalg.norm(state.head - task.goal_position))),
    ]
    if devices is None:
        lines.append(("inserted", _millimetres(state.insertion)))
    else:
        for k, name in enumerate(task.scene.catheter.device_names):
            lines.append((name, _millimetres(devices.insertion[k])))
            lines.append(("turned", f"{np.degrees(devices.rotation[k]):5.0f}°"))
    forces = {
        "push force": state.push_force,
        "wall force, sum": wall.mean_sum,
        "largest contact": wall.mean_max,
        f"peak of {1e3 * task.config.physics_timestep:g} ms steps": wall.peak_max,
    }
    # Adding 0.0 turns -0.0 into 0.0.
    texts = {n: f"{round(float(f), 3) + 0.0:6.3f} N" for n, f in forces.items()}
    return [*lines, *texts.items()]


def _millimetres(way: Any) -> str:
    return f"{float(way) * 1e3:5.1f} mm"
