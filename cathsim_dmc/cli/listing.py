"""`cathsim list`: the tasks, or the library of devices."""

import math
import sys
from pathlib import Path
from typing import Any

from rich.table import Table

from cathsim_dmc import suite
from cathsim_dmc.cli.options import Json, Modules, console, print_json
from cathsim_dmc.entities.device import Device
from cathsim_dmc.entities.devices import DEVICES

# `agents.pretrained_names` would load torch.
_SHIPPED = Path(__file__).parents[1] / "pretrained"


def show(devices: bool = False, json: Json = False, modules: Modules = ()) -> int:
    """List the tasks and the shipped policies, or the devices with their properties.

    Args:
        devices: Whether to list the devices in place of the tasks.
    """
    lines = {name: make.__doc__.splitlines()[0] for name, make in suite.SUITE.items()}
    rows = {name: figures(device) for name, device in DEVICES.items()}
    policies = [f"pretrained:{each.stem}" for each in sorted(_SHIPPED.glob("*.json"))]
    if json:
        tasks = {"domain": suite.DOMAIN, "tasks": lines, "policies": policies}
        print_json({"devices": rows} if devices else tasks)
        return 0
    if devices:
        # Wide enough for all columns where the output is no terminal.
        width = None if sys.stdout.isatty() else 240
        console(width).print(_device_table(rows))
        return 0
    table = Table("task", "what to do", box=None)
    for name, line in lines.items():
        if not name.endswith(tuple(f"_{suffix}" for suffix in suite.COAXIAL)):
            table.add_row(name, line)
    for suffix, (_, words) in suite.COAXIAL.items():
        table.add_row(f"…_{suffix}", f"Each task but navigate, {words}.")
    console().print(table)
    console().print("\nShipped policies: " + ", ".join(policies), highlight=False)
    return 0


def _device_table(rows: dict[str, dict[str, Any]]) -> Table:
    table = Table("device", box=None)
    columns = {
        "Ø mm": "outer_diameter_mm",
        "lumen mm": "lumen_diameter_mm",
        "EI shaft N·mm²": "shaft_bending_stiffness_n_mm2",
        "EI tip N·mm²": "tip_bending_stiffness_n_mm2",
        "tip mm": "tip_length_mm",
    }
    for heading in columns:
        table.add_column(heading, justify="right")
    table.add_column("shape")
    table.add_column("sources", overflow="fold")
    for name, row in rows.items():
        numbers = [f"{row[column]:.3g}" for column in columns.values()]
        table.add_row(name, *numbers, row["shape"], row["source"])
    return table


def figures(device: Device) -> dict[str, Any]:
    """Returns the properties of a device by name, in the units of data sheets."""
    return {
        "outer_diameter_mm": 2e3 * device.outer_radius,
        "lumen_diameter_mm": 2e3 * device.inner_radius,
        "shaft_bending_stiffness_n_mm2": 1e6 * device.shaft.bending_stiffness,
        "tip_bending_stiffness_n_mm2": 1e6 * device.tip.bending_stiffness,
        "shaft_torsional_stiffness_n_mm2": 1e6 * device.shaft.torsional_stiffness,
        "tip_torsional_stiffness_n_mm2": 1e6 * device.tip.torsional_stiffness,
        "tip_length_mm": 1e3 * device.tip_length,
        "linear_density_g_per_m": 1e3 * device.linear_density,
        "friction_ratio": device.friction_ratio,
        "steering_angle_rad": device.steering_angle,
        "shape": shape(device),
        "source": device.source,
    }


def shape(device: Device) -> str:
    """Returns the arcs of the tip as text, proximal to distal, or "straight"."""
    parts = []
    for arc in device.tip_shape:
        length, turn = f"{1e3 * arc.length:.2g} mm", round(math.degrees(arc.angle))
        parts.append(f"{turn}° in {length}" if turn else f"{length} straight")
    bend = ", ".join(parts) or "straight"
    return f"{bend}; steerable" if device.steerable else bend
