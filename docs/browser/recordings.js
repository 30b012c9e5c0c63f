/** The page that opens recordings in Rerun's web viewer, and plays them in a headset. */

import { FluoroscopyScreen } from "./drawing.js";
import { Headset } from "./headset.js";
import { Playback } from "./playback.js";
import { fetched, loadFluoroscope, loadVessel } from "./scene.js";

const HEADSET_HELP = [
  "A pauses, B begins anew.",
  "Grip: hold the arch; both grips: turn and scale it.",
  "A stick pressed: true size, in front of you.",
];

const viewer = document.getElementById("viewer");
const about = document.getElementById("about");
const list = document.getElementById("list");

let shown = null; // entry of recordings.json

function open(recording) {
  shown = recording;
  const { name, file, text } = recording;
  const address = new URL(`recordings/${file}`, location.href).href;
  const options = new URLSearchParams({ url: address, hide_welcome_screen: "1" });
  viewer.src = `viewer/index.html?${options}`;
  about.textContent = text;
  for (const button of list.children) {
    button.setAttribute("aria-current", button.dataset.name === name);
  }
  history.replaceState(null, "", `#${name}`);
}

/** What a headset shows of the recording that is open, see `Headset`. */
async function played() {
  const { name, scene } = shown;
  const folder = `scenes/${scene}`;
  const [episode, lines, views] = await Promise.all([
    fetched(`recordings/${name}.json`, "json"),
    fetched(`recordings/${name}.bin`, "arrayBuffer"),
    fetched(`${folder}/views.json`, "json"),
  ]);
  const screen = new FluoroscopyScreen(
    document.createElement("canvas"),
    await loadFluoroscope(folder, views),
    views.fluoroscopy.noise,
  );
  const state = new Playback(episode, new Float32Array(lines));
  globalThis.cathsim = { state, headset }; // for tests, and for the curious
  return { state, vessel: await loadVessel(folder, views), screen, help: HEADSET_HELP };
}

const headset = new Headset(document.getElementById("headset"), played);

async function main() {
  const recordings = await fetched("recordings/recordings.json", "json");
  for (const recording of recordings) {
    const button = document.createElement("button");
    button.textContent = recording.title;
    button.dataset.name = recording.name;
    button.addEventListener("click", () => open(recording));
    list.append(button);
  }
  const asked = location.hash.slice(1);
  open(recordings.find(({ name }) => name === asked) ?? recordings[0]);
  await headset.offer();
}

main().catch((error) => {
  about.textContent = error.message;
});
