"""A device and its driver in two programs, which exchange messages over TCP."""

from cathsim_dmc.bridge.device import Device, SimulatedDevice, State
from cathsim_dmc.bridge.driver import Driven, DriveOptions, drive
from cathsim_dmc.bridge.messages import PROTOCOL, BridgeError, Connection
from cathsim_dmc.bridge.records import Log
from cathsim_dmc.bridge.serving import ServeOptions, listen, serve

__all__ = [
    "PROTOCOL", "BridgeError", "Connection", "Device", "DriveOptions", "Driven", "Log",
    "ServeOptions", "SimulatedDevice", "State", "drive", "listen", "serve",
]  # fmt: skip
