/** A gamepad beside the keys, as `cathsim play --hands gamepad` has it; force vibrates. */

// As in cathsim_dmc/play/hands.py.
const DEAD_ZONE = 0.15; // share of an axis that rest and wear move it by
const FULL_FORCE = 1.5; // N, of the strongest vibration; the strength grows as the root
export const FELT = 100; // ms, of a vibration; a control step begins the next one
const BUTTONS = { 0: "straight", 9: "restart" }; // A and Start

const clamp = (value) => Math.min(Math.max(value, -1), 1);

/** A reading in [-1, 1] without the dead zone, which is 0. */
export function withoutRest(value) {
  const beyond = (Math.abs(value) - DEAD_ZONE) / (1 - DEAD_ZONE);
  return Math.sign(value) * clamp(Math.max(beyond, 0));
}

/** Strength in [0, 1] of the vibration of a contact force, N. */
export function strength(force) {
  return Math.min(Math.sqrt(Math.max(force, 0) / FULL_FORCE), 1);
}

/** What a gamepad of the standard mapping holds: shares by axis of the controls. */
export function leaning(pad) {
  const [, leftY = 0, rightX = 0, rightY = 0] = pad.axes.map(withoutRest);
  const trigger = (number) => withoutRest(pad.buttons[number]?.value ?? 0);
  return {
    translation: clamp(-leftY + trigger(7) - trigger(6)),
    bendX: -rightY,
    bendY: rightX,
  };
}

/**
 * Commands of the buttons that are down; `press` is called once for each that goes down.
 * @param {object} buttons Commands by number of a button.
 * @param {Gamepad[]} pads
 * @param {Set} before Commands that were down.
 */
export function pressed(buttons, pads, before, press) {
  const held = (number) => pads.some((pad) => pad.buttons[number]?.pressed);
  const down = new Set(
    Object.keys(buttons)
      .filter(held)
      .map((number) => buttons[number]),
  );
  down.forEach((command) => before.has(command) || press(command));
  return down;
}

export class Gamepads {
  constructor() {
    this.down = new Set();
  }

  /** The first gamepad with the standard mapping, or null. */
  get pad() {
    const pads = [...(navigator.getGamepads?.() ?? [])];
    return pads.find((pad) => pad?.connected && pad.mapping === "standard") ?? null;
  }

  /** Read it into controls; `press` is called once for a button that goes down. */
  poll(controls, press) {
    const { pad } = this;
    controls.leaning.set(this, pad ? leaning(pad) : {});
    this.down = pressed(BUTTONS, pad ? [pad] : [], this.down, press);
  }

  /** Vibrate with the largest contact force, N, where the gamepad can. */
  feel(force) {
    const strongMagnitude = strength(force);
    this.pad?.vibrationActuator
      ?.playEffect("dual-rumble", {
        duration: FELT,
        strongMagnitude,
        weakMagnitude: Math.max(0, 2 * strongMagnitude - 1),
      })
      ?.catch(() => {}); // a gamepad without motors
  }
}
