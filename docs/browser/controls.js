/** From keys that are held to the action of a task, as `cathsim play` does it. */

const HELD = {
  push: ["translation", 1],
  pull: ["translation", -1],
  right: ["bendY", 1],
  left: ["bendY", -1],
  up: ["bendX", 1],
  down: ["bendX", -1],
};
const BEND_RATE = 1; // share of the full deflection per second while a key is held

export const KEYS = {
  KeyW: "push",
  KeyS: "pull",
  ArrowRight: "right",
  ArrowLeft: "left",
  ArrowUp: "up",
  ArrowDown: "down",
  Space: "straight",
  KeyR: "restart",
};

/** What a key does; undefined with a modifier, which is the browser's, as in Ctrl+R. */
export function commandOf(event) {
  return event.ctrlKey || event.metaKey || event.altKey ? undefined : KEYS[event.code];
}

export class Controls {
  /** @param {number} tipJoints Steerable joints of the device, two motors each. */
  constructor(tipJoints) {
    this.tipJoints = tipJoints;
    this.restart();
  }

  restart() {
    this.held = new Set();
    this.leaning = new Map(); // shares by axis, of each hand beside the keys
    this.bend = [0, 0];
  }

  press(command) {
    if (command === "straight") this.bend = [0, 0];
    else if (command in HELD) this.held.add(command);
  }

  release(command) {
    this.held.delete(command);
  }

  /** Action of the next control step of a duration in seconds. */
  action(duration) {
    const axes = { translation: 0, bendX: 0, bendY: 0 };
    for (const command of this.held) {
      const [axis, sign] = HELD[command];
      axes[axis] += sign;
    }
    for (const axis of Object.keys(axes)) {
      for (const shares of this.leaning.values()) axes[axis] += shares[axis] ?? 0;
      axes[axis] = Math.min(Math.max(axes[axis], -1), 1);
    }
    this.bend = [axes.bendX, axes.bendY].map((rate, i) =>
      Math.min(Math.max(this.bend[i] + BEND_RATE * duration * rate, -1), 1),
    );
    const action = new Float32Array(2 * this.tipJoints + 1);
    for (let joint = 0; joint < this.tipJoints; joint += 1) {
      action.set(this.bend, 2 * joint);
    }
    action[2 * this.tipJoints] = axes.translation;
    return action;
  }
}
