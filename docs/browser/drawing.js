/**
 * What is drawn on the canvases, of the readings of a state (state.js): glass views of the
 * vessel, fluoroscopy, the curve of forces, and the figures beside them.
 */

import { smooth } from "./centreline.js";

// Colours and sizes of the things in a scene, for every view.
export const DEVICE = "#173a63";
export const DEVICE_LIGHT = "#7fb2e5";
export const HEAD = "#ffb000";
export const GOAL = "#12805c";
const GOAL_LIGHT = "#5fd7ac";
const FORCE = "#b3202c";
// Colours of a contact from none to the top of the scale, as in the package's figures.
const FORCE_COLOURS = [
  [255, 240, 150],
  [253, 170, 70],
  [225, 65, 40],
  [120, 0, 45],
];
const FORCE_TOP = 0.2; // N, the last colour
const ARROW = 0.022; // m, of a contact of that force
const ARROW_LEAST = 0.004; // m
const PIECES = 8; // of the drawn curve of the device in each link
const THICKER = 1.5; // the device is drawn thicker than it is, to be seen

export function forceColour(force) {
  const place = Math.min(force / FORCE_TOP, 1) * (FORCE_COLOURS.length - 1);
  const lower = Math.min(Math.floor(place), FORCE_COLOURS.length - 2);
  const share = place - lower;
  const mixed = FORCE_COLOURS[lower].map((x, i) =>
    Math.round(x * (1 - share) + FORCE_COLOURS[lower + 1][i] * share),
  );
  return `rgb(${mixed})`;
}

/** Length, m, of the arrow of a contact force, N. */
export function arrowLength(force) {
  return Math.min(Math.max((ARROW * force) / FORCE_TOP, ARROW_LEAST), ARROW);
}

/** A view of the vessel as glass, with the device between its two pictures. */
export class GlassView {
  constructor(canvas, view, behind, glaze) {
    Object.assign(this, { canvas, view, behind, glaze });
    canvas.width = view.columns;
    canvas.height = view.rows;
  }

  pixel(point) {
    const { right, up, low, high, pixels } = this.view;
    const flat = (axis) => axis.reduce((sum, x, i) => sum + x * point[i], 0);
    return [(flat(right) - low[0]) * pixels, (high[1] - flat(up)) * pixels];
  }

  draw({ goal, radius, line: joints, contacts }) {
    const { canvas, view } = this;
    const pen = canvas.getContext("2d");
    pen.clearRect(0, 0, canvas.width, canvas.height);
    pen.drawImage(this.behind, 0, 0);
    const place = this.pixel(goal.position);
    pen.beginPath();
    pen.arc(...place, goal.radius * view.pixels, 0, 2 * Math.PI);
    pen.fillStyle = `${GOAL}38`;
    pen.fill();
    pen.strokeStyle = GOAL;
    pen.lineWidth = 2;
    pen.stroke();
    const line = smooth(joints, PIECES).map((point) => this.pixel(point));
    const width = 2 * radius * THICKER * view.pixels;
    pen.lineCap = pen.lineJoin = "round";
    for (const [colour, share] of [["#fff", 1.5], [DEVICE, 1], [DEVICE_LIGHT, 0.35]]) {
      pen.strokeStyle = colour;
      pen.lineWidth = share * width;
      pen.beginPath();
      for (const point of line) pen.lineTo(...point);
      pen.stroke();
    }
    const head = line[line.length - 1];
    pen.beginPath();
    pen.arc(...head, 0.9 * width, 0, 2 * Math.PI);
    pen.fillStyle = HEAD;
    pen.fill();
    pen.drawImage(this.glaze, 0, 0);
    for (const contact of contacts) this.arrow(pen, contact);
  }

  arrow(pen, { position, force, magnitude }) {
    const start = this.pixel(position);
    const scale = arrowLength(magnitude) / Math.max(magnitude, 1e-9);
    const end = this.pixel(position.map((x, i) => x + scale * force[i]));
    pen.strokeStyle = forceColour(magnitude);
    pen.fillStyle = forceColour(magnitude);
    pen.lineWidth = 2.5;
    pen.beginPath();
    pen.moveTo(...start);
    pen.lineTo(...end);
    pen.stroke();
    pen.beginPath();
    pen.arc(...start, 3, 0, 2 * Math.PI);
    pen.fill();
    pen.lineWidth = 0.7;
    pen.strokeStyle = "#222";
    pen.stroke();
  }
}

