"""`cathsim doctor`, `validate` and `benchmark`: what is installed, physics, speed."""

import dataclasses
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

from cathsim_dmc.cli.options import (
    CHECK_FAILED,
    Json,
    print_json,
    require_png,
    say,
    show,
)
from cathsim_dmc.laws.capsule import nearest_places

_OWN = "cathsim-dmc"
# A context alone does not fail where there is no display.
_OPENGL = (
    "import mujoco as m; "
    "m.Renderer(m.MjModel.from_xml_string('<mujoco/>'), 8, 8).render()"
)


class Finding(NamedTuple):
    """One line of the report; `note` says what to do about it."""

    name: str
    value: str
    passed: bool = True
    note: str = ""


def doctor(json: Json = False) -> int:
    """Check versions, threads, compiled kernels and OpenGL; list remedies."""
    threads = os.environ.get("OMP_NUM_THREADS", "not set")
    advice = "" if threads == "1" else "set it to 1 where several processes run"
    findings = [
        Finding("Python", platform.python_version(), sys.version_info >= (3, 11)),
        *_versions(),
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


def _versions() -> list[Finding]:
    try:
        required, own = metadata.requires(_OWN) or (), metadata.version(_OWN)
    except metadata.PackageNotFoundError:
        advice = "in its checkout: pip install -c constraints.txt -e ."
        return [Finding(_OWN, "not installed", False, advice)]
    found = [Finding(_OWN, own)]
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
    advice = (
        ""
        if works
        else "rgb, depth and viewers need it: set MUJOCO_GL to egl or osmesa"
    )
    setting = os.environ.get("MUJOCO_GL", "not set")
    found = f"{'works' if works else 'none'} (MUJOCO_GL {setting})"
    return Finding("OpenGL", found, note=advice)


@dataclasses.dataclass(frozen=True)
class Protocol:
    """Of `forces`: a cannulation against a normal distribution, as published.

    Attributes:
        episode: Recorded cannulation (.npz), such as a manual one of `cathsim play
            --out`; by default one of the expert.
        mean: Mean of the normal distribution, N; the published one is unverified.
        sd: Its standard deviation, N.
        margin: Means closer than this count as equal, N.
        figure: PNG of the density and cumulative plots to write.
    """

    episode: Path | None = None
    mean: float = 0.4
    sd: float = 0.02
    margin: float = 0.1
    figure: Path | None = None


def validate(
    part: Annotated[
        Literal["rod", "pair", "wall", "rest", "vessel", "forces", "bench"],
        conf.Positional,
    ],
    /,
    data: Path | None = None,
    json: Json = False,
    *,
    protocol: Annotated[Protocol, conf.arg(name="")] = Protocol(),  # noqa: B008
) -> int:
    """Compare the physics with theory, or with measured guidewires.

    Args:
        part: rod: rod and drives; pair: coaxial devices; wall: contact with the wall
            and its shape; rest: devices at rest; vessel: flow, wall and motion;
            forces: force sensors; bench: measured guidewires.
        data: Of `bench`: folder with phantom.stl and wires.json (docs/bench.md).
        protocol: Options of `forces`.
    """
    if (data is not None) != (part == "bench"):
        raise ValueError(
            "`validate bench` and it alone takes --data DIR, a folder with phantom.stl "
            "and wires.json (docs/bench.md)"
        )
    if part != "forces" and protocol != Protocol():
        raise ValueError(
            "--episode, --mean, --sd, --margin and --figure are options of `validate "
            "forces` alone"
        )
    if part == "forces":
        return _forces(protocol, json)
    found = importlib.import_module(f"cathsim_dmc.validation.{part}")
    run = getattr(found, f"validate_{part}")
    return show(run(data, say) if part == "bench" else run(), json)


def _forces(options: Protocol, json: bool) -> int:
    from cathsim_dmc import style
    from cathsim_dmc.recording.episode import Episode
    from cathsim_dmc.validation import force_sensors, protocol

    if options.figure is not None:
        require_png(options.figure)
    episode = None if options.episode is None else Episode.load(options.episode)
    report = force_sensors.validate_forces(
        episode=episode, mean=options.mean, sd=options.sd, margin=options.margin
    )
    code, found = show(report, json), report.findings["protocol"]
    if not json:
        print_json(found)
    if options.figure is not None:
        style.save(protocol.figure(report.data["samples"], found), options.figure)
    return code


def benchmark(
    part: Annotated[Literal["speed"], conf.Positional], /, json: Json = False
) -> int:
    """Measure the speed of the simulator on one core, relative to MuJoCo's.

    Calibrated speeds are real-time factors times the microseconds of one `mj_step` of
    dm_control's humanoid, timed in alternation; takes minutes.

    Args:
        part: What is measured.
    """
    del part
    from cathsim_dmc.validation.pace import speed

    return show(speed(say), json)
