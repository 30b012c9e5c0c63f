"""Writes docs/observations.md from the specs of the task `type1_bca`.

`python docs/scripts/observations.py` writes the page; the tests compare it.
"""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from figures import grid

from cathsim_dmc import suite
from cathsim_dmc.cli.task_options import field_helps
from cathsim_dmc.imaging.carm import VIEWS
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.physics.randomisation import DEFAULT_RANGES, Randomisation
from cathsim_dmc.tasks import observation_kind, observations
from cathsim_dmc.tasks.cameras import CameraOptions
from cathsim_dmc.tasks.observation_kind import Entry
from cathsim_dmc.tasks.placement import COMMON_LENGTH

OUTPUT = Path(__file__).parents[1] / "observations.md"
TASK = "type1_bca"
PAIR_TASK = "type1_bca_pair"

INTRODUCTION = f"""# Observations

This page lists all observations, with the shape, type, range and unit of each entry,
the options of fluoroscopy and cameras, and the quantities that can be randomised. A
name or a list of names selects the observation:

```python
from cathsim_dmc import suite

env = suite.load("cathsim", "{TASK}", task_kwargs={{
    "observation": ["image", "tracking", "force"],
    "fluoroscopy": {{"view": "LAO45", "noise": True}},
}})
```

- **Frames.** The world frame is that of the patient (LPS): +x to the patient's left, +y
  posterior, +z superior. Joints and links run from proximal to distal.
- **Time.** Positions and velocities of joints are those at the end of the control step,
  wall forces are means over the control step, all other values are those of its last
  physics step.
- **Tip frame.** The origin is the head, the distal end of the device; z points along
  the last link, x and y along its hinges.
- **Length.** A task simulates the part of the device that can leave the sheath
  (`working_length`, 0.14 to 0.44 m). Observations describe a device of
  {COMMON_LENGTH:g} m, so their shapes depend only on the device and `shaft_link`. The
  part proximal of the simulated links is straight, without contacts, and moves with the
  base; its hinge angles are 0. Of a longer device, observations contain the distal
  part.

Shapes are those of `{TASK}`. `docs/scripts/observations.py` writes this page.
"""

COAXIAL = f"""
## Coaxial devices

Tasks with the suffix `_wire` or `_pair` add these entries to `internal`, `tracking` and
`route`, and the first two to `tracking_2d`. The first two are also available as the
observation `drives`, the others as `devices`. Shapes are those of `{PAIR_TASK}`:

{{table}}

`route_coaxial` has the entries of `route` and, in place of those above, the first four
of this table, independent of the world frame. `route_retry` and `route_turns` are
separate observations; `route_turns` requires `route_retry`, for the present attempt:

{{relative}}
"""

VESSEL = """
## Living vessels

The observation `vessel` requires a vessel with flow, a compliant wall or motion, set by
the task's option `vessel` ([living vessel](vessel.md)):

{table}
"""

FLUOROSCOPY = f"""
## Fluoroscopy

`image`, `sequential`, `segmentation`, `tracking_2d` and `biplane` use a simulated
C-arm, without OpenGL. `task_kwargs={{"fluoroscopy": {{...}}}}` configures it:

{{table}}

Views are {", ".join(f"`{name}`" for name in VIEWS)}, or the primary (LAO positive) and
secondary (cranial positive) angle in degrees. With `biplane` the channels of the second
C-arm follow those of the first.

![Views and modes](images/observation_views.png)

`biplane` has the entries of `route`, reconstructed (`cathsim_dmc/imaging/biplane.py`)
from data that are available in an angiography suite:

- *live images and mask*: the difference between a live image and the mask image of the
  empty vessel shows the device; the marker at its tip is dark in both planes, and the
  shaft is traced from there;
- *roadmaps* of two planes with known geometry, and of a `third` view without live
  images: the vessel is the visual hull, the set of points inside the vessel in all
  roadmaps; the route through it is found at the start of an episode. `roadmap_errors`
  has the fields `noise` and `erosion` in pixels, `gaps` (number of missing segments)
  and `calibration`, the largest error of the angles in degrees;
- *goal marker* in both planes;
- *drive*: the last action, and the roll of the handle, from which the frame of the tip
  is computed.

With errors in the roadmaps the hull is thin and broken in narrow branches. The route
then continues across gaps, is centred in the region that all views show as vessel, and
the radius of the lumen is smoothed along it. The deviation of the head from the lumen
is relative to a radius of at least 10 mm ([measured routes](robustness.md#roadmaps)).

A cannulation of the left common carotid artery by the scripted expert:

![Cannulation](images/cannulation_strip.png)
"""

ENDOLUMINAL = """
## Endoluminal views

`endoluminal` and `endoluminal_distance` are views from the head along its axis, with a
field of view of a right angle, without OpenGL: rays are traced through the lumen, at
rest or moving. The option `endoluminal_size` sets their size. The device itself is not
shown, and open ends of the lumen appear closed.

![From the aorta to a branch: grey levels and distances](images/endoluminal.png)
"""

