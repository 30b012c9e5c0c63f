/** Loading of the files that `docs/scripts/browser.py` writes for a scene. */

import { Fluoroscope } from "./fluoroscopy.js";

export async function fetched(path, kind) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(`${path}: ${answer.status}; \`make site\` makes it`);
  return answer[kind]();
}

export async function picture(path) {
  const image = new Image();
  image.src = path;
  await image.decode();
  return image;
}

/** The machine of views.json. */
export async function loadFluoroscope(folder, { fluoroscopy }) {
  const signal = await fetched(`${folder}/${fluoroscopy.signal}`, "arrayBuffer");
  return new Fluoroscope(fluoroscopy, new Float32Array(signal));
}

/** The surface of the lumen: `positions` (3 V), m, and `faces` (3 F), vertex numbers. */
export async function loadVessel(folder, { vessel }) {
  const buffer = await fetched(`${folder}/${vessel.file}`, "arrayBuffer");
  const length = 3 * vessel.vertices;
  return {
    positions: new Float32Array(buffer, 0, length),
    faces: new Uint32Array(buffer, 4 * length),
  };
}
