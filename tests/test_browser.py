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
from PIL import Image

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
import { Controls, commandOf } from "./controls.mjs";
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
const few = leaning({ axes: [0, -1], buttons: [] });
const keys = [{}, { ctrlKey: true }].map((k) => commandOf({ code: "KeyR", ...k }));
console.log(JSON.stringify({ action, pressed, shares, still: [...controls.action(0.04)],
  few, keys,
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
    assert page["few"] == {"translation": 1, "bendX": 0, "bendY": 0}
    assert page["keys"] == ["restart", None]  # Ctrl+R is the browser's
    given = [-1, -0.5, -0.1, 0, 0.15, 0.6, 1]
    np.testing.assert_allclose(page["shares"], [*map(hands.without_rest, given)])
    given = [-1, 0, 0.015, 0.5, 1.5, 9]
    np.testing.assert_allclose(page["strengths"], [*map(hands.strength, given)])


@needs_node
def test_the_curve_of_the_device_has_no_corner(tmp_path):
    """It passes through the joints, and turns by little from piece to piece."""
    shutil.copy(PAGES / "centreline.js", tmp_path / "centreline.mjs")
    angle = 0.4 * np.arange(12)
    helix = np.stack([np.sin(angle), np.cos(angle), angle / 4], axis=1).tolist()
    in_line = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 1, 0]]  # and then bent
    (tmp_path / "run.mjs").write_text(f"""
import {{ smooth }} from "./centreline.mjs";
const lines = {json.dumps([helix, in_line])};
console.log(JSON.stringify(lines.map((line) => smooth(line, 20))));
""")
    done = subprocess.run(
        ["node", tmp_path / "run.mjs"], capture_output=True, text=True, check=True
    )
    for joints, points in zip((helix, in_line), json.loads(done.stdout), strict=True):
        curve = np.array(points)
        np.testing.assert_allclose(curve[::20], joints, atol=1e-12)
        pieces = np.diff(curve, axis=0)
        pieces /= np.linalg.norm(pieces, axis=1, keepdims=True)
        turns = np.arccos(np.clip(np.vecdot(pieces[1:], pieces[:-1]), -1, 1))
        assert turns.max() < np.radians(5)  # the joints of the second turn by 45°


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


needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")


@pytest.fixture(scope="module")
def site(builder, scene, tmp_path_factory):
    """The pages with one scene and one recording: the address of a server of them."""
    folder = tmp_path_factory.mktemp("site") / "browser"
    shutil.copytree(PAGES, folder)
    shutil.copytree(scene, folder / "scenes" / "type1_lcca")
    (folder / "scenes" / "scenes.json").write_text('["type1_lcca"]')
    builder.write_vendor(folder / "vendor")
    (folder / "recordings").mkdir()
    jam = builder.Recording("jam", "A push", "push", "type1_lcca", 0, 100)
    entry = builder.write_recording(folder / "recordings", jam)
    (folder / "recordings" / "recordings.json").write_text(json.dumps([entry]))
    (folder / "viewer").mkdir()
    (folder / "viewer" / "index.html").write_text("Rerun's viewer")
    server = subprocess.Popen(
        [sys.executable, "-u", "-m", "http.server", "0", "--bind", "127.0.0.1"],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    port = re.search(r"port (\d+)", server.stdout.readline()).group(1)
    yield f"http://127.0.0.1:{port}"
    server.terminate()
    server.wait()


def visit(builder, script, *arguments):
    """What a visit of the pages prints, which has no errors of the page."""
    command = ["node", PAGES / script, builder.install(), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    seen = json.loads(done.stdout)
    assert not seen["errors"]
    return seen


@pytest.mark.slow
@needs_node
@needs_chromium
def test_a_visitor_steers(builder, site, tmp_path):
    picture = tmp_path / "page.png"
    keys = ("KeyW:2", "KeyW+ArrowRight:1", "Pad:1")
    seen = visit(builder, "visit.mjs", f"{site}/steer.html", picture, *keys)
    assert seen["seconds"] > 0.5 and seen["felt"] > 0
    # It was pushed at 40 mm/s for about as long as it was simulated.
    assert (
        0.3 * 0.04 * seen["seconds"] < seen["inserted"] < 0.04 * seen["seconds"] + 0.01
    )
    assert picture.stat().st_size > 50_000


def _colour(picture, pixel):
    """RGBA of a picture at a pixel, in [0, 255]."""
    image = Image.open(picture).convert("RGBA")
    return image.getpixel(tuple(round(place) for place in pixel))


@pytest.mark.slow
@needs_node
@needs_chromium
def test_a_visitor_steers_in_an_emulated_headset(builder, site, tmp_path):
    picture = tmp_path / "room.png"
    inputs = (
        "right.trigger=1:1",
        "left.y=1:0.4",  # the stick towards oneself
        "right.x=1:0.4",
        "right.a=1:0.1",
        "right.squeeze=1,right.move=0.05/0/0:0.1",
        "left.stick=1:0.1",
        "left.squeeze=1,right.squeeze=1,left.move=-0.105/0/0,right.move=0.105/0/0:0.1",
    )
    page = f"{site}/steer.html"
    seen = visit(builder, "visit_xr.mjs", page, "vr", picture, *inputs)
    assert seen["three"] == [0, 2]  # three.js is loaded when a session begins
    begun, pushed, pulled, bent, straight, moved, placed, scaled, drawn, left = seen[
        "states"
    ]
    assert begun["presenting"] and begun["visibility"] == "visible"
    assert pushed["inserted"] - begun["inserted"] > 0.02
    assert pulled["inserted"] - pushed["inserted"] < -0.005
    assert bent["bend"][1] > 0.3 and straight["bend"] == [0, 0]
    # At its true size, in front of eyes 1.6 m above the floor.
    head, goal = np.array(begun["places"])
    assert begun["scale"] == 1
    assert np.linalg.norm(head - goal) == pytest.approx(begun["distance"], rel=1e-5)
    assert 0.3 < -goal[2] < 0.55 and 1.3 < goal[1] < 1.7
    # One hand moves the arch, a pressed stick puts it back, two hands scale it.
    goals = [np.array(each["places"][1]) for each in (straight, moved, placed)]
    np.testing.assert_allclose(goals[1] - goals[0], [0.05, 0, 0], atol=1e-4)
    np.testing.assert_allclose(goals[2], goals[0], atol=1e-4)
    assert scaled["scale"] == pytest.approx(0.58 / 0.37, rel=0.02)
    for (red, green, blue, alpha), of_head in zip(
        (_colour(picture, pixel) for pixel in drawn["pixels"]),
        (True, False),
        strict=True,
    ):
        assert alpha == 255
        assert red > green > blue + 30 if of_head else green > red + 10
    # Afterwards the page goes on, without a headset.
    assert not left["presenting"] and left["time"] > drawn["time"]


@pytest.mark.slow
@needs_node
@needs_chromium
def test_a_recording_plays_in_an_emulated_headset(builder, site, tmp_path):
    picture = tmp_path / "room.png"
    page = f"{site}/recordings.html"
    inputs = ("left.a=0:0.4", "right.a=1:0", "right.b=0:0")  # A pauses
    seen = visit(builder, "visit_xr.mjs", page, "ar", picture, *inputs)
    begun, played, paused, still, _, left = seen["states"]
    assert played["inserted"] > begun["inserted"]
    assert still["time"] == paused["time"] and not left["presenting"]
    # The surroundings are seen where nothing is drawn.
    assert _colour(picture, (2, 2))[3] == 0
    apart = np.subtract(*still["places"])
    assert np.linalg.norm(apart) == pytest.approx(still["distance"], rel=1e-5)
