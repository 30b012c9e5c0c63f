"""Writes the files that the pages under docs/browser/ load; `make site` runs it.

    python docs/scripts/browser.py [SITE]

Writes into SITE/browser (build/site/browser): MuJoCo's WebAssembly build and three.js
from the npm registry, at the versions and checksums of docs/browser/package-lock.json;
the web viewer of the installed rerun-sdk, as only it reads recordings of its version;
the scenes that `cathsim export` writes, with pictures and surfaces of their vessels;
and recordings of policies that ship. None of these files is in the repository.
"""

import argparse
import json
import re
import shutil
import socket
import subprocess
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import rerun_cli
from PIL import Image

from cathsim_dmc import agents, suite  # agents must be imported before dm_control
from cathsim_dmc.agents.evaluation import EVALUATION_SEED
from cathsim_dmc.agents.policies import task_and_options
from cathsim_dmc.anatomy.scan.topology import decimated
from cathsim_dmc.imaging import materials
from cathsim_dmc.imaging.angiograph import Angiograph
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.physics import forces
from cathsim_dmc.physics.drives import hold
from cathsim_dmc.pictures import record
from cathsim_dmc.pictures.anatomies import background
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.simulation.mjcf import write_mjcf

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "browser"
SCENES = ("type1_lcca", "type1_bca", "type2_lcca", "femoral_type1_lcca")
SEED = 3
GLASS_HEIGHT = 620  # px
VESSEL_FACES = 10_000  # of the surface in a headset
DEVICE_RADIUS = 0.835e-3  # m, of the published device
# The blur of the detector, a quarter of a pixel here, is left out.
FLUOROSCOPY = FluoroscopyOptions(size=480, magnification=1.2, kerma=2e-7, blur=0.0)
# Files of npm packages that the pages load, and their licences.
VENDOR = {
    "@mujoco/mujoco": ("mujoco.js", "mujoco.wasm"),
    "three": ("build/three.module.js", "build/three.core.js"),
}
# Files that Rerun's own server serves to a browser.
PATIENCE = 30.0  # s
VIEWER = ("index.html", "re_viewer.js", "re_viewer_bg.wasm", "favicon.ico")
POLICY = (
    '<meta http-equiv="Content-Security-Policy" '
    "content=\"connect-src 'self' blob: data:\" />"
)


class Recording(NamedTuple):
    """An episode that the pages play; a task of None is the policy's own."""

    name: str
    title: str
    policy: str
    task: str | None = None
    seed: int = EVALUATION_SEED
    steps: int | None = None  # at most


