"""Geometry without physics: vessels, arches, lumen surfaces and wall pieces."""

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.parts import Goal, Surface

__all__ = ["Anatomy", "Centreline", "Goal", "Surface", "Vessel", "VesselTree"]
