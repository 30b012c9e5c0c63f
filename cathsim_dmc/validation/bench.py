"""Simulated guidewires against measured ones: `cathsim validate bench`."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc.anatomy.field import Field
from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.anatomy.scan.ways import Ways
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth
from cathsim_dmc.entities.device import Device, Section
from cathsim_dmc.entities.devices import METAL_LOSS, METAL_POISSON_RATIO, WIRE_035_GLIDE
from cathsim_dmc.validation import bench_data
from cathsim_dmc.validation.bench_data import Bench, Wire
from cathsim_dmc.validation.bench_rig import Held
from cathsim_dmc.validation.checks import Check, Report

# Bounds of the median RMS distance, mm: straight wires; angled ones at their best turn.
STRAIGHT, ANGLED = 2.0, 3.0
TURNS = 12  # of an angled wire about its axis, evenly spread
# Insertion histories of a wire. "pushed": from the entry without steering. "steered":
# turned where it enters a wrong branch, pushed too far and pulled back. "led": released
# from the shape of another measured wire, so that it is on the side of each branch to
# which the operator steered it. "laid": released from the measured shape itself.
WAYS = ("pushed", "steered", "led", "laid")
TOO_FAR = 40e-3  # m, overshoot of "steered"; fitted of 20, 40, 60 mm (docs/bench.md)
EITHER = "pushed or led"  # the better of two histories, since the true one is unknown
BASELINES = ("centreline", "nearest", "hull")


# Nitrex, nitinol with a straight tip of gold-tungsten; Radifocus M Stiff, angled.
DEVICES = {
    "straight": Device(
        name="nitrex",
        outer_radius=0.445e-3,
        linear_density=4.0e-3,
        shaft=Section.isotropic(75e-6, METAL_POISSON_RATIO),
        tip=Section.isotropic(2.25e-6, METAL_POISSON_RATIO),
        tip_length=0.03,
        tip_links=8,
        loss_factor=METAL_LOSS,
        source="fit to every second recommended frame (docs/bench.md)",
    ),
    "angled": WIRE_035_GLIDE,
}
DOWN = "left"  # of the patient, see docs/bench.md


class Result(NamedTuple):
    """RMS and largest distance of simulated from measured wire at T turns, mm."""

    rms: np.ndarray  # (T,)
    largest: np.ndarray  # (T,)


class Experiment:
    """A bench with its fields and baselines, which are cached."""

    def __init__(self, bench: Bench):
        """Takes a bench from `bench_data.read`."""
        self.bench = bench
        # Field of the lumen by its enlargement.
        self.field = functools.cache(bench.field)

    @functools.cached_property
    def _ways(self) -> Ways:
        return Ways(SurfaceDepth(self.bench.surface))

    def held(
        self, wire: Wire, wall: Field | Surface, turn: float = 0.0, **changes: Any
    ) -> Held:
        """A wire on the bench; `changes` are those of `compare`."""
        device = changes.pop("device", DEVICES)[wire.kind]
        down = self.bench.down[changes.pop("down", DOWN)]
        return Held(wall, wire, device, down, turn, **changes)

    def compare(
        self,
        wire: Wire,
        way: str,
        turns: Sequence[float] = (0.0,),
        scale: float = 1.0,
        **changes: Any,
    ) -> Result:
        """Simulates a wire with one of the insertion histories `WAYS`.

        Args:
            turns: rotations of the wire about its axis, rad.
            scale: enlargement of the lumen.
            **changes: of the setting: `friction`, `down`, `overshoot`; `device` by kind
                of the wire.
        """
        arrive, shapes = self._arrival(wire, way), list[np.ndarray]()
        if way == "steered":
            changes = {"overshoot": TOO_FAR} | changes
        if arrive is not None:
            field = self.field(scale)
            held = (self.held(wire, field, turn, **changes) for turn in turns)
            shapes = [arrive(each) for each in held]
        return _result(wire, shapes)

    def _arrival(self, wire: Wire, way: str) -> Callable[[Held], np.ndarray] | None:
        """Simulation of an insertion history; None if it lacks another wire."""
        if way == "pushed":
            return Held.push
        if way == "steered":
            astray = functools.partial(self.bench.is_astray, wire)
            return lambda held: held.steer(astray)
        start = wire if way == "laid" else self._nearest(wire)
        return None if start is None else lambda held: held.release(start.points)

    def centreline(self, wire: Wire) -> Result:
        """Baseline: the centreline from the entry to the vessel of the tip."""
        node = self._ways.node(self.bench.ends[wire.vessel])
        before = self._ways.deepest_from(self._ways.node(self.bench.entry.position))
        return _result(wire, [self._ways.points[self._ways.trace(before, node)]])

    def nearest(self, wire: Wire) -> Result:
        """Baseline: another measured wire of the product, the start of "led"."""
        other = self._nearest(wire)
        return _result(wire, [] if other is None else [other.points])

    def _nearest(self, wire: Wire) -> Wire | None:
        """The other recommended wire of the product whose tip is nearest, if any."""

        def away(other: Wire) -> float:
            return float(np.linalg.norm(other.points[-1] - wire.points[-1]))

        others = [one for one in self.bench.wires if one.recommended and not one.folded]
        others = [one for one in others if one is not wire and one.kind == wire.kind]
        return min(others, key=away, default=None)

    def hull(self, wire: Wire) -> Result:
        """Baseline: the wire pushed into MuJoCo's mesh geom, which is a convex hull."""
        return _result(wire, [self.held(wire, self.bench.surface).push()])


