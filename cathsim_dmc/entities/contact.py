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


def wall_contact(friction: float) -> dict[str, Any]:
    """Attributes of a geom that the device touches as wall; friction is Coulomb's."""
    return {"contype": 1, "conaffinity": 0, **_surface(friction)}


def device_contact(friction: float) -> dict[str, Any]:
    """Attributes of a geom of the device; it touches walls, never itself.

    Args:
      friction: Coulomb coefficient; MuJoCo takes the larger of the two bodies'.
    """
    return {"contype": 0, "conaffinity": 1, **_surface(friction)}


def sheath_contact() -> dict[str, Any]:
    """Attributes of a geom of the sheath, frictionless whatever touches it."""
    return {
        "contype": 1,
        "conaffinity": 0,
        # The sheath's settings prevail: one row a contact in place of three.
        "priority": 1,
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
