"""`cathsim list --devices`."""

import math
import sys
from typing import Any

from cathsim_dmc.cli.options import print_json
from cathsim_dmc.entities.device import Device


def show(json: bool) -> int:
    """Print the library of devices, as a table or as one JSON object."""
    from rich.console import Console
    from rich.table import Table

    from cathsim_dmc.entities.devices import DEVICES

    rows = {name: figures(device) for name, device in DEVICES.items()}
    if json:
        print_json({"devices": rows})
        return 0
    table = Table(box=None)
    for heading in ("device", "Ø mm", "lumen", "EI shaft", "EI tip N·mm²", "tip mm"):
        table.add_column(heading, justify="left" if heading == "device" else "right")
    table.add_column("shape")
    table.add_column("sources", overflow="fold")
    for name, row in rows.items():
        table.add_row(
            name,
            f"{row['outer_diameter_mm']:.3g}",
            f"{row['lumen_diameter_mm']:.3g}",
            f"{row['shaft_bending_stiffness_n_mm2']:.3g}",
            f"{row['tip_bending_stiffness_n_mm2']:.3g}",
            f"{row['tip_length_mm']:g}",
            row["shape"],
            row["source"],
        )
    # As wide as it needs to be where nobody looks at a terminal.
    console = Console() if sys.stdout.isatty() else Console(width=240)
    console.print(table)
    return 0


def figures(device: Device) -> dict[str, Any]:
    """Properties of a device, in the units of data sheets."""
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
    """The arcs of the tip from proximal to distal, "straight" if there are none."""
    parts = []
    for arc in device.tip_shape:
        length, turn = f"{1e3 * arc.length:.2g} mm", round(math.degrees(arc.angle))
        parts.append(f"{turn}° in {length}" if turn else f"{length} straight")
    bend = ", ".join(parts) or "straight"
    return f"{bend}; steerable" if device.steerable else bend
