"""Geometry without physics: vessels, arches, lumen surfaces and wall pieces."""

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import (
    Centreline,
    CentrelinePoint,
    Projection,
    Vessel,
    VesselTree,
)
from cathsim_dmc.anatomy.parts import End, Goal, Inlet, Surface

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
