/**
 * Replays actions in MuJoCo's WebAssembly build and writes what happened as JSON.
 *
 *   node replay.mjs MUJOCO.js SCENE_DIRECTORY ACTIONS.json OUT.json [IMAGE.bin]
 *
 * ACTIONS.json: (T, A) numbers. OUT.json: of every control step the head (3,), m,
 * forces, N, and the milliseconds that it took by the clock and of the processor.
 * IMAGE.bin: fluoroscopy of the last state without noise, a byte for each pixel.
 */

import { readFile, writeFile } from "node:fs/promises";
import { pathToFileURL } from "node:url";
import { Fluoroscope } from "./fluoroscopy.js";
import { Simulation } from "./simulation.js";

const [mujocoPath, folder, actionsPath, out, imagePath] = process.argv.slice(2);
const { default: loadMujoco } = await import(pathToFileURL(mujocoPath).href);
const mujoco = await loadMujoco();
const text = (path) => readFile(path, "utf8");
const task = JSON.parse(await text(`${folder}/task.json`));
const actions = JSON.parse(await text(actionsPath));
const started = performance.now();
const simulation = new Simulation(mujoco, await text(`${folder}/scene.xml`), task);
const result = {
  load_milliseconds: performance.now() - started,
  version: mujoco.mj_versionString(),
  head: [],
  line: [],
  sum: [],
  max: [],
  peak_max: [],
  push: [],
  load_cell: [],
  success: [],
  milliseconds: [],
  processor_milliseconds: [],
};
for (const action of actions) {
  const start = performance.now();
  const before = process.cpuUsage();
  simulation.step(action);
  const { user, system } = process.cpuUsage(before);
  result.processor_milliseconds.push((user + system) / 1e3);
  result.milliseconds.push(performance.now() - start);
  result.head.push(simulation.headPosition);
  result.sum.push(simulation.wall.sum);
  result.max.push(simulation.wall.max);
  result.peak_max.push(simulation.wall.peakMax);
  result.push.push(simulation.pushForce);
  result.load_cell.push(simulation.loadCell);
  result.success.push(simulation.success);
}
result.line = simulation.line;
await writeFile(out, JSON.stringify(result));

if (imagePath) {
  const { fluoroscopy } = JSON.parse(await text(`${folder}/views.json`));
  const signal = await readFile(`${folder}/${fluoroscopy.signal}`);
  const fluoroscope = new Fluoroscope(fluoroscopy, new Float32Array(signal.buffer, signal.byteOffset, signal.length / 4));
  const pixels = new Uint8ClampedArray(4 * fluoroscopy.rows * fluoroscopy.columns);
  fluoroscope.render(simulation.line, task.device_radius, pixels);
  await writeFile(imagePath, pixels.filter((_, i) => i % 4 === 0));
}
