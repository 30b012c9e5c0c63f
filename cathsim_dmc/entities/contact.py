"""Contact of the device with wall and sheath: stiffness, damping and friction."""

from typing import Any

# Lubricated silicone, Coulomb.
FRICTION = 0.037
# A critically damped return in 3 ms, given directly as stiffness 1/t² and damping 2/t.
# MuJoCo limits the standard form to two time steps, which the implicit "discrete"
# integrator does not need.
_CONTACT_TIME = 0.003  # s
CONTACT_SOLREF = (-1 / _CONTACT_TIME**2, -2 / _CONTACT_TIME)
# The impedance starts low and then rises like a barrier. With a low start, a device
# rests some 0.1 mm deep under its usual load, more than it moves over a facet in a
# step; with a high one (0.95) it loses contact and hits the wall again, with jumps of
# 1.8 mm and peaks above 1 N. The barrier stops a full push; without it (0.97) 0.2 N
# push the tip 3 mm deep.
CONTACT_SOLIMP = (0.7, 0.999, 0.0003, 0.5, 1)

# Coaxial devices: a wire in a catheter is four times as stiff as the steerable device
# and jams with several newtons. MuJoCo evaluates the impedance d at the beginning of a
# step: under a dead load with equilibrium depth r₀, the depth r becomes
# (1 - α) r + α r₀ (r / r₀)^-m, with α = k d h / (k d h + b) for stiffness k, damping b
# and time step h, and m = ∂ln(d² / (1 - d)) / ∂ln r. It converges if α (1 + m) < 2. The
# parameters above satisfy this up to 0.23 mm, some 0.3 N. These satisfy it at every
# depth: d stays below 0.99, and the damping is six times critical.
_COAXIAL_TIME = 0.0015  # s
COAXIAL_SOLREF = (-1 / _COAXIAL_TIME**2, -12 / _COAXIAL_TIME)
COAXIAL_SOLIMP = (0.3, 0.99, 0.0003, 0.01, 2)


def wall_contact(friction: float) -> dict[str, Any]:
    """Attributes of a wall geom with a Coulomb coefficient."""
    return {"contype": 1, "conaffinity": 0, **_surface(friction)}


def device_contact(friction: float) -> dict[str, Any]:
    """Attributes of a geom of the device, which collides with walls only.

    Args:
        friction: Coulomb coefficient; MuJoCo takes the larger of the two geoms'.
    """
    return {"contype": 0, "conaffinity": 1, **_surface(friction)}


def coaxial_contact(friction: float) -> dict[str, Any]:
    """Attributes of a geom of coaxial devices, which override those of the wall.

    Args:
        friction: Coulomb coefficient; replaces that of the wall.
    """
    return {
        **device_contact(friction),
        "priority": 1,
        "solref": COAXIAL_SOLREF,
        "solimp": COAXIAL_SOLIMP,
    }


def sheath_contact() -> dict[str, Any]:
    """Attributes of a geom of the sheath, frictionless for every device."""
    return {
        "contype": 1,
        "conaffinity": 0,
        # Overrides the device: one constraint row a contact instead of three.
        "priority": 2,
        "condim": 1,
        "solref": CONTACT_SOLREF,
        "solimp": CONTACT_SOLIMP,
    }


def _surface(friction: float) -> dict[str, Any]:
    return {
        "condim": 3,
        "friction": (friction, 0, 0),
        "solref": CONTACT_SOLREF,
        "solimp": CONTACT_SOLIMP,
    }
