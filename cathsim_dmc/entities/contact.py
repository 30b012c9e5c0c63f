"""Contact of the device with wall and sheath: stiffness, damping and friction."""

from typing import Any

from cathsim_dmc import bounds

# Lubricated silicone, Coulomb.
FRICTION = 0.037
# Contact law of all devices. MuJoCo keeps the impedance d of a step's beginning
# through the step: under a dead load the depth r becomes (1 - α) r + α r₀ (r / r₀)^-m
# about its equilibrium r₀, with α = k d h / (k d h + b) for stiffness k, damping b and
# time step h, and m = ∂ln(d² / (1 - d)) / ∂ln r. That dies out where α (1 + m) < 2.
# This law does at any depth: soft at first, a barrier whose end is rounded off. A deep
# contact recovers within b / k = 8 ms. The soft start matters for friction: in MuJoCo
# sliding at a speed v presses device and wall apart like a depth of μ b v / k d.
_CONTACT_TIME = 0.456e-3  # s
CONTACT_SOLREF = (-1 / _CONTACT_TIME**2, -18 / _CONTACT_TIME)
CONTACT_SOLIMP = (0.02, 0.95, 0.0002, 0.01, 2)
# Friction below its limit is a stiff damper in MuJoCo: what sticks creeps by its
# compliance, which is that of the normal force over this ratio.
FRICTION_STIFFNESS = 200.0
# Attributes of a geom that is there to be seen only.
DRAWN = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 2}


def wall_contact(friction: float) -> dict[str, Any]:
    """Attributes of a wall geom with a Coulomb coefficient."""
    return {
        "contype": 1,
        "conaffinity": 0,
        "condim": 3,
        "friction": (bounds.number("friction", friction, 0.0, 2.0), 0, 0),
        "solref": CONTACT_SOLREF,
        "solimp": CONTACT_SOLIMP,
    }


def device_contact(friction: float) -> dict[str, Any]:
    """Attributes of a geom of the device, which collides with walls only.

    Args:
        friction: Coulomb coefficient; MuJoCo takes the larger of the two geoms'.
    """
    return {**wall_contact(friction), "contype": 0, "conaffinity": 1}


def sheath_contact() -> dict[str, Any]:
    """Attributes of a geom of the sheath, frictionless for every device."""
    # Overrides the device: one constraint row a contact instead of three.
    return {**wall_contact(0.0), "priority": 2, "condim": 1}
