"""Geometry without physics: vessels, arches, lumen surfaces and wall pieces."""

from cathsim_dmc.anatomy.anatomy import Anatomy, End, Goal, Inlet, Surface
from cathsim_dmc.anatomy.centreline import (
    Centreline,
    CentrelinePoint,
    Projection,
    Vessel,
    VesselTree,
)

__all__ = [
    "Anatomy",
    "Centreline",
    "CentrelinePoint",
    "End",
    "Goal",
    "Inlet",
    "Projection",
    "Surface",
    "Vessel",
    "VesselTree",
]
