/**
 * A recorded episode that plays, with the readings of a state that is steered (state.js).
 * The file is made from the episode that Rerun's recording is made from.
 */

import { CATCH_UP } from "./state.js";

export class Playback {
  /**
   * @param {object} episode Content of NAME.json beside a recording: `goal`, `radius`,
   *   `timestep`, `joints`, `message`, `mood`, and series over the states.
   * @param {Float32Array} lines Joints of all states, (T + 1, joints, 3), m.
   */
  constructor(episode, lines) {
    Object.assign(this, { episode, lines });
    this.controls = { leaning: new Map() };
    this.hands = [];
    this.restart();
  }

  restart() {
    this.at = 0;
    this.clock = null;
    this.paused = false;
    this.read();
  }

  press(command) {
    if (command === "restart") this.restart();
    if (command === "straight") this.paused = !this.paused;
  }

  /** @param {number} now Milliseconds, of `performance.now`. */
  advance(now) {
    for (const hand of this.hands) {
      hand.poll(this.controls, (command) => this.press(command));
    }
    const period = 1e3 * this.episode.timestep;
    this.clock ??= now;
    const passed = Math.floor((now - this.clock) / period);
    this.clock += passed * period;
    const steps = Math.min(passed, CATCH_UP);
    if (this.paused || steps < 1 || this.ended) return;
    this.at = Math.min(this.at + steps, this.episode.time.length - 1);
    for (const hand of this.hands) hand.feel(this.episode.max[this.at]);
    this.read();
  }

  get ended() {
    return this.at === this.episode.time.length - 1;
  }

  read() {
    const { at, episode, lines, ended } = this;
    const { goal, radius, timestep, joints } = episode;
    const first = 3 * joints * at;
    const line = Array.from({ length: joints }, (_, joint) =>
      [...lines.subarray(first + 3 * joint, first + 3 * joint + 3)],
    );
    const head = line[joints - 1];
    /** @type {import("./state.js").Readings} */
    this.readings = {
      goal,
      radius,
      timestep,
      line,
      ended,
      time: episode.time[at],
      contacts: episode.contacts[at],
      distance: Math.hypot(...goal.position.map((x, axis) => x - head[axis])),
      inserted: episode.inserted[at],
      push: episode.push[at],
      wall: { sum: episode.sum[at], max: episode.max[at], peakMax: episode.peaks[at] },
      peaks: episode.peaks.slice(1, at + 1),
      message: ended ? episode.message : episode.title,
      mood: ended ? episode.mood : "",
    };
  }
}