CAMERAS = """
## Cameras

`rgb` and `depth` show MuJoCo's cameras and need OpenGL: set `MUJOCO_GL` to `egl` (a
GPU, or Mesa's software), `osmesa` (software) or `glfw` (with a display) before Python
starts.
`task_kwargs={"cameras": {...}}` configures them:

{table}

The images of several cameras are concatenated along the channels. "tip" looks from the
head along its axis with a field of view of a right angle, as in endoluminal views, by
its own lamp alone, and does not show the device. "top" and "side" show the vessel as
translucent in `rgb`, but as solid in `depth`, where the wall hides the device. A batch
renders its simulations one after the other. In a task with several anatomies each image
equals that of a task with the anatomy of its simulation alone; the first image compiles
a model with all meshes. A moving vessel is drawn at its present position; its mesh is
computed and uploaded for each image, which takes longer.

All cameras of a process render in one thread of their own, so `physics.render` and
other uses of OpenGL do not disturb them. Such a process cannot be
[forked](reliability.md#processes) after its first image. `physics.render` and viewers
draw no vessel in tasks with several anatomies, and a moving vessel at rest.
"""

RANDOMISATION = """
## Domain randomisation

Randomisation is off by default. With `task_kwargs={"randomisation": True}` every reset
draws all quantities from the default ranges; a mapping gives the ranges of some
quantities, and the others stay as without randomisation. A range is `[low, high]` of a
uniform distribution, or a `dm_control.composer.variation.Variation`
([exceptions](how-to.md#a-value-for-each-simulation)); `start_radius` and
`tracking_noise` are single numbers. All draws, including quantum noise, come from the
environment's random state; single and batched environments draw the same values.

{table}

The drawn values of an episode are `env.task.conditions` of a composer environment,
`env.unwrapped.conditions` of a Gymnasium environment, and a list with one for each
simulation, `conditions` of `BatchSimulation` and `CathSimVectorEnv`. They are a named
tuple of the quantities above in their units, with the names of anatomy and goal, the
insertion and the displacement of the start as they were applied, and, under `effects`,
the drawn phases and rates of heart and breathing and the material of the wall of a
living vessel. Quantities that are not randomised are None. Recorded episodes contain
them as `meta["conditions"]`.
"""


def _shape(shape: tuple[int, ...]) -> str:
    return "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"


def _range(entry: Entry) -> str:
    def bound(value: float) -> str:
        return f"{value:g}" if np.isfinite(value) else "∞"

    if np.isinf(entry.low) and np.isinf(entry.high):
        return "unbounded"
    return f"{bound(entry.low)} to {bound(entry.high)}"


# Observations of other tasks.
_OTHERS = (
    observation_kind.COAXIAL,
    observation_kind.COAXIAL_ROUTE,
    observation_kind.LIVING,
)


def other_table(task: str, *names: str, **options: Any) -> str:
    """Table of the entries of observations of other tasks, from the specs."""
    specs = suite.make_task(task, observation=names, **options).observation_specs
    rows = []
    known = observations.entries(["route"])
    for entry in (one for one in observations.entries(names) if one not in known):
        shape = _shape(specs[entry.key].shape)
        rows.append((f"`{entry.key}`", shape, entry.unit, entry.meaning))
    return "\n".join(grid(("entry", "shape", "unit", "meaning"), rows))


def entries_table() -> str:
    """Table of all entries of all observations, from the specs."""
    kinds = {
        n: k for n, k in observations.OBSERVATIONS.items() if k.needs not in _OTHERS
    }
    double = [n for n, k in kinds.items() if k.needs == observation_kind.BIPLANE]
    single = [name for name in kinds if name not in double]
    planes = {"view": [60, 0], "biplane": [-30, 0]}
    specs = {
        **suite.make_task(TASK, observation=single).observation_specs,
        **suite.make_task(
            TASK, observation=double, fluoroscopy=planes
        ).observation_specs,
    }
    header = "observation", "entry", "shape", "type", "range", "unit", "meaning"
    rows = []
    for name, kind in kinds.items():
        for entry in kind.entries:
            spec = specs[entry.key]
            kind_of_array = _shape(spec.shape), str(spec.dtype), _range(entry)
            names = f"`{name}`", f"`{entry.key}`"
            rows.append((*names, *kind_of_array, entry.unit, entry.meaning))
    return "\n".join(grid(header, rows))


def options_table(kind: type, values: object, title: str) -> str:
    """Table of the fields of a dataclass of options, with values and meanings."""
    rows = []
    for name, meaning in field_helps(kind).items():
        value = getattr(values, name)
        if isinstance(value, tuple):
            value = ", ".join(
                each if isinstance(each, str) else f"{each:.4g}" for each in value
            )
        elif isinstance(value, float):
            value = f"{value:.4g}"
        rows.append((f"`{name}`", value, meaning))
    return "\n".join(grid(("option", title, "meaning"), rows))


def page() -> str:
    """Text of the page."""
    parts = [INTRODUCTION, entries_table() + "\n"]
    coaxial = COAXIAL.replace("{table}", other_table(PAIR_TASK, "drives", "devices"))
    relative = ("route_coaxial", "route_retry", "route_turns")
    parts.append(coaxial.replace("{relative}", other_table(PAIR_TASK, *relative)))
    living = other_table(TASK, "vessel", vessel="living")
    parts.append(VESSEL.replace("{table}", living))
    table = options_table(FluoroscopyOptions, FluoroscopyOptions(), "default")
    parts.append(FLUOROSCOPY.replace("{table}", table))
    parts.append(ENDOLUMINAL)
    table = options_table(CameraOptions, CameraOptions(), "default")
    parts.append(CAMERAS.replace("{table}", table))
    table = options_table(Randomisation, DEFAULT_RANGES, "default range")
    parts.append(RANDOMISATION.replace("{table}", table))
    assert len(field_helps(Randomisation)) == len(dataclasses.fields(Randomisation))
    return "\n".join(part.strip("\n") + "\n" for part in parts)


def main() -> None:
    OUTPUT.write_text(page(), encoding="utf-8")
    print(OUTPUT)


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    main()
