"""Simulated guidewires against measured ones: the figures of docs/bench.md.

    python benchmarks/wires.py DIRECTORY [--json]

DIRECTORY has phantom.stl and wires.json; the measured data may not be redistributed.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import wires_data
from wires_data import Bench, Wire
from wires_rig import Held, Setting

from cathsim_dmc.anatomy.field import Field
from cathsim_dmc.anatomy.scan.ways import Ways
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth
from cathsim_dmc.cli.options import show
from cathsim_dmc.entities.contact import FRICTION
from cathsim_dmc.entities.device import Arc, Device, Section
from cathsim_dmc.entities.devices import METAL_LOSS, METAL_POISSON_RATIO, WIRE_035_GLIDE
from cathsim_dmc.validation.checks import Check, Report

# Median RMS distance, mm, of straight wires, and of angled ones at their best turn.
STRAIGHT, ANGLED = 2.0, 3.0
TURNS = 12
# How a wire comes to its place: pushed from the entry without steering; laid along
# another measured wire and let go, so that it is on the side of each branch to which
# the operator has steered it; laid along the measured wire itself.
WAYS = ("pushed", "led", "laid")
EITHER = "pushed or led"  # the better of two histories, since the true one is unknown
BASELINES = ("centreline", "nearest", "hull")


def _nitrex(shaft: float, tip: float, length: float) -> Device:
    """A straight wire of nitinol with a tip of gold-tungsten; EI in N·m², length m."""
    return Device(
        name="nitrex",
        outer_radius=0.445e-3,
        linear_density=4.0e-3,
        shaft=Section.isotropic(shaft, METAL_POISSON_RATIO),
        tip=Section.isotropic(tip, METAL_POISSON_RATIO),
        tip_length=length,
        tip_links=round(length / 4e-3),
        loss_factor=METAL_LOSS,
        source="fit to every second recommended frame (docs/bench.md)",
    )


# Nitrex with a straight tip; Radifocus M Stiff with an angled one.
DEVICES = {
    "straight": _nitrex(75e-6, 2.25e-6, 0.03),
    "angled": WIRE_035_GLIDE,
}
DOWN = "left"  # of the patient, see docs/bench.md


class Result(NamedTuple):
    """Distances of a simulated wire from the measured one at T turns, mm."""

    rms: np.ndarray  # (T,)
    largest: np.ndarray  # (T,)


class Experiment:
    """A bench, its fields and baselines, made once."""

    def __init__(self, bench: Bench):
        """Takes a bench that was read."""
        self.bench = bench
        self._fields: dict[float, Field] = {}
        self._ways: Ways | None = None

    def field(self, scale: float = 1.0) -> Field:
        """Lumen, larger by a factor."""
        if scale not in self._fields:
            self._fields[scale] = self.bench.field(scale)
        return self._fields[scale]

    def setting(self, wire: Wire, down: str = DOWN, **changes: Any) -> Setting:
        """The device of a wire on the bench, with changes of the setting."""
        device = changes.pop("device", DEVICES)[wire.kind]
        friction = changes.pop("friction", FRICTION)
        return Setting(device, friction, self.bench.down[down], **changes)

    def compare(
        self,
        wire: Wire,
        way: str,
        turns: Sequence[float] = (0.0,),
        scale: float = 1.0,
        **changes: Any,
    ) -> Result:
        """Simulates a wire in one of `WAYS`.

        Args:
            wire: to compare with.
            way: in which it comes to its place.
            turns: of the wire about its axis, rad.
            scale: by which the lumen is larger.
            **changes: of the setting: `device`, `friction`, `down`, `overshoot`.
        """
        setting, wall = self.setting(wire, **changes), self.field(scale)
        start = {"led": self._nearest(wire), "laid": wire}.get(way)
        shapes = []
        for turn in turns if way == "pushed" or start is not None else ():
            held = Held(setting, wall, wire, turn)
            shapes.append(held.push() if start is None else held.release(start.points))
        return _result(wire, shapes)

    def centreline(self, wire: Wire) -> Result:
        """The vessel's centreline from the entry to the vessel that the tip is in."""
        if self._ways is None:
            self._ways = Ways(SurfaceDepth(self.bench.surface))
        node = self._ways.node(self.bench.ends[wire.vessel])
        before = self._ways.deepest_from(self._ways.node(self.bench.entry.position))
        return _result(wire, [self._ways.points[self._ways.trace(before, node)]])

    def nearest(self, wire: Wire) -> Result:
        """Another measured wire of the product: where a wire that is led starts."""
        other = self._nearest(wire)
        return _result(wire, [] if other is None else [other.points])

    def _nearest(self, wire: Wire) -> Wire | None:
        """The other recommended wire of the product whose tip is nearest, if any."""
        others = [
            other
            for other in self.bench.wires
            if other is not wire and other.kind == wire.kind and other.recommended
            if not other.folded
        ]
        tip = wire.points[-1]
        return min(
            others, key=lambda o: np.linalg.norm(o.points[-1] - tip), default=None
        )

    def hull(self, wire: Wire) -> Result:
        """The wire pushed into MuJoCo's own mesh, which is its convex hull."""
        held = Held(self.setting(wire), self.bench.surface, wire)
        return _result(wire, [held.push()])


