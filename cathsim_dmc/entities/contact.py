"""Contact of the device with wall and sheath: stiffness, damping and friction."""

from typing import Any

# Lubricated silicone, Coulomb.
FRICTION = 0.037
# A critically damped return within 3 ms, given directly as stiffness 1/t² and damping
# 2/t: the standard form would be slowed down to two steps, which the implicit
# "discrete" integrator does not need.
_CONTACT_TIME = 0.003  # s
CONTACT_SOLREF = (-1 / _CONTACT_TIME**2, -2 / _CONTACT_TIME)
# The impedance starts low and then rises like a barrier. Low, so that a device rests
# some 0.1 mm deep under its usual load, more than it moves on the facets in a step: a
# hard start (0.95) loses contact and hits the wall anew, with jumps of 1.8 mm and
# peaks above 1 N. A barrier, so that a full push does not sink in: an impedance that
# stops rising at 0.97 let 0.2 N push the tip 3 mm deep.
CONTACT_SOLIMP = (0.7, 0.999, 0.0003, 0.5, 1)

# Coaxial devices: a wire in a catheter is four times as stiff as the steerable device
# and jams with newtons. MuJoCo keeps the impedance d of a step's beginning through the
# step: under a dead load the depth r becomes (1 - α) r + α r₀ (r / r₀)^-m about its
# equilibrium r₀, with α = k d h / (k d h + b) for stiffness k, damping b and time step
# h, and m = ∂ln(d² / (1 - d)) / ∂ln r. That dies out where α (1 + m) < 2. The barrier
# above keeps to that up to 0.23 mm, some 0.3 N, and rattles beyond. This one does up to
# any depth: its end is rounded off, and it is damped six times as much as critically.
_COAXIAL_TIME = 0.0015  # s
COAXIAL_SOLREF = (-1 / _COAXIAL_TIME**2, -12 / _COAXIAL_TIME)
COAXIAL_SOLIMP = (0.3, 0.99, 0.0003, 0.01, 2)


def wall_contact(friction: float) -> dict[str, Any]:
    """Attributes of a geom that the device touches as wall; friction is Coulomb's."""
    return {"contype": 1, "conaffinity": 0, **_surface(friction)}


def device_contact(friction: float) -> dict[str, Any]:
    """Attributes of a geom of the device; it touches walls, never itself.

    Args:
      friction: Coulomb coefficient; MuJoCo takes the larger of the two bodies'.
    """
    return {"contype": 0, "conaffinity": 1, **_surface(friction)}


def coaxial_contact(friction: float) -> dict[str, Any]:
    """Attributes of a geom of coaxial devices, whose settings prevail on a wall.

    Args:
      friction: Coulomb coefficient, whatever that of the wall is.
    """
    return {
        **device_contact(friction),
        "priority": 1,
        "solref": COAXIAL_SOLREF,
        "solimp": COAXIAL_SOLIMP,
    }


def sheath_contact() -> dict[str, Any]:
    """Attributes of a geom of the sheath, frictionless whatever touches it."""
    return {
        "contype": 1,
        "conaffinity": 0,
        # The sheath's settings prevail: one row a contact in place of three.
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
