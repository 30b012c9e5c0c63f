"""Fluoroscopy in a plain window, without OpenGL."""

import dataclasses
import time
from typing import Any

import numpy as np

from cathsim_dmc.imaging import angiograph
from cathsim_dmc.play.controls import CoaxialControls, Controls

TITLE = "cathsim"
SIZE = 512  # px

# Keys of Tk by command.
KEYS = {
    "w": "push",
    "s": "pull",
    "Right": "right",
    "Left": "left",
    "Up": "up",
    "Down": "down",
    "a": "turn_left",
    "d": "turn_right",
    "space": "straight",
    "r": "restart",
    "Escape": "quit",
}
# X repeats a held key as release and press; a release counts if none follows in, s:
_REPEAT = 0.06
# Colours of the force bar: mean tip force of trained navigation, the budget of safe
# learning and the proposed rupture threshold, N.
FORCE_LEVELS = ((0.15, "green"), (0.85, "orange"), (1.5, "red"))
_BAR_FORCE = FORCE_LEVELS[-1][0]  # N at the end of the bar
_PANEL = 230  # px


class FluoroscopyWindow:
    """Shows the task as an operator sees it and turns keys into commands."""

    def __init__(self, task: Any, controls: Controls | CoaxialControls):
        """Opens the window.

        Args:
            task: a navigation task; its fluoroscopy options are used, with as many
                pixels as the window has and with quantum noise.
            controls: that the keys act on.

        Raises:
            ValueError: if there is no Tk or no display.
        """
        try:
            import tkinter
        except ImportError as error:
            raise ValueError(
                "the fluoroscopy window needs tkinter; install your system's python3-tk"
            ) from error
        self._controls = controls
        try:
            self._root = tkinter.Tk(className=TITLE)
        except tkinter.TclError as error:
            raise ValueError(
                f"no window can be opened ({error}); set DISPLAY, or run under xvfb-run"
            ) from error
        self._tk = tkinter
        self._machine = _machine(task)
        self._random = np.random.RandomState(0)
        self._released: dict[str, float] = {}
        self.closed = False
        self._build(self._machine[0].carm.resolution, len(self._machine))

    def _build(self, resolution: tuple[int, int], planes: int):
        tk, root = self._tk, self._root
        root.title(TITLE)
        root.configure(background="black")
        root.resizable(False, False)
        root.protocol("WM_DELETE_WINDOW", self._close)
        rows, columns = resolution
        self._screen = tk.Canvas(
            root, width=columns * planes, height=rows, highlightthickness=0
        )
        self._screen.grid(row=0, column=0)
        panel = tk.Canvas(
            root, width=_PANEL, height=rows, background="black", highlightthickness=0
        )
        panel.grid(row=0, column=1)
        self._panel = panel
        tk.Label(
            root,
            text=self._controls.help,
            foreground="grey70",
            background="black",
            wraplength=columns * planes + _PANEL,
        ).grid(row=1, column=0, columnspan=2)
        root.bind("<KeyPress>", self._pressed)
        root.bind("<KeyRelease>", self._let_go)
        root.update()
        root.focus_force()

    def _pressed(self, event):
        command = KEYS.get(_name(event.keysym))
        if command is not None:
            self._released.pop(command, None)
            self._controls.press(command)

    def _let_go(self, event):
        command = KEYS.get(_name(event.keysym))
        if command is not None:
            self._released[command] = time.monotonic()

    def _close(self):
        self.closed = True

    def poll(self) -> None:
        """Reads the keys pressed since the last call."""
        self._root.update()
        for command, when in list(self._released.items()):
            if time.monotonic() - when > _REPEAT:
                self._controls.release(command)
                del self._released[command]

    def show(self, task: Any, message: str = "") -> None:
        """Draws the state of a task."""
        planes = angiograph.images(
            [task.rollout.around(self._machine)],
            task.rollout.shadows,
            [self._random],
        )[0]
        image = np.concatenate(list(np.moveaxis(planes, -1, 0)), axis=1)
        rows, columns = image.shape
        data = b"P5 %d %d 255 " % (columns, rows) + image.tobytes()
        self._image = self._tk.PhotoImage(data=data, format="PPM", master=self._root)
        self._screen.delete("all")
        self._screen.create_image(0, 0, image=self._image, anchor="nw")
        self._draw_goal(task, columns // len(self._machine))
        self._draw_panel(task, message)
        self._root.update()

    def _draw_goal(self, task, width: int):
        """A ring where the goal is, in every plane."""
        places = angiograph.pixels([self._machine], task.goal_position[None, None])
        for plane, fluoroscope in enumerate(self._machine):
            carm = fluoroscope.carm
            _, depth = carm.project(task.goal_position)
            radius = task.objective.goal_radius * carm.focal_length / float(depth)
            x, y = places[0, plane, 0] + 0.5 + [plane * width, 0]
            self._screen.create_oval(
                x - radius, y - radius, x + radius, y + radius, outline="green2"
            )

    def _draw_panel(self, task, message):
        panel, left, y = self._panel, 14, 24
        panel.delete("all")
        lines = lines_of(task)
        if isinstance(self._controls, Controls):
            bend = " ".join(f"{100 * share:4.0f} %" for share in self._controls.bend)
            lines.append(("bend about x, y", bend))
        for name, value in lines:
            panel.create_text(left, y, text=name, fill="grey70", anchor="w")
            panel.create_text(_PANEL - 14, y, text=value, fill="white", anchor="e")
            y += 24
        force = float(task.wall_force.max)
        width = (_PANEL - 2 * left) * min(force / _BAR_FORCE, 1.0)
        panel.create_rectangle(left, y, _PANEL - left, y + 16, outline="grey40")
        panel.create_rectangle(
            left, y, left + width, y + 16, fill=colour_of(force), width=0
        )
        y += 40
        panel.create_text(
            left, y, text=message, fill="white", anchor="nw", width=_PANEL - 2 * left
        )

    def close(self) -> None:
        """Closes the window."""
        self._root.destroy()


def _machine(task) -> angiograph.Planes:
    options = task.config.fluoroscopy
    rows, columns = options.resolution
    factor = max(1, round(SIZE / max(rows, columns)))
    options = dataclasses.replace(options, size=(rows * factor, columns * factor))
    surface = task.scene.anatomy.surface
    machine = angiograph.Angiograph(surface.vertices, surface.faces, options)
    return machine.planes()


def _name(keysym: str) -> str:
    return keysym.lower() if len(keysym) == 1 else keysym


def lines_of(task: Any) -> list[tuple[str, str]]:
    """Name and value of every quantity after a control step or a reset."""
    state, wall = task.readings, task.wall_force
    distance = float(np.linalg.norm(state.head - task.goal_position))
    return [
        ("goal", task.scene.goal.name),
        ("distance", _millimetres(distance)),
        *_inserted(task),
        ("push force", _newton(state.push_force)),
        ("wall force, sum", _newton(wall.sum)),
        ("largest contact", _newton(wall.max)),
        ("peak in the step", _newton(wall.peak_max)),
    ]


def _inserted(task: Any) -> list[tuple[str, str]]:
    """How far each device is in and, where it is turned at its base, by how much."""
    devices = task.devices
    if devices is None:
        return [("inserted", _millimetres(task.readings.insertion))]
    rows = []
    for name, way, angle in zip(
        task.scene.catheter.device_names,
        devices.insertion,
        np.degrees(devices.rotation),
        strict=True,
    ):
        rows += [(name, _millimetres(way)), ("turned", f"{angle:5.0f}°")]
    return rows


def _millimetres(way: float) -> str:
    return f"{float(way) * 1e3:5.1f} mm"


def _newton(force: float) -> str:
    return f"{round(float(force), 3) + 0.0:6.3f} N"  # no minus before zero


def colour_of(force: float) -> str:
    """Colour of a contact force in N."""
    for level, name in FORCE_LEVELS:
        if force <= level:
            return name
    return FORCE_LEVELS[-1][1]