def _result(wire: Wire, shapes: Sequence[np.ndarray]) -> Result:
    found = [1e3 * wires_data.distances(wire.points, shape) for shape in shapes]
    rms = [float(np.sqrt((each**2).mean())) for each in found] or [np.nan]
    largest = [float(each.max()) for each in found] or [np.nan]
    return Result(np.array(rms), np.array(largest))


def variants() -> dict[str, dict[str, Any]]:
    """Changes of the setting whose effect is reported, by name."""

    def changed(**change: Callable[[Device], Any]) -> dict[str, Any]:
        devices = {
            kind: dataclasses.replace(
                device, **{key: make(device) for key, make in change.items()}
            )
            for kind, device in DEVICES.items()
        }
        return {"device": devices}

    def scaled(section: Section, factor: float) -> Section:
        return Section(
            factor * section.bending_stiffness, factor * section.torsional_stiffness
        )

    found: dict[str, dict[str, Any]] = {"as it is": {}}
    for factor in (0.5, 2.0):
        found[f"EI × {factor:g}"] = changed(
            shaft=lambda d, f=factor: scaled(d.shaft, f),
            tip=lambda d, f=factor: scaled(d.tip, f),
        )
        found[f"EI of the tip × {factor:g}"] = changed(
            tip=lambda d, f=factor: scaled(d.tip, f)
        )
    found["tip bent by 15° more"] = changed(
        tip_shape=lambda d: (Arc(0.03, math.radians(15)), *d.tip_shape)
    )
    found |= {f"friction {value:g}": {"friction": value} for value in (0.0, 0.15, 0.3)}
    found |= {f"mesh × {value:g}": {"scale": value} for value in (0.985, 1.015)}
    found["10 mm too far, pulled back"] = {"overshoot": 10e-3}
    found["no gravity"] = {"down": "none"}
    return found


def halves(wires: Iterable[Wire]) -> dict[str, str]:
    """Which half a frame belongs to: parameters are fitted to one, tested on other."""
    found: dict[str, str] = {}
    count: dict[str, int] = dict.fromkeys(wires_data.KINDS, 0)
    for wire in wires:
        found[wire.name] = ("fit", "test")[count[wire.kind] % 2]
        count[wire.kind] += 1
    return found


def compare_wires(
    folder: str | Path,
    *,
    turns: int = TURNS,
    sensitivity: bool = True,
    say: Callable[[str], None] = lambda text: None,
) -> Report:
    """Compares simulated guidewires with those measured in a phantom.

    Args:
        folder: see `wires_data.read`.
        turns: of an angled wire about its axis, evenly spread.
        sensitivity: whether to repeat it with other parameters.
        say: called with a line of text for every frame and variant.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if one is not as stated, or recommends no frame.
    """
    if turns < 1:
        raise ValueError(f"turns is {turns}; it must be 1 or more")
    bench = wires_data.read(folder)
    wires = [wire for wire in bench.wires if wire.recommended]
    if not wires:
        raise ValueError(
            f"{folder} recommends none of its {len(bench.wires)} wires; "
            "'recommended' of at least one must be true"
        )
    experiment, half = Experiment(bench), halves(wires)
    rows = []
    for wire in wires:
        rows.append(row := _row(experiment, wire, half[wire.name], turns))
        figures = (f"{key} {row[key]['rms']:.2f} mm" for key in (*WAYS, *BASELINES))
        say(f"{wire.name} ({wire.kind}, {wire.vessel}): {', '.join(figures)}")
    found: dict[str, Any] = {"frames": rows}
    if sensitivity:
        found["sensitivity"] = _sensitivity(experiment, wires, rows, say)
    return Report("Guidewires on a bench", _checks(rows), found)


