/** The page on which a visitor steers a catheter by keyboard, in real time. */

import loadMujoco from "./vendor/mujoco.js";
import { Controls, KEYS } from "./controls.js";
import { GlassView, Trace } from "./drawing.js";
import { Fluoroscope } from "./fluoroscopy.js";
import { Gamepads } from "./gamepad.js";
import { Simulation } from "./simulation.js";

const element = (id) => document.getElementById(id);
const mN = (force) => `${(1e3 * force).toFixed(1)} mN`;
const mm = (length) => `${(1e3 * length).toFixed(1)} mm`;

class Page {
  constructor(mujoco, scene, task, views) {
    this.simulation = new Simulation(mujoco, scene, task);
    this.controls = new Controls(task.tip_joints);
    this.gamepads = new Gamepads();
    this.views = views;
    this.trace = new Trace(element("trace"), 318, 120);
    this.milliseconds = 0; // of a control step, a running mean
    this.running = true;
    this.restart();
  }

  restart() {
    this.simulation.reset();
    this.controls.restart();
    this.trace.clear();
    this.ended = false;
    this.clock = null;
    this.say(`Bring the head into the ${this.simulation.task.goal.name.toUpperCase()}: `
      + "push with W, bend with the arrow keys.");
    this.draw();
  }

  /** A control step with what the hands hold. */
  step() {
    const { simulation, controls } = this;
    const start = performance.now();
    simulation.step(controls.action(simulation.task.control_timestep));
    const spent = performance.now() - start;
    this.milliseconds += (spent - this.milliseconds) / Math.min(simulation.steps, 25);
    this.trace.add(simulation.wall.peakMax);
    this.gamepads.feel(simulation.wall.max);
    if (simulation.success) {
      this.end(`Reached after ${simulation.time.toFixed(1)} s. Press R to reset.`, "good");
    } else if (simulation.failed) {
      this.end("The physics failed. Press R to reset.", "bad");
    } else if (simulation.steps >= simulation.task.max_steps) {
      this.end("Out of time. Press R to reset.", "bad");
    }
  }

  end(text, mood) {
    this.ended = true;
    this.say(text, mood);
  }

  say(text, mood = "") {
    element("message").textContent = text;
    element("message").className = mood;
  }

  /** Called for every frame of the screen: steps as many times as the clock asks. */
  frame(now) {
    if (!this.running) return;
    const period = 1e3 * this.simulation.task.control_timestep;
    this.clock ??= now;
    this.gamepads.poll(this.controls, (command) => this.press(command));
    let steps = 0;
    while (!this.ended && now - this.clock >= period && steps < 3) {
      this.clock += period;
      this.step();
      steps += 1;
    }
    // A machine that cannot keep pace runs slower and does not catch up later.
    if (now - this.clock > period) this.clock = now - period;
    if (steps) this.draw();
    requestAnimationFrame((next) => this.frame(next));
  }

  draw() {
    const { simulation, views } = this;
    views.glass.forEach((view) => view.draw(simulation));
    drawFluoroscopy(views, simulation);
    this.trace.draw(simulation.task.control_timestep);
    const factor = (1e3 * simulation.task.control_timestep) / this.milliseconds;
    const rows = [
      ["goal", simulation.task.goal.name.toUpperCase()],
      ["time", `${simulation.time.toFixed(1)} s`],
      ["to the goal", mm(simulation.distance)],
      ["inserted", mm(simulation.inserted)],
      ["push force", mN(simulation.pushForce)],
      ["on the wall, sum", mN(simulation.wall.sum)],
      ["largest contact", mN(simulation.wall.max)],
      ["its peak in the step*", mN(simulation.wall.peakMax)],
      ["tip, about x / y", this.controls.bend.map((b) => b.toFixed(2)).join(" / ")],
      ["physics", this.milliseconds ? `${factor.toFixed(1)}× real time` : "–"],
    ];
    element("readout").innerHTML = rows
      .map(([name, value]) => `<tr><td>${name}</td><td>${value}</td></tr>`)
      .join("");
  }

  press(command) {
    if (command === "restart") this.restart();
    else this.controls.press(command);
    if (this.ended) this.draw();
  }
}

function drawFluoroscopy({ fluoroscope, screen, noise }, simulation) {
  const pen = screen.getContext("2d");
  const image = pen.createImageData(screen.width, screen.height);
  fluoroscope.render(
    simulation.line,
    simulation.task.device_radius,
    image.data,
    noise,
    fluoroscope.view.window,
  );
  pen.putImageData(image, 0, 0);
  const { goal } = simulation.task;
  const { pixel, depth } = fluoroscope.project(goal.position);
  pen.beginPath();
  pen.arc(...pixel, (goal.radius * fluoroscope.view.focal) / depth, 0, 2 * Math.PI);
  pen.strokeStyle = "#5fd7ac";
  pen.lineWidth = 1.5;
  pen.stroke();
}

function listen(page) {
  const buttons = [...document.querySelectorAll("[data-command]")];
  const show = (command, held) =>
    buttons
      .filter((button) => button.dataset.command === command)
      .forEach((button) => button.classList.toggle("held", held));
  const act = (command, down) => {
    show(command, down);
    if (down) page().press(command);
    else page().controls.release(command);
  };
  addEventListener("keydown", (event) => {
    if (event.target.tagName === "SELECT" || !(event.code in KEYS)) return;
    event.preventDefault();
    if (!event.repeat) act(KEYS[event.code], true);
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

async function picture(path) {
  const image = new Image();
  image.src = path;
  await image.decode();
  return image;
}

async function fetched(path, kind) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(`${path}: ${answer.status}; \`make site\` makes it`);
  return answer[kind]();
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
  const { fluoroscopy } = views;
  const signal = await fetched(`${folder}/${fluoroscopy.signal}`, "arrayBuffer");
  const screen = element("fluoroscopy");
  [screen.width, screen.height] = [fluoroscopy.columns, fluoroscopy.rows];
  return new Page(mujoco, scene, task, {
    glass,
    screen,
    noise: fluoroscopy.noise,
    fluoroscope: new Fluoroscope(fluoroscopy, new Float32Array(signal)),
  });
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
  const open = async () => {
    if (page) page.running = false;
    page = await loadPage(mujoco, select.value);
    globalThis.cathsim = page; // for tests, and for the curious
    requestAnimationFrame((now) => page.frame(now));
    select.blur();
  };
  select.addEventListener("change", open);
  await open();
  listen(() => page);
}

main().catch((error) => {
  element("message").textContent = error.message;
  element("message").className = "bad";
  throw error;
});
