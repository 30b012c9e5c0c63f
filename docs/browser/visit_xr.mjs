/**
 * Visits a page in headless Chromium with an emulated headset (the Immersive Web Emulation
 * Runtime), enters a session, and says what came of it.
 *
 *   node visit_xr.mjs NODE_MODULES ADDRESS vr|ar PICTURE.png [HAND.INPUT=VALUE[,…]:SECONDS …]
 *
 * Each argument holds inputs of the controllers for some simulated seconds, at least four frames:
 * "right.trigger=1:2", "right.x=-0.5,left.y=-1:3" (axes of the sticks), "left.a=1:0.2"
 * (buttons trigger, squeeze, stick, a, b); controllers move after that:
 * "right.squeeze=1,right.move=0.1/0/0:0.2" (m). PICTURE.png shows what the headset does at
 * the end. Prints a JSON object: the state at first, after every argument, in the picture and after the session,
 * scripts of three.js that were loaded before and in the session, and errors of the page.
 */

import { writeFile } from "node:fs/promises";
import { visiting } from "./headless.mjs";

const WIDTH = Number(process.env.WIDTH ?? 480); // px; wider pictures take a CPU longer
const [modules, address, mode, picture, ...inputs] = process.argv.slice(2);
const AXES = { x: "x-axis", y: "y-axis" };
const BUTTONS = {
  trigger: ["trigger", "trigger"],
  squeeze: ["squeeze", "squeeze"],
  stick: ["thumbstick", "thumbstick"],
  a: ["x-button", "a-button"],
  b: ["y-button", "b-button"],
};

/** In the page: a headset of a person of 1.6 m, controllers in front of the chest. */
function emulate() {
  const headset = new globalThis.IWER.XRDevice(globalThis.IWER.metaQuest3);
  headset.installRuntime({ forceInstall: true }); // Chromium has one, without a headset
  headset.stereoEnabled = false;
  headset.fovy = 1; // rad, narrower than a headset's: for the picture
  headset.position.set(0, 1.6, 0);
  headset.quaternion.set(-Math.sin(0.09), 0, 0, Math.cos(0.09)); // looks down
  headset.controllers.left.position.set(-0.16, 1.4, -0.38);
  headset.controllers.right.position.set(0.16, 1.4, -0.38);
  globalThis.emulated = headset;
}

/** "HAND.INPUT=VALUE[,…]:SECONDS" as inputs that are held, and controllers that move. */
function parsed(text) {
  const [what, seconds] = text.split(":");
  const all = what.split(",").map((each) => {
    const [, hand, input, value] = /^(left|right)\.(\w+)=(.+)$/.exec(each) ?? [];
    if (input === "move") return { hand, move: value.split("/").map(Number) };
    const [axis, button] = [AXES[input], BUTTONS[input]?.[hand === "left" ? 0 : 1]];
    if (!axis && !button) throw new Error(`${each} is no input of a controller`);
    return { hand, axis, button, value: Number(value) };
  });
  const [held, moves] = [all.filter(({ move }) => !move), all.filter(({ move }) => move)];
  return { held, moves, seconds: Number(seconds) };
}

/**
 * In the page: holds inputs one after the other, and ends the session. All of it happens
 * there, because a busy browser answers questions from outside late.
 */
async function played(inputs) {
  const { headset } = globalThis.cathsim;
  while (headset.frames < 3) await new Promise(requestAnimationFrame);
  const { room, state } = headset;
  const set = ({ hand, button, axis, value, move }) => {
    const controller = globalThis.emulated.controllers[hand];
    if (move) {
      const { x, y, z } = controller.position;
      controller.position.set(x + move[0], y + move[1], z + move[2]);
    } else if (axis) controller.updateAxis("thumbstick", axis, value);
    else controller.updateButtonValue(button, value);
  };
  const until = async (reached) => {
    while (!reached()) await new Promise(requestAnimationFrame);
  };
  const drawn = (frames) => {
    const last = headset.frames + frames;
    return until(() => headset.frames >= last);
  };
  const passed = (seconds) => {
    const last = state.readings.time + seconds;
    return until(() => state.readings.ended || state.readings.time >= last);
  };
  // Pixels of a picture of the one view that is shown.
  const pixel = (point) => {
    const eye = room.renderer.xr.getCamera().cameras[0];
    const times = ({ elements }, vector) =>
      [0, 1, 2, 3].map((i) => vector.reduce((sum, x, j) => sum + elements[i + 4 * j] * x, 0));
    const [x, y, , w] = times(eye.projectionMatrix, times(eye.matrixWorldInverse, [...point, 1]));
    const { width, height } = room.renderer.domElement;
    return [(width * (1 + x / w)) / 2, (height * (1 - y / w)) / 2];
  };
  const observed = () => {
    const { line, time, inserted, distance, bend, goal } = state.readings;
    const { presenting, frames, session } = headset;
    const seen = { time, inserted, distance, bend, presenting, frames };
    if (!presenting) return seen;
    const places = room.patient.inRoom([line[line.length - 1], goal.position]);
    return {
      ...seen,
      visibility: session.visibilityState,
      places, // of head and goal in the room, m
      pixels: places.map(pixel),
      scale: room.patient.group.scale.x,
    };
  };
  /** The next frame of the headset, as a PNG in base64. */
  const picture = () => {
    const { renderer } = room;
    const { render } = renderer;
    return new Promise((resolve) => {
      renderer.render = (...given) => {
        renderer.render = render;
        render.apply(renderer, given);
        resolve([observed(), renderer.domElement.toDataURL().split(",")[1]]);
      };
    });
  };
  const states = [observed()];
  for (const { held, moves, seconds } of inputs) {
    held.forEach(set);
    await drawn(2);
    moves.forEach(set);
    await drawn(2);
    if (seconds > 0) await passed(seconds);
    states.push(observed());
    held.forEach((each) => set({ ...each, value: 0 }));
  }
  const [last, png] = await picture();
  await headset.leave();
  if (globalThis.cathsim.steers) await passed(0.2); // the page goes on
  states.push(last, observed());
  return { states, png };
}

const result = await visiting(modules, { width: WIDTH, height: WIDTH / 1.5 }, async (page, seen) => {
  page.setDefaultTimeout(540_000);
  const three = () => seen.requests.filter((url) => url.includes("/three.")).length;
  await page.addInitScript({ path: `${modules}/iwer/build/iwer.min.js` });
  await page.addInitScript(emulate);
  await page.goto(address);
  const button = page.locator(`button[data-mode="immersive-${mode}"]`);
  await button.waitFor();
  const before = three();
  await button.click();
  await page.waitForFunction(() => globalThis.cathsim?.headset.presenting);
  const { states, png } = await page.evaluate(played, inputs.map(parsed));
  await writeFile(picture, Buffer.from(png, "base64"));
  return { states, three: [before, three()] };
});
console.log(JSON.stringify(result));