RECORDINGS = (
    Recording("type1_bca", "Type I, BCA", "pretrained:type1_bca"),
    Recording("type1_lcca", "Type I, LCCA", "pretrained:type1_lcca"),
    Recording("type2_lcca", "Type II, LCCA", "pretrained:type2_lcca"),
    Recording("femoral", "From the groin", "expert", "femoral_type1_lcca", 3),
    Recording("jam", "A straight push jams", "push", "type1_lcca", 0, 150),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("site", nargs="?", type=Path, default=ROOT / "build" / "site")
    site = parser.parse_args().site
    out = site / "browser"
    if not (out / "steer.html").is_file():
        raise SystemExit(f"{out} holds no pages; run `make docs` first")
    write_vendor(out / "vendor")
    for name in SCENES:
        write_scene(name, out / "scenes" / name)
    (out / "scenes" / "scenes.json").write_text(json.dumps(SCENES))
    write_recordings(out / "recordings")
    write_viewer(out / "viewer", out / "recordings")
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    print(f"{out}: {size / 1e6:.0f} MB")
    print(f"python -m http.server --directory {site}  # and open browser/index.html")


class ExportedScene:
    """A scene that `cathsim export` wrote, from the start of its episode on.

    Attributes:
        model, data: MuJoCo model and data.
        wall_force: wall force of the last control step.
    """

    def __init__(self, folder: Path):
        self._task = json.loads((folder / "task.json").read_text())
        self.model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = self._task["qpos"]
        mujoco.mj_forward(self.model, self.data)
        self._drives = hold(self.model, self.data)
        self._order = [self.model.actuator(name).id for name in self._task["actuators"]]
        kinds = self.model.actuator_dyntype[self._order]
        self._driven = kinds == mujoco.mjtDyn.mjDYN_INTEGRATOR.value
        sensor = self.model.sensor(self._task["sensors"]["wall_contacts"])
        self._row = slice(sensor.adr[0], sensor.adr[0] + sensor.dim[0])

    def step(self, action: np.ndarray) -> None:
        """Does a control step with an action (A,) in [-1, 1]."""
        action = np.clip(action, -1.0, 1.0)
        self.data.ctrl[self._order] = action
        self._drives.follow(action[None, self._driven])
        rows = []
        for _ in range(self._task["substeps"]):
            mujoco.mj_step(self.model, self.data)
            rows.append(self.data.sensordata[self._row].copy())
        found, _ = forces.wall_force(np.array([rows]))
        self.wall_force = forces.WallForce(*(value[0] for value in found))

    @property
    def head(self) -> np.ndarray:
        """Position (3,) of the head, m."""
        return self.data.site(self._task["head"]).xpos.copy()


def write_vendor(out: Path) -> None:
    """Writes MuJoCo's WebAssembly build and three.js, as in the lock file."""
    modules = install(production=True)
    out.mkdir(parents=True, exist_ok=True)
    for package, files in VENDOR.items():
        for name in files:
            shutil.copy(modules / package / name, out)
        for name in ("package.json", "LICENSE"):
            if (path := modules / package / name).is_file():
                shutil.copy(path, out / f"{package.split('/')[-1]}.{name}")


def install(production: bool = False) -> Path:
    """Installs the npm packages of the lock file; returns their folder."""
    if shutil.which("npm") is None:
        raise SystemExit("the pages in the browser need Node.js with npm 10 or newer")
    folder = ROOT / "build" / ("npm" if production else "npm-test")
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("package.json", "package-lock.json"):
        shutil.copy(PAGES / name, folder / name)
    command = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund"]
    command += ["--omit=dev"] if production else []
    subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    return folder / "node_modules"


def write_scene(name: str, out: Path) -> None:
    """Writes the scene of a task, and the static layers of its pictures."""
    shutil.rmtree(out, ignore_errors=True)
    write_mjcf(name, out, seed=SEED)
    surface = suite.make_task(name).scene.anatomy.surface
    views = {"glass": [], "fluoroscopy": _fluoroscopy(surface, out)}
    views["vessel"] = _vessel(surface, out)
    for view in ("front", "left"):
        projection, drawn = background(surface, view, GLASS_HEIGHT)
        rows, columns = projection.shape
        files = {}
        for layer in ("behind", "glaze"):
            files[layer] = f"{view}_{layer}.webp"
            pixels = np.round(255 * getattr(drawn, layer)).astype(np.uint8)
            Image.fromarray(pixels).save(out / files[layer], quality=85)
        views["glass"].append(
            {
                "name": view,
                **files,
                "rows": rows,
                "columns": columns,
                "right": projection.right.tolist(),
                "up": projection.up.tolist(),
                "low": projection.low.tolist(),
                "high": projection.high.tolist(),
                "pixels": projection.pixels,
            }
        )
    (out / "views.json").write_text(json.dumps(views))
    print(f"{name}: {sum(p.stat().st_size for p in out.iterdir()) / 1e6:.1f} MB")


def _vessel(surface, out: Path) -> dict:
    """Writes the decimated lumen: float32 vertices, m, then uint32 faces."""
    vertices, faces = decimated(surface.vertices, surface.faces, VESSEL_FACES)
    with (out / "vessel.bin").open("wb") as file:
        file.write(vertices.astype("<f4").tobytes())
        file.write(faces.astype("<u4").tobytes())
    return {"file": "vessel.bin", "vertices": len(vertices)}


def _fluoroscopy(surface, out: Path) -> dict:
    """Geometry of the AP view; writes the signal behind patient and vessel."""
    options = FLUOROSCOPY
    plane = Angiograph(surface, options).planes()[0]
    arm = plane.carm
    plane.signal.astype("<f4").tofile(out / "signal.bin")
    rows, columns = arm.resolution
    return {
        "signal": "signal.bin",
        "rows": rows,
        "columns": columns,
        "focal": arm.focal_length,
        "axes": arm.axes.tolist(),
        "source": arm.source.tolist(),
        "gain": plane.gain,
        "window": _window(plane),
        "device_mu": materials.CATHETER,
        "marker_mu": materials.MARKER,
        "marker_length": materials.MARKER_LENGTH,
        "noise": plane.quanta**-0.5,
    }


def _window(plane) -> list[float]:
    """Signals that are shown as black and as white.

    Black is that of a device across the densest part of the vessel.
    """
    device = np.exp(-materials.CATHETER * 2 * DEVICE_RADIUS)
    return [0.97 * float(plane.signal.min() * device), 1.02 * float(plane.signal.max())]


def write_recordings(out: Path) -> None:
    """Writes recordings of policies that ship, of the expert and of a failure."""
    out.mkdir(parents=True, exist_ok=True)
    listed = [write_recording(out, each) for each in RECORDINGS]
    (out / "recordings.json").write_text(json.dumps(listed, indent=1))


def write_recording(out: Path, one: Recording) -> dict[str, str]:
    """Writes a recording for Rerun and a headset; returns its entry in the list."""
    path = out / f"{one.name}.rrd"
    player = agents.load_policy(one.policy, one.seed)
    limit = {"max_steps": one.steps} if one.steps else {}
    played, options = task_and_options(player, one.task, limit)
    if played not in SCENES:
        raise SystemExit(f"{one.name} plays {played}, whose scene is not in SCENES")
    options["observation"] = player.observation or "internal"
    env = suite.load("cathsim", played, options)
    episode = record(env, player, path, seed=one.seed)
    write_states(episode, one.title, env.task.scene.goal.name, path)
    largest = 1e3 * episode.wall_force_max.max()
    command = f"cathsim record {one.policy} --seed {one.seed} --out {path.name}"
    command += f" --task {one.task}" if one.task else ""
    command += f" --max-steps {one.steps}" if one.steps else ""
    text = (
        f"{episode.task}, {one.policy}: {episode.termination} after {episode.steps} "
        f"steps of 40 ms, largest contact {largest:.0f} mN. Made by: {command}"
    )
    print(f"{path.name}: {path.stat().st_size / 1e6:.1f} MB")
    entry = {"name": one.name, "title": one.title, "file": path.name, "text": text}
    return {**entry, "scene": played}


def write_states(episode: Episode, title: str, goal: str, path: Path) -> None:
    """Writes the episode for a headset as PATH.json and PATH.bin.

    docs/browser/playback.js reads them. Series of the control steps begin with a zero
    for the start, so that all series have an entry for each state.
    """
    meta, states = episode.meta, episode.steps + 1
    contacts: list[list] = [[] for _ in range(states)]
    for step, position, force in zip(
        episode.contact_step,
        episode.contact_position,
        episode.contact_force,
        strict=True,
    ):
        magnitude = float(np.linalg.norm(force))
        each = {"position": position.tolist(), "force": force.tolist()}
        contacts[step + 1].append({**each, "magnitude": magnitude})
    ended = f"{episode.termination} after {episode.time[-1] - episode.time[0]:.1f} s"
    values = {
        "title": title,
        "message": f"{title}: {ended}",
        "mood": "good" if episode.success else "bad",
        "goal": {
            "name": goal,
            "position": meta["goal_position"],
            "radius": meta["goal_radius"],
        },
        "radius": float(episode.radii[0]),
        "timestep": meta["control_timestep"],
        "joints": episode.catheter.shape[1],
        "time": (episode.time - episode.time[0]).tolist(),
        "inserted": episode.insertion.tolist(),
        "push": [0.0, *episode.push_force.tolist()],
        "sum": [0.0, *episode.wall_force_sum.tolist()],
        "max": [0.0, *episode.wall_force_max.tolist()],
        "peaks": [0.0, *meta["wall_force_peak_max"]],
        "contacts": contacts,
    }
    path.with_suffix(".json").write_text(json.dumps(values))
    episode.catheter.astype("<f4").tofile(path.with_suffix(".bin"))


def write_viewer(out: Path, recordings: Path) -> None:
    """Writes the web viewer of the installed rerun-sdk, taken from its own server."""
    out.mkdir(parents=True, exist_ok=True)
    with socket.socket() as page, socket.socket() as data:
        for each in (page, data):
            each.bind(("127.0.0.1", 0))
        ports = [each.getsockname()[1] for each in (page, data)]
    recording = next(iter(sorted(recordings.glob("*.rrd"))))
    # The program itself is started: `python -m rerun_cli` would leave it running.
    program = Path(rerun_cli.__file__).with_name("rerun")
    command = [str(program), str(recording), "--serve-web"]
    command += ["--bind", "127.0.0.1", "--web-viewer-port", str(ports[0])]
    command += ["--port", str(ports[1])]
    server = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        for name in VIEWER:
            (out / name).write_bytes(_fetched(f"http://127.0.0.1:{ports[0]}/{name}"))
    finally:
        server.terminate()
        server.wait()
    # The page must not contact other servers: fonts have a fallback, and the viewer
    # must not send usage statistics or look for a later release.
    page = (out / "index.html").read_text()
    page = re.sub(r"<link\b[^>]*fonts\.(googleapis|gstatic)\.com[^>]*>", "", page)
    page, count = re.subn(r"(<head>)", rf"\1\n    {POLICY}", page, count=1)
    if not count:
        raise SystemExit("Rerun's page has no <head> to put a policy into")
    (out / "index.html").write_text(page)


def _fetched(address: str) -> bytes:
    """Content of a file of a server that is starting; waits `PATIENCE` for it."""
    until = time.monotonic() + PATIENCE
    while True:
        try:
            with urllib.request.urlopen(address, timeout=PATIENCE) as answer:
                return answer.read()
        except urllib.error.HTTPError as error:
            raise SystemExit(f"Rerun's viewer has no {address}: {error}") from error
        except OSError as error:
            if time.monotonic() > until:
                raise SystemExit(f"Rerun's viewer did not start: {error}") from error
            time.sleep(0.2)


if __name__ == "__main__":
    assert agents  # imported for the order of imports
    main()
