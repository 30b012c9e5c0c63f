/**
 * The state of an episode that is steered, without any drawing. Views (drawing.js, room.js)
 * draw its `readings` and nothing else; a recording that plays has the same (playback.js).
 * SI units, world frame (patient frame LPS).
 *
 * @typedef {object} Readings
 * @property {object} goal `name`, `position` [x, y, z] and `radius`, m.
 * @property {number} radius Of the device, m.
 * @property {number} timestep Of a control step, s.
 * @property {number} time Since the start of the episode, s.
 * @property {number[][]} line Joints of the device from base to head, m.
 * @property {object[]} contacts `position`, m, `force` on the wall and `magnitude`, N.
 * @property {number} distance Straight from head to goal, m.
 * @property {number} inserted Insertion of the base, m.
 * @property {number} push Axial force of the drive on the device, N.
 * @property {object} wall Forces on the wall, N: `sum`, `max` and `peakMax`.
 * @property {number[]} peaks Largest contact of every control step so far, N.
 * @property {number[]} [bend] Deflection of the tip about x and y, shares of the full one.
 * @property {number} [pace] Simulated by real time of a control step; 0 before the first.
 * @property {boolean} ended Whether the episode has.
 * @property {string} message What is to be done, or how it ended.
 * @property {string} mood "good", "bad" or "".
 */

export const CATCH_UP = 3; // control steps at most that one frame of the screen makes up for

export class Steering {
  /**
   * @param {Simulation} simulation
   * @param {Controls} controls
   * @param {object[]} hands Each polls into controls and feels the contact, as `Gamepads`.
   */
  constructor(simulation, controls, hands) {
    Object.assign(this, { simulation, controls, hands });
    this.milliseconds = 0; // of a control step, a running mean
    this.restart();
  }

  restart() {
    const { simulation, controls } = this;
    simulation.reset();
    controls.restart();
    this.peaks = [];
    this.ended = false;
    this.clock = null;
    this.say(`Bring the head into the ${simulation.task.goal.name.toUpperCase()}.`);
  }

  press(command) {
    if (command === "restart") this.restart();
    else this.controls.press(command);
    this.read();
  }

  /** A control step with what the hands hold. */
  step() {
    const { simulation, controls } = this;
    const start = performance.now();
    simulation.step(controls.action(simulation.task.control_timestep));
    const spent = performance.now() - start;
    this.milliseconds += (spent - this.milliseconds) / Math.min(simulation.steps, 25);
    this.peaks.push(simulation.wall.peakMax);
    for (const hand of this.hands) hand.feel(simulation.wall.max);
    if (simulation.success) {
      this.end(`Reached after ${simulation.time.toFixed(1)} s.`, "good");
    } else if (simulation.failed) {
      this.end("The physics failed.", "bad");
    } else if (simulation.steps >= simulation.task.max_steps) {
      this.end("Out of time.", "bad");
    }
  }

  end(text, mood) {
    this.ended = true;
    this.say(text, mood);
  }

  say(text, mood = "") {
    this.message = text;
    this.mood = mood;
    this.read();
  }

  /**
   * Reads the hands and makes as many control steps as the clock asks.
   * @param {number} now Milliseconds, of `performance.now`.
   */
  advance(now) {
    const period = 1e3 * this.simulation.task.control_timestep;
    for (const hand of this.hands) {
      hand.poll(this.controls, (command) => this.press(command));
    }
    this.clock ??= now;
    let steps = 0;
    while (!this.ended && now - this.clock >= period && steps < CATCH_UP) {
      this.clock += period;
      this.step();
      steps += 1;
    }
    // A machine that cannot keep pace runs slower and does not catch up later.
    if (now - this.clock > period) this.clock = now - period;
    if (steps) this.read();
  }

  /** Writes `readings`, a new object whenever something changed. */
  read() {
    const { simulation, milliseconds } = this;
    const { task } = simulation;
    /** @type {Readings} */
    this.readings = {
      goal: task.goal,
      radius: task.device_radius,
      timestep: task.control_timestep,
      time: simulation.time,
      line: simulation.line,
      contacts: simulation.contacts(),
      distance: simulation.distance,
      inserted: simulation.inserted,
      push: simulation.pushForce,
      wall: simulation.wall,
      peaks: this.peaks,
      bend: this.controls.bend,
      pace: milliseconds && (1e3 * task.control_timestep) / milliseconds,
      ended: this.ended,
      message: this.message,
      mood: this.mood,
    };
  }
}
