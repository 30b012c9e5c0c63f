/**
 * The buttons "Enter VR" and "Enter AR", and the WebXR session that they begin. three.js is
 * loaded when a session begins, and not before.
 */

import { FELT, leaning, pressed, strength } from "./gamepad.js";

const MODES = { "immersive-vr": "VR", "immersive-ar": "AR" };
// Buttons of the controllers' mapping "xr-standard".
const [TRIGGER, SQUEEZE, STICK] = [0, 1, 3];
const BUTTONS = { 4: "straight", 5: "restart", [STICK]: "place" }; // A and X, B and Y
const RELEASED = { value: 0, pressed: false };

/** Two controllers as one gamepad, see `gamepad.js`. */
export class XRHands {
  constructor(session) {
    this.session = session;
    this.down = new Set();
  }

  /** Controllers with sticks: [left, right], each null where there is none. */
  get pads() {
    if (this.session.visibilityState !== "visible") return [null, null];
    const sources = [...(this.session.inputSources ?? [])];
    return ["left", "right"].map(
      (hand) =>
        sources.find(({ handedness, gamepad }) => handedness === hand && gamepad)?.gamepad,
    );
  }

  poll(controls, press) {
    const [left, right] = this.pads;
    const stick = (pad) => [pad?.axes[2] ?? 0, pad?.axes[3] ?? 0];
    const buttons = new Array(8).fill(RELEASED);
    [left, right].forEach((pad, hand) => {
      buttons[6 + hand] = pad?.buttons[TRIGGER] ?? RELEASED;
    });
    controls.leaning.set(this, leaning({ axes: [...stick(left), ...stick(right)], buttons }));
    const held = [left, right].filter(Boolean);
    this.down = pressed(BUTTONS, held, this.down, press);
  }

  /** Whether each hand grips: [left, right]. */
  get grips() {
    return this.pads.map((pad) => Boolean(pad?.buttons[SQUEEZE]?.pressed));
  }

  feel(force) {
    for (const pad of this.pads) {
      pad?.hapticActuators?.[0]?.pulse(strength(force), FELT)?.catch?.(() => {});
    }
  }
}

export class Headset {
  /**
   * @param {HTMLElement} place Where the buttons go.
   * @param {() => Promise<object>} load Called when a session begins; gives what the room
   *   shows: `state` (with `readings`, `advance`, `controls` and `hands`), `vessel`, the
   *   fluoroscopy `screen`, and `help`, lines of text.
   */
  constructor(place, load) {
    Object.assign(this, { place, load });
    this.session = null;
    this.room = null;
    this.frames = 0; // drawn in this session
  }

  /** Shows a button for each kind of session that this browser has. */
  async offer() {
    if (!globalThis.isSecureContext) {
      this.place.textContent = "VR and AR need https, or localhost";
    }
    for (const [mode, name] of Object.entries(MODES)) {
      if (!(await navigator.xr?.isSessionSupported(mode).catch(() => false))) continue;
      const button = document.createElement("button");
      button.textContent = `Enter ${name}`;
      button.dataset.mode = mode;
      button.addEventListener("click", () => {
        this.enter(mode).catch((error) => {
          this.place.title = button.title = error.message;
          button.textContent = `No ${name}: ${error.message}`;
          this.leave();
        });
      });
      this.place.append(button);
    }
  }

  get presenting() {
    return this.session !== null;
  }

  async leave() {
    await this.session?.end();
  }

  async enter(mode) {
    if (this.presenting) return;
    // Asked for at once: a browser grants it only soon after a click.
    const session = await navigator.xr.requestSession(mode, {
      requiredFeatures: ["local-floor"],
    });
    this.session = session;
    session.addEventListener("end", () => this.ended());
    const [{ Room }, shown] = await Promise.all([import("./room.js"), this.load()]);
    if (this.session !== session) return; // it has ended meanwhile
    this.state = shown.state;
    this.hands = new XRHands(session);
    this.state.hands.push(this.hands);
    this.room = new Room(shown, mode === "immersive-ar");
    this.frames = 0;
    await this.room.begin(session, () => this.frame());
  }

  frame() {
    const { state, hands, room, session } = this;
    if (session.visibilityState === "visible") state.advance(performance.now());
    if (hands.down.has("place")) room.place();
    room.hold(hands.grips);
    room.draw(state.readings);
    this.frames += 1;
  }

  ended() {
    if (this.state) {
      this.state.hands = this.state.hands.filter((hand) => hand !== this.hands);
      this.state.controls.leaning.delete(this.hands);
    }
    this.room?.end();
    this.session = this.room = this.state = this.hands = null;
  }
}