def _result(wire: Wire, shapes: Sequence[np.ndarray]) -> Result:
    found = [1e3 * bench_data.distances(wire.points, shape) for shape in shapes]
    rows = [(np.sqrt((each**2).mean()), each.max()) for each in found]
    rms, largest = np.array(rows or [(np.nan, np.nan)]).T
    return Result(rms, largest)


def halves(wires: Iterable[Wire]) -> dict[str, str]:
    """Half of each frame by name: "fit", for parameters, or "test"."""
    turn = {kind: itertools.cycle(("fit", "test")) for kind in bench_data.KINDS}
    return {wire.name: next(turn[wire.kind]) for wire in wires}


def validate_bench(
    folder: str | Path, say: Callable[[str], None] = lambda text: None
) -> Report:
    """Compares simulated guidewires with those measured in a phantom.

    Args:
        folder: see `bench_data.read`.
        say: called with a line of text for every frame.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if one is not as stated, or no wire is recommended.
    """
    bench = bench_data.read(folder)
    wires = [wire for wire in bench.wires if wire.recommended]
    if not wires:
        raise ValueError(
            f"{folder} recommends none of its {len(bench.wires)} wires; "
            "'recommended' of at least one must be true"
        )
    experiment, half = Experiment(bench), halves(wires)
    rows = []
    for wire in wires:
        rows.append(row := _row(experiment, wire, half[wire.name]))
        figures = (f"{key} {row[key]['rms']:.2f} mm" for key in (*WAYS, *BASELINES))
        say(f"{wire.name} ({wire.kind}, {wire.vessel}): {', '.join(figures)}")
    return Report("Guidewires on a bench", list(_checks(rows)), {"frames": rows})


def _row(experiment: Experiment, wire: Wire, half: str) -> dict[str, Any]:
    angles = np.arange(TURNS if wire.kind == "angled" else 1) * (2.0 * np.pi / TURNS)
    results = {way: experiment.compare(wire, way, angles.tolist()) for way in WAYS}
    results |= {name: getattr(experiment, name)(wire) for name in BASELINES}
    row: dict[str, Any] = {"frame": wire.name, "wire": wire.kind, "half": half}
    row |= {"vessel": wire.vessel, "folded": wire.folded}
    row["inserted_mm"] = 1e3 * wire.length
    for name, result in results.items():
        best = int(result.rms.argmin())
        row[name] = {
            "rms": float(result.rms[best]),
            "largest": float(result.largest[best]),
            "median_rms": float(np.median(result.rms)),
            "turn": float(angles[best]),
        }
    row[EITHER] = min(row["pushed"], row["led"], key=lambda each: each["rms"])
    return row


def _checks(rows: Sequence[dict[str, Any]]) -> Iterator[Check]:
    """Medians against the bounds and the baselines, without folded frames."""
    for kind, bound in zip(bench_data.KINDS, (STRAIGHT, ANGLED), strict=True):
        chosen = [row for row in rows if row["wire"] == kind and not row["folded"]]
        if not chosen:
            continue
        found = {key: [row[key]["rms"] for row in chosen] for key in BASELINES}
        baseline = {key: float(np.median(each)) for key, each in found.items()}
        note = ", ".join(f"{key} {value:.2f} mm" for key, value in baseline.items())
        least = min(value for value in baseline.values() if np.isfinite(value))
        for way in ("pushed", "steered", EITHER, "laid"):
            # A steered wire is turned by the operator, so its best turn is not chosen.
            rms = "median_rms" if way == "steered" else "rms"
            each = [row[way][rms] for row in chosen]
            tested = [row[way][rms] for row in chosen if row["half"] == "test"]
            largest = max(row[way]["largest"] for row in chosen)
            name, value = f"{kind} wires, {way}: median RMS", float(np.median(each))
            behind = f"of {len(each)} frames, largest distance {largest:.1f} mm"
            yield Check.at_most(name, value, bound, "mm", behind)
            if way != "laid":
                label = f"{name}, against the best baseline"
                yield Check.at_most(label, value, least, "mm", note)
            if tested:
                label, behind = f"{name}, test half", f"of {len(tested)} frames"
                yield Check.at_most(label, np.median(tested), bound, "mm", behind)
