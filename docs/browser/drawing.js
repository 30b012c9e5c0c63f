/** What is drawn on the canvases: glass views of the vessel, and the curve of forces. */

const DEVICE = "#173a63";
const DEVICE_LIGHT = "#7fb2e5";
const HEAD = "#ffb000";
const GOAL = "#12805c";
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

  draw(simulation) {
    const { canvas, view } = this;
    const pen = canvas.getContext("2d");
    const { goal, device_radius } = simulation.task;
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
    const line = simulation.line.map((point) => this.pixel(point));
    const width = 2 * device_radius * THICKER * view.pixels;
    pen.lineCap = pen.lineJoin = "round";
    for (const [colour, share] of [["#fff", 1.5], [DEVICE, 1], [DEVICE_LIGHT, 0.35]]) {
      pen.strokeStyle = colour;
      pen.lineWidth = share * width;
      curve(pen, line);
      pen.stroke();
    }
    const head = line[line.length - 1];
    pen.beginPath();
    pen.arc(...head, 0.9 * width, 0, 2 * Math.PI);
    pen.fillStyle = HEAD;
    pen.fill();
    pen.drawImage(this.glaze, 0, 0);
    for (const contact of simulation.contacts()) this.arrow(pen, contact);
  }

  arrow(pen, { position, force, magnitude }) {
    const start = this.pixel(position);
    const length = Math.max((ARROW * magnitude) / FORCE_TOP, ARROW_LEAST);
    const scale = Math.min(length, ARROW) / Math.max(magnitude, 1e-9);
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

/** A smooth curve through points: quadratic arcs between the middles of its pieces. */
function curve(pen, line) {
  pen.beginPath();
  pen.moveTo(...line[0]);
  for (let i = 1; i + 1 < line.length; i += 1) {
    const [x, y] = line[i];
    pen.quadraticCurveTo(x, y, (x + line[i + 1][0]) / 2, (y + line[i + 1][1]) / 2);
  }
  pen.lineTo(...line[line.length - 1]);
}

/** The largest contact over time, mN. */
export class Trace {
  constructor(canvas, width, height) {
    canvas.width = width;
    canvas.height = height;
    this.canvas = canvas;
    this.clear();
  }

  clear() {
    this.values = [];
  }

  add(force) {
    this.values.push(1e3 * force);
  }

  draw(timestep) {
    const { canvas, values } = this;
    const pen = canvas.getContext("2d");
    const [left, bottom, top] = [38, canvas.height - 18, 18];
    const highest = Math.max(20, ...values) * 1.1;
    const span = Math.max(values.length, 10 / timestep); // ten seconds at least
    const x = (i) => left + ((canvas.width - left - 6) * i) / span;
    const y = (value) => bottom - ((bottom - top) * value) / highest;
    pen.clearRect(0, 0, canvas.width, canvas.height);
    pen.font = "11px system-ui, sans-serif";
    pen.fillStyle = "#63717d";
    pen.fillText("peak contact*, mN", left, 12);
    pen.fillText(highest.toFixed(0), 4, top + 4);
    pen.fillText("0", 4, bottom);
    pen.fillText(`${(span * timestep).toFixed(0)} s`, canvas.width - 34, bottom + 13);
    pen.strokeStyle = "#b9c2c9";
    pen.lineWidth = 1;
    pen.strokeRect(left, top, canvas.width - left - 6, bottom - top);
    pen.strokeStyle = FORCE;
    pen.lineWidth = 1.5;
    pen.beginPath();
    values.forEach((value, i) => pen.lineTo(x(i), y(value)));
    pen.stroke();
  }
}
