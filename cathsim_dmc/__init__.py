"""Endovascular navigation tasks on dm_control composer and MuJoCo."""

import importlib

__version__ = "0.1.0"

_SUBMODULES = (
    "agents",
    "analysis",
    "anatomy",
    "entities",
    "imaging",
    "recording",
    "simulation",
    "suite",
    "tasks",
)


def __getattr__(name: str):
    # Lazy, so that `import cathsim_dmc` loads neither dm_control nor torch.
    if name in _SUBMODULES:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_SUBMODULES])
