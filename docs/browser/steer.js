/** The page on which a visitor steers a catheter, in real time. */

import loadMujoco from "./vendor/mujoco.js";
import { Canvases } from "./canvases.js";
import { Controls, KEYS, commandOf } from "./controls.js";
import { FluoroscopyScreen, GlassView, Trace } from "./drawing.js";
import { Gamepads } from "./gamepad.js";
import { Headset } from "./headset.js";
import { fetched, loadFluoroscope, loadVessel, picture } from "./scene.js";
import { Simulation } from "./simulation.js";
import { Steering } from "./state.js";

const HEADSET_HELP = [
  "Left stick or triggers push and pull, right stick bends",
  "(as seen from the front). A straightens, B resets.",
  "Grip: hold the arch; both grips: turn and scale it.",
  "A stick pressed: true size, in front of you.",
];

const element = (id) => document.getElementById(id);

/** A state, and the view of it on this page. */
class Page {
  constructor(folder, views, state, canvases) {
    Object.assign(this, { folder, views, state, canvases, running: true });
  }

  /** Called for every frame of the screen; a headset has frames of its own. */
  frame(now, headset) {
    if (!this.running) return;
    if (!headset.presenting) {
      this.state.advance(now);
      this.canvases.draw(this.state.readings);
    }
    requestAnimationFrame((next) => this.frame(next, headset));
  }

  /** What a headset shows, see `Headset`. */
  async shown() {
    const vessel = await loadVessel(this.folder, this.views);
    const { state, canvases } = this;
    return { state, vessel, screen: canvases.screen, help: HEADSET_HELP };
  }
}

function listen(page) {
  const buttons = [...document.querySelectorAll("[data-command]")];
  const show = (command, held) =>
    buttons
      .filter((button) => button.dataset.command === command)
      .forEach((button) => button.classList.toggle("held", held));
  const act = (command, down) => {
    show(command, down);
    if (down) page().state.press(command);
    else page().state.controls.release(command);
  };
  addEventListener("keydown", (event) => {
    const command = commandOf(event);
    if (event.target.tagName === "SELECT" || !command) return;
    event.preventDefault();
    if (!event.repeat) act(command, true);
  });
  addEventListener("keyup", (event) => {
    if (event.code in KEYS) act(KEYS[event.code], false);
  });
  addEventListener("blur", () => buttons.forEach((b) => act(b.dataset.command, false)));
  for (const button of buttons) {
    const { command } = button.dataset;
    button.addEventListener("pointerdown", () => act(command, true));
    for (const end of ["pointerup", "pointerleave", "pointercancel"]) {
      button.addEventListener(end, () => act(command, false));
    }
  }
}

async function loadPage(mujoco, name) {
  const folder = `scenes/${name}`;
  const [scene, task, views] = await Promise.all([
    fetched(`${folder}/scene.xml`, "text"),
    fetched(`${folder}/task.json`, "json"),
    fetched(`${folder}/views.json`, "json"),
  ]);
  const glass = await Promise.all(
    views.glass.map(async (view) => {
      const pictures = [view.behind, view.glaze].map((file) =>
        picture(`${folder}/${file}`),
      );
      return new GlassView(element(view.name), view, ...(await Promise.all(pictures)));
    }),
  );
  const screen = new FluoroscopyScreen(
    element("fluoroscopy"),
    await loadFluoroscope(folder, views),
    views.fluoroscopy.noise,
  );
  const trace = new Trace(element("trace"), 318, 120);
  const simulation = new Simulation(mujoco, scene, task);
  const state = new Steering(simulation, new Controls(task.tip_joints), [new Gamepads()]);
  return new Page(folder, views, state, new Canvases(glass, screen, trace));
}

async function main() {
  const [mujoco, names] = await Promise.all([
    loadMujoco(),
    fetched("scenes/scenes.json", "json"),
  ]);
  const asked = new URLSearchParams(location.search).get("task");
  const select = element("task");
  select.innerHTML = names.map((name) => `<option>${name}</option>`).join("");
  select.value = names.includes(asked) ? asked : names[0];
  let page = null;
  const headset = new Headset(element("headset"), () => page.shown());
  const open = async () => {
    await headset.leave();
    const name = select.value;
    const loaded = await loadPage(mujoco, name);
    if (name !== select.value) return; // another one was chosen meanwhile
    if (page) page.running = false;
    page = loaded;
    globalThis.cathsim = { state: page.state, headset, steers: true }; // for tests, and for the curious
    requestAnimationFrame((now) => page.frame(now, headset));
    select.blur();
  };
  select.addEventListener("change", open);
  await open();
  await headset.offer();
  listen(() => page);
}

main().catch((error) => {
  element("message").textContent = error.message;
  element("message").className = "bad";
  throw error;
});
