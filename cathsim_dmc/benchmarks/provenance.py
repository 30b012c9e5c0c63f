"""Where a result comes from: code, versions, machine."""

import datetime
import os
import platform
import re
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from cathsim_dmc import __version__

PACKAGES = ("mujoco", "dm-control", "torch", "torchrl", "tensordict", "numpy", "scipy")


def versions() -> dict[str, str]:
    """Versions of Python, this package and those that results depend on."""
    found = {
        "python": platform.python_version(),
        "cathsim-dmc": __version__,
    }
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def commit() -> dict[str, Any]:
    """Commit of the source tree, and whether tracked files differ from it.

    Returns:
        "commit" (None outside a git repository) and "modified".
    """
    head, state = _git("rev-parse", "HEAD"), None
    if head is not None:
        state = _git("status", "--porcelain", "--untracked-files=no")
    return {"commit": head, "modified": None if state is None else bool(state)}


def machine() -> dict[str, Any]:
    """Processor, number of cores that this process may use, memory, system."""
    cores = os.cpu_count()
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    return {
        "processor": _processor(),
        "cores": cores,
        "memory_gib": _memory(),
        "system": platform.system(),
    }


def load() -> float | None:
    """Mean number of running processes over 15 minutes; None where unknown."""
    try:
        return round(os.getloadavg()[2], 2)
    except (AttributeError, OSError):
        return None


def now() -> str:
    """Date and time in UTC, ISO 8601."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def _git(*arguments: str) -> str | None:
    """What git says of the repository that the package lies in."""
    package = Path(__file__).parent
    command = ["git", "-C", str(package), *arguments]
    try:
        # An installed package may lie in a repository that does not know it.
        tracked = ["git", "-C", str(package), "ls-files", "--error-unmatch", "grid.py"]
        subprocess.run(tracked, capture_output=True, check=True, timeout=60)
        done = subprocess.run(
            command, capture_output=True, text=True, check=True, timeout=60
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _processor() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor() or platform.machine()
    found = re.search(r"^model name\s*:\s*(.+)$", text, re.M)
    return found[1].strip() if found else platform.machine()


def _memory() -> float | None:
    try:
        size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None
    return round(size / 2**30, 1)
