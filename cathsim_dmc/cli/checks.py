"""`cathsim doctor`, what is installed, and `cathsim validate`, the physics."""

import importlib
import os
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from packaging.requirements import Requirement
from tyro import conf

from cathsim_dmc.cli.options import CHECK_FAILED, Json, print_json, say, show
from cathsim_dmc.laws.capsule import nearest_places

_OPENGL = "import mujoco; mujoco.GLContext(8, 8).make_current()"


class Finding(NamedTuple):
    """One line of the report; `note` says what to do about it."""

    name: str
    value: str
    passed: bool = True
    note: str = ""


def doctor(json: Json = False) -> int:
    """Check versions, threads, compiled kernels and OpenGL; say what to do."""
    threads = os.environ.get("OMP_NUM_THREADS", "not set")
    advice = "" if threads == "1" else "set it to 1 where several processes run"
    findings = [
        Finding("Python", platform.python_version(), sys.version_info >= (3, 11)),
        *_versions("cathsim-dmc"),
        Finding("cores", str(os.cpu_count())),
        Finding("OMP_NUM_THREADS", threads, note=advice),
        _kernels(),
        _opengl(),
    ]
    if json:
        print_json({"checks": [one._asdict() for one in findings]})
    else:
        for name, value, passed, note in findings:
            print("ok  " if passed else "FAIL", f"{name}: {value}", note, sep="  ")
    return 0 if all(one.passed for one in findings) else CHECK_FAILED


def _versions(name: str) -> list[Finding]:
    try:
        required, own = metadata.requires(name) or (), metadata.version(name)
    except metadata.PackageNotFoundError:
        advice = "in its checkout: pip install -c constraints.txt -e ."
        return [Finding(name, "not installed", False, advice)]
    found = [Finding(name, own)]
    for one in map(Requirement, required):
        if one.marker is not None and not one.marker.evaluate({"extra": ""}):
            continue
        try:
            version = metadata.version(one.name)
            good = one.specifier.contains(version, prereleases=True)
        except metadata.PackageNotFoundError:
            version, good = "not installed", False
        advice = "" if good else f"pip install '{one.name}{one.specifier}'"
        found.append(Finding(one.name, version, good, advice))
    return found


def _kernels() -> Finding:
    folder = nearest_places.cache_path
    if folder is None:
        advice = "every process compiles anew; set NUMBA_CACHE_DIR to a folder"
        return Finding("compiled kernels", "not kept", False, advice)
    count = len(list(Path(folder).glob("*.nbi")))
    advice = "" if count else "the first task that is loaded compiles them"
    return Finding("compiled kernels", f"{count} in {folder}", note=advice)


def _opengl() -> Finding:
    command = [sys.executable, "-c", _OPENGL]
    works = not subprocess.run(command, capture_output=True, check=False).returncode
    advice = "" if works else "physics.render and viewers need it: try MUJOCO_GL=egl"
    setting = os.environ.get("MUJOCO_GL", "not set")
    found = f"{'works' if works else 'none'} (MUJOCO_GL {setting})"
    return Finding("OpenGL", found, note=advice)


def validate(
    part: Annotated[
        Literal["rod", "pair", "wall", "vessel", "forces", "bench"], conf.Positional
    ],
    /,
    data: Path | None = None,
    json: Json = False,
) -> int:
    """Compare the physics with theory, or with measured guidewires.

    Args:
        part: Rod and drives; coaxial devices; contact with the wall and its shape;
            flow, wall and motion of the vessel; force sensors; guidewires on a bench.
        data: Of `bench`: folder with phantom.stl and wires.json (docs/bench.md).
    """
    module = "force_sensors" if part == "forces" else part
    found = importlib.import_module(f"cathsim_dmc.validation.{module}")
    run = getattr(found, f"validate_{part}")
    if (data is not None) != (part == "bench"):
        raise ValueError(
            "`validate bench` and it alone takes --data DIR, a folder with phantom.stl "
            "and wires.json (docs/bench.md)"
        )
    if part == "bench":
        return show(run(data, say), json)
    return show(run(), json)
