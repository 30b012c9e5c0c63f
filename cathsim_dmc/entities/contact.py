"""Contact of the device with wall and sheath: stiffness, damping and friction."""

from typing import Any

from cathsim_dmc import bounds

# Coulomb coefficient of lubricated silicone, and the largest one.
FRICTION, MOST_FRICTION = 0.037, 2.0
# Contact law of all devices. MuJoCo takes the impedance d at the beginning of a step.
# Under a dead load with the equilibrium depth r₀, a depth r becomes
# (1 - α) r + α r₀ (r / r₀)^-m, with α = k d h / (k d h + b) for stiffness k, damping b
# and time step h, and m = ∂ln(d² / (1 - d)) / ∂ln r. It converges if α (1 + m) < 2,
# here at any depth: the law starts soft and rises like a barrier with a rounded end. A
# deep contact recovers within b / k = 8 ms. The soft start matters for friction: in
# MuJoCo, sliding at a speed v presses device and wall apart like a depth μ b v / k d.
_CONTACT_TIME = 0.456e-3  # s
CONTACT_SOLREF = (-1 / _CONTACT_TIME**2, -18 / _CONTACT_TIME)
CONTACT_SOLIMP = (0.02, 0.95, 0.0002, 0.01, 2)
# Ratio of frictional to normal impedance (`impratio`). Below its limit, MuJoCo's
# friction is a stiff damper: a sticking contact creeps, less with a larger ratio.
FRICTION_STIFFNESS = 200.0
# Attributes of a geom that is drawn only.
DRAWN = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 2}


def wall_contact(friction: float) -> dict[str, Any]:
    """Attributes of a wall geom with a Coulomb coefficient from 0 to 2."""
    return {
        "contype": 1,
        "conaffinity": 0,
        "condim": 3,
        "friction": (bounds.number("friction", friction, 0.0, MOST_FRICTION), 0, 0),
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
    # Overrides the device's: one constraint row per contact instead of three.
    return {**wall_contact(0.0), "priority": 2, "condim": 1}
