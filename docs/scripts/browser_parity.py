"""Compares the page in the browser with Python: same scene and actions, step by step.

    python docs/scripts/browser_parity.py

Plays episodes of the task, and replays their actions in the scene of `cathsim export`,
in Python and in MuJoCo's WebAssembly build (Node.js); writes
docs/images/browser_parity.png and docs/data/browser_parity.json, and the table of
docs/browser/index.md.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

import browser  # imports torchrl before dm_control
import figures
import mujoco

from cathsim_dmc import suite
from cathsim_dmc.agents import load_policy
from cathsim_dmc.imaging.angiograph import Angiograph
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.pictures.anatomies import Picture
from cathsim_dmc.pictures.recorded import as_function
from cathsim_dmc.style import COLOURS, tidy

DOCS = browser.ROOT / "docs"
TASK, SEED = "type1_lcca", browser.SEED
# Name, policy and most control steps.
EPISODES = (
    ("random actions", "random", 150),
    ("scripted expert", "expert", 300),
    ("learnt policy", "pretrained:type1_lcca", 300),
    ("straight push into a jam", "push", 150),
)


def main() -> None:
    module = browser.install(production=True) / "@mujoco" / "mujoco" / "mujoco.js"
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene"
        browser.write_scene(TASK, scene)
        measured = [
            compared(name, policy, steps, module, scene)
            for name, policy, steps in EPISODES
        ]
    draw(measured, DOCS / "images" / "browser_parity.png")
    values = {
        **figures.origin("python docs/scripts/browser_parity.py"),
        "task": TASK,
        "seed": SEED,
        "python": mujoco.__version__,
        "webassembly": measured[0]["version"],
        "episodes": [row(each) for each in measured],
    }
    text = json.dumps(values, indent=1) + "\n"
    (DOCS / "data" / "browser_parity.json").write_text(text)
    write_table(values, DOCS / "browser" / "index.md")


def compared(name: str, policy: str, steps: int, module: Path, scene: Path) -> dict:
    """An episode of the task, and its actions replayed in Python and the browser."""
    played = play(policy, steps)
    actions, out = scene.parent / "actions.json", scene.parent / "out.json"
    image = scene.parent / "image.bin"
    actions.write_text(json.dumps(played["action"]))
    script = browser.PAGES / "replay.mjs"
    command = ["node", script, module, scene, actions, out, image]
    subprocess.run(command, check=True)
    replayed = json.loads(out.read_text())
    grey = np.frombuffer(image.read_bytes(), np.uint8).astype(int)
    return {
        "name": name,
        "version": replayed["version"],
        "task": {key: np.array(value) for key, value in played.items()},
        "python": replay(scene, played["action"]),
        "browser": {
            key: np.array(value)
            for key, value in replayed.items()
            if isinstance(value, list)
        },
        "image": np.abs(grey - drawn(replayed["line"]).ravel()).max(),
    }


def play(policy: str, steps: int) -> dict[str, list]:
    """Actions, heads and success of an episode of the suite."""
    player = load_policy(policy, SEED)
    kwargs = {"random": SEED, "observation": player.observation or "tracking"}
    env = suite.load("cathsim", TASK, kwargs)
    act = as_function(player, env, SEED)
    timestep = env.reset()
    kept: dict[str, list] = {name: [] for name in ("action", "head", "success")}
    while not timestep.last() and len(kept["head"]) < steps:
        action = np.array(act(timestep), dtype=np.float64)
        timestep = env.step(action)
        kept["action"].append(action.tolist())
        kept["head"].append(env.task.readings.head.tolist())
        kept["success"].append(env.task.termination == "success")
    return kept


def replay(scene: Path, actions: list) -> dict[str, np.ndarray]:
    """Heads, forces and step times of the exported scene in Python."""
    exported = browser.ExportedScene(scene)
    kept: dict[str, list] = {"head": [], "peak_max": [], "milliseconds": []}
    for action in np.array(actions):
        start = time.process_time()
        exported.step(action)
        kept["milliseconds"].append(1e3 * (time.process_time() - start))
        kept["head"].append(exported.head)
        kept["peak_max"].append(exported.wall_force.peak_max)
    return {name: np.array(values) for name, values in kept.items()}


def drawn(line: list) -> np.ndarray:
    """Fluoroscopy (rows, columns) of a device, with the options of the page."""
    surface = suite.make_task(TASK).scene.anatomy.surface
    plane = Angiograph(surface, browser.FLUOROSCOPY).planes()[0]
    shadow = Shadow(np.array(line), browser.DEVICE_RADIUS)
    return plane.render([shadow])[..., 0].astype(int)


def row(each: dict) -> dict:
    """Comparison of an episode, as JSON values."""
    python, page = each["python"], each["browser"]
    apart = 1e3 * np.linalg.norm(python["head"] - page["head"], axis=1)
    task = 1e3 * np.linalg.norm(each["task"]["head"] - page["head"], axis=1)
    force = 1e3 * np.abs(python["peak_max"] - page["peak_max"])
    spent = page["processor_milliseconds"]
    return {
        "name": each["name"],
        "steps": len(apart),
        "success": [bool(each["task"]["success"][-1]), bool(page["success"][-1])],
        "head_mm": [float(np.median(apart)), float(apart.max()), float(apart[-1])],
        "task_mm": [float(np.median(task)), float(task.max()), float(task[-1])],
        "largest_mN": [
            float(1e3 * python["peak_max"].max()),
            float(1e3 * page["peak_max"].max()),
        ],
        "force_difference_mN": [float(np.median(force)), float(force.max())],
        "grey_levels": int(each["image"]),
        "milliseconds": [float(np.median(spent)), float(np.quantile(spent, 0.95))],
        "python_milliseconds": float(np.median(python["milliseconds"])),
    }


def draw(measured: list[dict], path: Path) -> None:
    """Draws tip path, distance of the tips and force of every episode."""
    figure = Picture(figsize=(11, 2.5 * len(measured)), layout="constrained", dpi=100)
    axes = figure.subplots(
        len(measured), 3, squeeze=False, width_ratios=[0.8, 1.2, 1.2]
    )
    for line, each in zip(axes, measured, strict=True):
        python, page = each["python"], each["browser"]
        time_s = 0.04 * np.arange(1, len(python["head"]) + 1)
        for heads, dashes, colour, label in (
            (python, "-", COLOURS[0], "Python"),
            (page, "--", COLOURS[1], "WebAssembly"),
        ):
            look = {"ls": dashes, "color": colour, "label": label}
            x, _, z = 1e3 * heads["head"].T
            line[0].plot(x, z, lw=1.8, **look)
            line[2].plot(time_s, 1e3 * heads["peak_max"], lw=1.4, **look)
        apart = 1e3 * np.linalg.norm(python["head"] - page["head"], axis=1)
        line[1].semilogy(time_s, np.maximum(apart, 1e-15), color="0.25", lw=1.4)
        line[1].set_ylim(1e-15, 10)
        line[0].set_aspect("equal", adjustable="datalim")
        line[0].set_title(each["name"], fontsize=10, loc="left")
        line[0].set(xlabel="x of the head, mm", ylabel="z, mm")
        line[1].set(xlabel="time, s", ylabel="heads apart, mm")
        line[2].set(xlabel="time, s", ylabel="largest contact, mN")
        for one in line:
            tidy(one)
    axes[0, 0].legend(frameon=False, fontsize=8)
    figure.savefig(path)


def write_table(values: dict, page: Path) -> None:
    """Writes the results into the page, between its two markers."""
    lines = [
        f"{figures.since(values)} `{TASK}`, seed "
        f"{SEED}; MuJoCo {values['python']} in Python, {values['webassembly']} in "
        "WebAssembly (Node.js). A control step is 40 ms; times are of the processor.",
        "",
        "| episode | control steps | heads apart, mm: median / largest / at the end "
        "| from the task, the same | success: task / WebAssembly "
        "| largest contact, mN: Python / WebAssembly | control step, ms: median / 95 % "
        "| the same in Python, ms |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for each in values["episodes"]:
        apart = " / ".join(f"{value:.2g}" for value in each["head_mm"])
        task = " / ".join(f"{value:.2g}" for value in each["task_mm"])
        success = " / ".join("yes" if one else "no" for one in each["success"])
        force = " / ".join(f"{value:.2f}" for value in each["largest_mN"])
        spent = " / ".join(f"{value:.1f}" for value in each["milliseconds"])
        lines.append(
            f"| {each['name']} | {each['steps']} | {apart} | {task} | {success} | "
            f"{force} | {spent} | {each['python_milliseconds']:.1f} |"
        )
    figures.put(page, measured=lines)


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    main()
