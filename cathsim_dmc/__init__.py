"""Endovascular navigation tasks on dm_control composer and MuJoCo."""

import importlib
import warnings

__version__ = "0.2.0"

# MuJoCo's window library warns at import on a machine without a screen. Nothing here
# needs one before a viewer is asked for, which then says so itself.
warnings.filterwarnings("ignore", message=".*DISPLAY environment variable is missing.*")
# TorchRL 0.14 warns of classes of its own at import.
warnings.filterwarnings("ignore", message=".*WeightUpdaterBase is deprecated.*")

_SUBMODULES = (
    "agents",
    "analysis",
    "anatomy",
    "entities",
    "imaging",
    "pictures",
    "policies",
    "recording",
    "simulation",
    "suite",
    "tasks",
    "validation",
)
# What a notebook asks for first; see `cathsim_dmc.pictures`.
_FUNCTIONS = ("fluoroscopy", "forces", "record", "show")


def __getattr__(name: str):
    # Lazy, so that `import cathsim_dmc` loads neither dm_control nor torch.
    if name in _FUNCTIONS:
        return getattr(importlib.import_module(f"{__name__}.pictures"), name)
    if name in _SUBMODULES:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_SUBMODULES, *_FUNCTIONS])
