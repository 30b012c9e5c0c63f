/** The view of a state on the page: canvases and the table of figures. */

import { figures } from "./drawing.js";

const element = (id) => document.getElementById(id);

export class Canvases {
  /**
   * @param {GlassView[]} glass
   * @param {FluoroscopyScreen} screen
   * @param {Trace} trace
   */
  constructor(glass, screen, trace) {
    Object.assign(this, { glass, screen, trace, drawn: null });
  }

  /** Draws a state's readings, if they are others than before. */
  draw(readings) {
    if (readings === this.drawn) return;
    this.drawn = readings;
    for (const view of [...this.glass, this.screen, this.trace]) view.draw(readings);
    const { message, mood, ended } = readings;
    const keys = ended ? "Press R to reset." : "Push with W, bend with the arrow keys.";
    element("message").textContent = `${message} ${keys}`;
    element("message").className = mood;
    element("readout").innerHTML = figures(readings)
      .map(([name, value]) => `<tr><td>${name}</td><td>${value}</td></tr>`)
      .join("");
  }
}