def _row(experiment: Experiment, wire: Wire, half: str, turns: int) -> dict[str, Any]:
    """Figures of one frame."""
    angles = np.arange(turns if wire.kind == "angled" else 1) * (2.0 * np.pi / turns)
    results = {way: experiment.compare(wire, way, angles.tolist()) for way in WAYS}
    results |= {name: getattr(experiment, name)(wire) for name in BASELINES}
    row: dict[str, Any] = {
        "frame": wire.name,
        "wire": wire.kind,
        "vessel": wire.vessel,
        "half": half,
        "folded": wire.folded,
        "inserted_mm": 1e3 * wire.length,
    }
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


def _sensitivity(experiment, wires, rows, say) -> dict[str, dict[str, float]]:
    """Median RMS (mm) by variant, way and kind, each frame at its turn in `rows`."""
    found = {}
    for name, changes in variants().items():
        rms: dict[str, list[float]] = {}
        for way in ("pushed", "led"):
            for wire, row in zip(wires, rows, strict=True):
                if not wire.folded:
                    turn = (row[way]["turn"],)
                    result = experiment.compare(wire, way, turn, **changes)
                    key = f"{way}, {wire.kind}"
                    rms.setdefault(key, []).append(float(result.rms[0]))
        found[name] = {key: float(np.median(each)) for key, each in rms.items()}
        say(f"{name}: " + ", ".join(f"{k} {v:.2f} mm" for k, v in found[name].items()))
    return found


def _checks(rows: Sequence[dict[str, Any]]) -> list[Check]:
    """Medians against the aims and the baselines; folded frames apart."""
    found = []
    for kind, bound in zip(wires_data.KINDS, (STRAIGHT, ANGLED), strict=True):
        chosen = [row for row in rows if row["wire"] == kind and not row["folded"]]
        if not chosen:
            continue
        baseline = {
            key: float(np.median([row[key]["rms"] for row in chosen]))
            for key in BASELINES
        }
        note = ", ".join(f"{key} {value:.2f} mm" for key, value in baseline.items())
        least = min(value for value in baseline.values() if np.isfinite(value))
        for way in ("pushed", EITHER, "laid"):
            each = [row[way]["rms"] for row in chosen]
            tested = [row[way]["rms"] for row in chosen if row["half"] == "test"]
            largest = max(row[way]["largest"] for row in chosen)
            name = f"{kind} wires, {way}: median RMS"
            behind = f"of {len(each)} frames, largest distance {largest:.1f} mm"
            value = float(np.median(each))
            found.append(Check.at_most(name, value, bound, "mm", behind))
            if way != "laid":
                label = f"{name}, against the best baseline"
                found.append(Check.at_most(label, value, least, "mm", note))
            if tested:
                label, behind = f"{name}, test half", f"of {len(tested)} frames"
                value = float(np.median(tested))
                found.append(Check.at_most(label, value, bound, "mm", behind))
    return found


def tables(report: Report) -> dict[str, list[list[str]]]:
    """Rows of text by title, the header first: frames, and sensitivity if measured."""
    frames = [["frame", "wire, tip in", "half", *WAYS, *BASELINES]]
    for row in report.findings["frames"]:
        half = "folded" if row["folded"] else row["half"]
        cells = [row["frame"], f"{row['wire']}, {row['vessel']}", half]
        for name in (*WAYS, *BASELINES):
            each = row[name]
            turned = row["wire"] == "angled" and name in WAYS
            median = f" / {each['median_rms']:.1f}" if turned else ""
            cells.append(f"{each['rms']:.1f}{median} ({each['largest']:.0f})")
        frames.append(cells)
    found = {"RMS distance: best turn / median turn (largest distance), mm": frames}
    variants = report.findings.get("sensitivity", {})
    if variants:
        names = list(next(iter(variants.values())))
        rows = [
            [key, *(f"{row[n]:.2f}" for n in names)] for key, row in variants.items()
        ]
        found["Median RMS distance by variant, mm"] = [["variant", *names], *rows]
    return found


if __name__ == "__main__":
    report = compare_wires(
        sys.argv[1], say=lambda text: print(text, file=sys.stderr, flush=True)
    )
    sys.exit(show(report, "--json" in sys.argv[2:]))
