"""`cathsim validate bench` with the sensitivities of docs/bench.md, as JSON.

python benchmarks/wires.py DIRECTORY > REPORT.json
"""

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from cathsim_dmc.cli.options import say, show
from cathsim_dmc.entities.device import Arc, Device, Section
from cathsim_dmc.entities.devices import METAL_POISSON_RATIO
from cathsim_dmc.validation import bench, bench_data
from cathsim_dmc.validation.rig import Rig

_CORE = Section.isotropic(190e-6, METAL_POISSON_RATIO)  # N·m²


def variants() -> dict[str, dict[str, Any]]:
    """Changes of the setting by name, for the sensitivities."""

    def changed(**change: Callable[[Device], Any]) -> dict[str, Any]:
        devices = {
            kind: replace(device, **{key: make(device) for key, make in change.items()})
            for kind, device in bench.DEVICES.items()
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
    # The taper is that of the data sheet, the stiffness that of a 0.5 mm nitinol core.
    tapered = replace(bench.DEVICES["straight"], shaft=_CORE)
    found["straight tip tapers over 150 mm"] = {
        "device": bench.DEVICES | {"straight": tapered},
        "taper": {"straight": (0.15, 0.3)},
    }
    found |= {f"friction {value:g}": {"friction": value} for value in (0.0, 0.15, 0.3)}
    found |= {f"mesh × {value:g}": {"scale": value} for value in (0.985, 1.015)}
    for far in (10, 20, 40, 60):
        found[f"{far} mm too far, pulled back"] = {"overshoot": 1e-3 * far}
    found["no gravity"] = {"down": "none"}
    return found


class Experiment(bench.Experiment):
    """A bench with wires whose core may taper."""

    def held(
        self, wire: bench_data.Wire, wall: Any, turn: float = 0.0, **changes: Any
    ) -> bench.Held:
        """A wire on the bench; the change "taper" is by kind of wire, see `grind`."""
        taper = changes.pop("taper", {}).get(wire.kind)
        held = super().held(wire, wall, turn, **changes)
        if taper is not None:
            grind(held.rig, *taper)
        return held


def grind(rig: Rig, length: float, thinnest: float) -> None:
    """Tapers the core of a wire: EI goes with the fourth power of its diameter.

    Args:
        rig: Rig of the wire, whose hinge stiffness is changed.
        length: Length of the taper from the tip, m.
        thinnest: Diameter at the tip relative to the full diameter.
    """
    lengths, stiffness = rig.lengths, rig.device.shaft.bending_stiffness
    share = np.minimum(lengths[::-1].cumsum()[::-1] / length, 1.0)
    here = stiffness * (thinnest + (1.0 - thinnest) * share[1:]) ** 4
    joints = 2.0 * here / (lengths[1:] + lengths[:-1])
    for number, own in enumerate(joints, start=1):
        for name in "xy":
            rig.model.joint(f"{rig.name}/bend_{name}_{number}").stiffness = own


def main(folder: str) -> int:
    """Print the report of the bench with the sensitivities as JSON."""
    report = bench.validate_bench(folder, say)
    experiment = Experiment(bench_data.read(folder))
    wires = {wire.name: wire for wire in experiment.bench.wires}
    found: dict[str, dict[str, float]] = {}
    for name, changes in variants().items():
        rms: dict[str, list[float]] = {}
        for way in ("pushed", "steered", "led"):
            for row in report.findings["frames"]:
                if not row["folded"]:
                    turn, wire = (row[way]["turn"],), wires[row["frame"]]
                    result = experiment.compare(wire, way, turn, **changes)
                    key = f"{way}, {wire.kind}"
                    rms.setdefault(key, []).append(float(result.rms[0]))
        found[name] = {key: float(np.median(each)) for key, each in rms.items()}
        say(f"{name}: " + ", ".join(f"{k} {v:.2f} mm" for k, v in found[name].items()))
    findings = {**report.findings, "sensitivity": found}
    return show(replace(report, findings=findings), as_json=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("directory", help="the measured wires")
    sys.exit(main(parser.parse_args().directory))
