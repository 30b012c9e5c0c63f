/**
 * Replays actions in MuJoCo's WebAssembly build and writes what happened as JSON.
 *
 *   node replay.mjs MUJOCO.js SCENE_DIRECTORY ACTIONS.json OUT.json
 *
 * ACTIONS.json: (T, A) numbers. OUT.json: heads (T, 3) m, forces and milliseconds of
 * every control step, N.
 */

import { readFile, writeFile } from "node:fs/promises";
import { pathToFileURL } from "node:url";
import { Simulation } from "./simulation.js";

const [mujocoPath, folder, actionsPath, out] = process.argv.slice(2);
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
};
for (const action of actions) {
  const start = performance.now();
  simulation.step(action);
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