/** The X-ray image on a canvas, with the goal as a ring. */
export class FluoroscopyScreen {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {Fluoroscope} fluoroscope
   * @param {number} noise Standard deviation of the noise at signal 1.
   */
  constructor(canvas, fluoroscope, noise) {
    Object.assign(this, { canvas, fluoroscope, noise });
    canvas.width = fluoroscope.view.columns;
    canvas.height = fluoroscope.view.rows;
  }

  draw({ line, radius, goal }) {
    const { canvas, fluoroscope, noise } = this;
    const { window, focal } = fluoroscope.view;
    const pen = canvas.getContext("2d");
    const image = pen.createImageData(canvas.width, canvas.height);
    fluoroscope.render(line, radius, image.data, noise, window);
    pen.putImageData(image, 0, 0);
    const { pixel, depth } = fluoroscope.project(goal.position);
    pen.beginPath();
    pen.arc(...pixel, (goal.radius * focal) / depth, 0, 2 * Math.PI);
    pen.strokeStyle = GOAL_LIGHT;
    pen.lineWidth = 1.5;
    pen.stroke();
  }
}

/** The largest contact over time, mN. */
export class Trace {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {number} width Of the drawing, with letters of 11.
   * @param {number} height
   * @param {number} pixels Of the canvas for each unit of these.
   */
  constructor(canvas, width, height, pixels = 1) {
    canvas.width = width * pixels;
    canvas.height = height * pixels;
    Object.assign(this, { canvas, width, height, pixels });
  }

  draw({ peaks, timestep }) {
    const { canvas, width, height, pixels } = this;
    const pen = canvas.getContext("2d");
    const [left, bottom, top] = [38, height - 18, 18];
    const highest = 1.1e3 * Math.max(0.02, ...peaks);
    const span = Math.max(peaks.length, 10 / timestep); // ten seconds at least
    const x = (i) => left + ((width - left - 6) * i) / span;
    const y = (force) => bottom - ((bottom - top) * 1e3 * force) / highest;
    pen.setTransform(pixels, 0, 0, pixels, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = "11px system-ui, sans-serif";
    pen.fillStyle = "#63717d";
    pen.fillText("peak contact*, mN", left, 12);
    pen.fillText(highest.toFixed(0), 4, top + 4);
    pen.fillText("0", 4, bottom);
    pen.fillText(`${(span * timestep).toFixed(0)} s`, width - 34, bottom + 13);
    pen.strokeStyle = "#b9c2c9";
    pen.lineWidth = 1;
    pen.strokeRect(left, top, width - left - 6, bottom - top);
    pen.strokeStyle = FORCE;
    pen.lineWidth = 1.5;
    pen.beginPath();
    peaks.forEach((force, i) => pen.lineTo(x(i), y(force)));
    pen.stroke();
  }
}

const mN = (force) => `${(1e3 * force).toFixed(1)} mN`;
const mm = (length) => `${(1e3 * length).toFixed(1)} mm`;

/** Names and texts of the figures of a state; a recording has neither bend nor pace. */
export function figures(readings) {
  const { goal, time, distance, inserted, push, wall, bend, pace } = readings;
  const rows = [
    ["goal", goal.name.toUpperCase()],
    ["time", `${time.toFixed(1)} s`],
    ["to the goal", mm(distance)],
    ["inserted", mm(inserted)],
    ["push force", mN(push)],
    ["on the wall, sum", mN(wall.sum)],
    ["largest contact", mN(wall.max)],
    ["its peak in the step*", mN(wall.peakMax)],
  ];
  if (bend) rows.push(["tip, about x / y", bend.map((share) => share.toFixed(2)).join(" / ")]);
  if (pace !== undefined) rows.push(["physics", pace ? `${pace.toFixed(1)}× real time` : "–"]);
  return rows;
}
