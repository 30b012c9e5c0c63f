"""Fluoroscopy on the CPU: pure functions of arrays, no OpenGL."""

from cathsim_dmc.imaging.angiograph import Angiograph, Deviation
from cathsim_dmc.imaging.carm import VIEWS, CArm
from cathsim_dmc.imaging.device import Shadow, device_attenuation
from cathsim_dmc.imaging.fluoroscopy import Fluoroscope
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.imaging.thickness import surface_thickness

__all__ = [
    "VIEWS",
    "Angiograph",
    "CArm",
    "Deviation",
    "Fluoroscope",
    "FluoroscopyOptions",
    "Shadow",
    "device_attenuation",
    "surface_thickness",
]
