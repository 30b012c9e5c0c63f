"""The pages in the browser: what they are made of, and what they compute."""

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "docs" / "browser"
# Told where npm's packages are: `npm ci` in a copy of docs/browser.
needs_node = pytest.mark.skipif(shutil.which("npm") is None, reason="needs Node.js")
CHROMIUM = shutil.which("chromium")


def test_everything_from_npm_has_a_version_and_a_checksum():
    package = json.loads((PAGES / "package.json").read_text())
    wanted = {**package["dependencies"], **package["devDependencies"]}
    locked = json.loads((PAGES / "package-lock.json").read_text())["packages"]
    del locked[""]
    for name, version in wanted.items():
        assert re.fullmatch(r"\d+\.\d+\.\d+", version), f"{name} is not pinned"
        assert locked[f"node_modules/{name}"]["version"] == version
    for name, entry in locked.items():
        assert entry["integrity"].startswith("sha512-"), name
        assert "resolved" not in entry, f"{name} names the place it came from"


def test_pages_load_nothing_from_elsewhere():
    for path in (*PAGES.glob("*.html"), *PAGES.glob("*.js"), *PAGES.glob("*.css")):
        assert "//" not in re.sub(r"^\s*//.*|\s// .*", "", path.read_text(), flags=re.M)


def test_keys_do_what_those_of_the_window_do():
    from cathsim_dmc.play.controls import BEND_RATE, HELD, ONCE

    text = (PAGES / "controls.js").read_text()
    keys = re.findall(r'(?:Key|Arrow)?(\w+): "\w+"', text)
    ours = {key.lower() for key in (*HELD, *ONCE)} - {"a", "d", "escape"}
    assert {key.lower() for key in keys} == ours
    assert f"const BEND_RATE = {BEND_RATE:g};" in text


@needs_node
def test_a_gamepad_holds_what_that_of_the_window_holds(tmp_path):
    """The page's mapping, dead zone and vibration are those of `play.hands`."""
    from cathsim_dmc.play import hands
    from cathsim_dmc.play.controls import Controls

    shutil.copy(PAGES / "gamepad.js", tmp_path / "gamepad.mjs")
    shutil.copy(PAGES / "controls.js", tmp_path / "controls.mjs")
    code = """
import { Gamepads, leaning, strength, withoutRest } from "./gamepad.mjs";
import { Controls } from "./controls.mjs";
const buttons = [..."0123456789"].map(() => ({ value: 0, pressed: false }));
const pad = { connected: true, mapping: "standard", axes: [0.3, -0.5, 0.9, -0.2],
              buttons };
Object.defineProperty(globalThis, "navigator", { value: { getGamepads: () => [pad] } });
const controls = new Controls(2), gamepads = new Gamepads(), pressed = [];
gamepads.poll(controls, (command) => pressed.push(command));
const action = [...controls.action(0.04)];
buttons[0].pressed = buttons[9].pressed = true;
gamepads.poll(controls, (command) => pressed.push(command));
gamepads.poll(controls, (command) => pressed.push(command));
pad.connected = false;
gamepads.poll(controls, (command) => pressed.push(command));
controls.restart();
const shares = [-1, -0.5, -0.1, 0, 0.15, 0.6, 1].map(withoutRest);
console.log(JSON.stringify({ action, pressed, shares, still: [...controls.action(0.04)],
  strengths: [-1, 0, 0.015, 0.5, 1.5, 9].map(strength) }));
"""
    (tmp_path / "run.mjs").write_text(code)
    done = subprocess.run(
        ["node", tmp_path / "run.mjs"], capture_output=True, text=True, check=True
    )
    page = json.loads(done.stdout)

    class Pad:
        help = ""

        def read(self):
            ours = {"w": 0.5, "Up": 0.2, "Right": 0.9}
            return {key: hands.without_rest(one) for key, one in ours.items()}, set()

    controls = Controls(2, hand=Pad())
    controls.poll()
    np.testing.assert_allclose(page["action"], controls.action(0.04), rtol=1e-6)
    assert page["pressed"] == ["straight", "restart"] and not any(page["still"])
    given = [-1, -0.5, -0.1, 0, 0.15, 0.6, 1]
    np.testing.assert_allclose(page["shares"], [*map(hands.without_rest, given)])
    given = [-1, 0, 0.015, 0.5, 1.5, 9]
    np.testing.assert_allclose(page["strengths"], [*map(hands.strength, given)])


