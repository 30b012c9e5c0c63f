"""`cathsim validate rest`: whether devices at rest on the wall do not move.

A device is pushed into a phantom to a depth, stopped, and left alone. The reference
does all of it in shorter physics steps: if only the rest were in shorter steps, the
change of step would release the friction that the push has left. Both use the solver
tolerance of the tasks, and a stricter one.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.entities.chain import MAX_PUSH_SPEED
from cathsim_dmc.physics.stepper import PHYSICS_TIMESTEP
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.validation.checks import Check, Report
from cathsim_dmc.validation.rig import STRICT

DEVICES: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "steerable_5f": {"device": "steerable_5f"},
        "steerable_4f": {"device": "steerable_4f"},
        "wire_035_glide": {"device": "wire_035_glide"},
        "wire_014_micro": {"device": "wire_014_micro"},
        "microcatheter_021": {"device": "microcatheter_021"},
        "pair": {"devices": ("wire_035_glide", "diagnostic_5f_j")},
    }
)
ANATOMIES = ("type1", "type2")
DEPTHS = (0.05, 0.07, 0.09, 0.11, 0.13)  # m, of the push
# Physics steps of the reference are so many times shorter.
FINER = 4
SETTLING, WATCHED = 8.0, 4.0  # s; a thin wire oscillates for some seconds
STILL = 0.01  # mm, RMS distance of the head from its mean position
STEADY = 2.0  # %, standard deviation of the force over its mean
CONVERGED = 3.0  # %, deviation of the mean force from that of the reference
# Least denominator, N, of the relative fluctuation and deviation of the force.
LEAST_FORCE = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Rest:
    """Motion and force of a device at rest in N states.

    Attributes:
        head: (T, N, 3) m, position of the head at the ends of control steps.
        force: (T, N) N, sum over all contacts at the ends of control steps.
    """

    head: np.ndarray
    force: np.ndarray

    @property
    def wobble(self) -> np.ndarray:
        """(N,) mm, RMS distance of the head from its mean position."""
        away = np.linalg.norm(self.head - self.head.mean(axis=0), axis=-1)
        return 1e3 * np.sqrt((away**2).mean(axis=0))

    @property
    def fluctuation(self) -> np.ndarray:
        """(N,) %, standard deviation of the force over its mean."""
        mean = np.maximum(self.force.mean(axis=0), LEAST_FORCE)
        return 100 * self.force.std(axis=0) / mean


def pushed(
    options: Mapping[str, Any],
    anatomy: str,
    depths: Sequence[float] = DEPTHS,
    **config: Any,
) -> BatchSimulation:
    """Pushes a device to depths, one for each simulation, and stops it.

    Args:
        options: Device or devices.
        anatomy: Name of a phantom.
        depths: m, of the base, or of all bases.
        **config: Further options of the task.
    """
    place = {"anatomy": anatomy, "goal": "lcca", "goal_radius": 1e-6}
    place |= {"observation": "tracking", **options, **config}
    task, count = suite.make_task("navigate", **place), len(depths)
    batch = BatchSimulation(task, count, num_threads=1, seeds=[0] * count)
    batch.reset()
    action = np.zeros((count, batch.num_actions))
    steps = np.round(np.array(depths) / (MAX_PUSH_SPEED * CONTROL_TIMESTEP))
    for step in range(int(steps.max())):
        for way in task.scene.catheter.translations:
            action[:, way] = step < steps
        batch.step(action)
    return batch


def watch(batch: BatchSimulation, settling: float, watched: float) -> Rest:
    """Records devices without commands for `watched` s, after `settling` s."""
    still, head, force = np.zeros((batch.num_simulations, batch.num_actions)), [], []
    for _ in range(round(settling / CONTROL_TIMESTEP)):
        batch.step(still)
    for _ in range(round(watched / CONTROL_TIMESTEP)):
        step = batch.step(still)
        head.append(step.readings.head)
        force.append(step.wall_force.sum)
    return Rest(np.array(head), np.array(force))


class Compared(NamedTuple):
    """A device at rest in N states of all anatomies; arrays (N,).

    Attributes:
        wobble: mm, see `Rest.wobble`.
        fluctuation: %, see `Rest.fluctuation`.
        deviation: %, deviation of the mean force from that of the reference.
        moved: mm, distance of the mean positions of the head in both.
    """

    wobble: np.ndarray
    fluctuation: np.ndarray
    deviation: np.ndarray
    moved: np.ndarray

    def checks(self, name: str) -> Iterator[Check]:
        """Checks of the worst state of the device `name`."""
        name = f"{name} at rest, worst of {len(self.wobble)} states: "
        note = f"median {np.median(self.wobble):.4f} mm"
        most = self.wobble.max()
        yield Check.at_most(f"{name}RMS of the head", most, STILL, "mm", note)
        note = f"median {np.median(self.fluctuation):.2f} %"
        most = self.fluctuation.max()
        yield Check.at_most(f"{name}fluctuation of the force", most, STEADY, "%", note)
        note = f"median {np.median(self.deviation):.2f} %, the head is "
        note += f"{self.moved.max():.3f} mm away at most"
        what = f"{name}mean force against steps {FINER} times shorter"
        yield Check.at_most(what, self.deviation.max(), CONVERGED, "%", note)


def compared(
    options: Mapping[str, Any],
    anatomies: Sequence[str] = ANATOMIES,
    depths: Sequence[float] = DEPTHS,
) -> Compared:
    """Compares a device at rest in usual and in shorter physics steps.

    Args:
        options: Device or devices.
        anatomies: Names of phantoms.
        depths: m, see `pushed`.
    """
    rows = []
    for anatomy in anatomies:
        pushes = (
            pushed(options, anatomy, depths, physics_timestep=step)
            for step in (PHYSICS_TIMESTEP, PHYSICS_TIMESTEP / FINER)
        )
        usual, fine = (watch(each, SETTLING, WATCHED) for each in pushes)
        force, exact = usual.force.mean(axis=0), fine.force.mean(axis=0)
        away = 100 * np.abs(force - exact) / np.maximum(exact, LEAST_FORCE)
        moved = 1e3 * np.linalg.norm(
            usual.head.mean(axis=0) - fine.head.mean(axis=0), axis=-1
        )
        rows.append((usual.wobble, usual.fluctuation, away, moved))
    return Compared._make(np.concatenate(rows, axis=1))


def validate_rest() -> Report:
    """Runs every check of devices at rest; takes some minutes."""
    found = {name: compared(options) for name, options in DEVICES.items()}
    for name, options in DEVICES.items():
        strict = compared({**options, "solver_tolerance": STRICT})
        found[f"{name}, strict solver,"] = strict
    checks = [check for name, one in found.items() for check in one.checks(name)]
    findings = {name: one._asdict() for name, one in found.items()}
    return Report("rest", checks, findings)