@pytest.fixture(scope="module")
def builder():
    """The script that makes what the pages need."""
    spec = importlib.util.spec_from_file_location(
        "browser", ROOT / "docs" / "scripts" / "browser.py"
    )
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script


@pytest.fixture(scope="module")
def scene(builder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "type1_lcca"
    builder.write_scene("type1_lcca", folder)
    return folder


@pytest.mark.slow
@needs_node
def test_webassembly_moves_and_draws_as_python_does(builder, scene, tmp_path):
    from cathsim_dmc import suite
    from cathsim_dmc.imaging.angiograph import Angiograph
    from cathsim_dmc.imaging.device import Shadow

    rng = np.random.RandomState(0)
    actions = rng.uniform(-1, 1, (25, 21))
    actions[:, 20] = 1.0  # on into the arch
    (tmp_path / "actions.json").write_text(json.dumps(actions.tolist()))
    module = builder.install(production=True) / "@mujoco" / "mujoco" / "mujoco.js"
    out, image = tmp_path / "out.json", tmp_path / "image.bin"
    command = ["node", PAGES / "replay.mjs", module, scene, tmp_path / "actions.json"]
    subprocess.run([*command, out, image], check=True)
    page = json.loads(out.read_text())
    exported = builder.ExportedScene(scene)
    heads, forces = [], []
    for action in actions:
        exported.step(action)
        heads.append(exported.head)
        forces.append(float(exported.wall_force.peak_max))
    # Until a contact is found otherwise they agree to the last digits of a float64;
    # two versions of MuJoCo find some otherwise.
    apart = np.linalg.norm(np.array(heads) - page["head"], axis=1)
    assert np.median(apart) < 1e-9 and apart.max() < 0.5e-3
    assert max(forces) > 0.0
    np.testing.assert_allclose(page["peak_max"], forces, atol=0.02)
    surface = suite.make_task("type1_lcca").scene.anatomy.surface
    options = builder.FLUOROSCOPY
    plane = Angiograph(surface, options).planes()[0]
    device = Shadow(np.array(page["line"]), builder.DEVICE_RADIUS)
    drawn = plane.render([device])[..., 0]
    grey = np.frombuffer(image.read_bytes(), np.uint8).reshape(drawn.shape)
    assert np.abs(grey.astype(int) - drawn).max() <= 1
    assert grey.std() > 1


@pytest.mark.slow
@needs_node
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_visitor_steers(builder, scene, tmp_path):
    site = tmp_path / "browser"
    shutil.copytree(PAGES, site)
    shutil.copytree(scene, site / "scenes" / "type1_lcca")
    (site / "scenes" / "scenes.json").write_text('["type1_lcca"]')
    builder.write_mujoco(site / "vendor")
    modules = builder.install()
    server = subprocess.Popen(
        [sys.executable, "-u", "-m", "http.server", "0", "--bind", "127.0.0.1"],
        cwd=site,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        port = re.search(r"port (\d+)", server.stdout.readline()).group(1)
        picture = tmp_path / "page.png"
        address = f"http://127.0.0.1:{port}/steer.html"
        visit = ["node", PAGES / "visit.mjs", modules, address, picture]
        done = subprocess.run(
            [*visit, "KeyW:2", "KeyW+ArrowRight:1", "Pad:1"],
            capture_output=True,
            text=True,
            check=False,
        )
    finally:
        server.terminate()
        server.wait()
    assert done.returncode == 0, done.stderr[-3000:]
    seen = json.loads(done.stdout)
    assert not seen["errors"]
    assert seen["seconds"] > 0.5 and seen["felt"] > 0
    # It was pushed at 40 mm/s for about as long as it was simulated.
    assert (
        0.3 * 0.04 * seen["seconds"] < seen["inserted"] < 0.04 * seen["seconds"] + 0.01
    )
    assert picture.stat().st_size > 50_000
