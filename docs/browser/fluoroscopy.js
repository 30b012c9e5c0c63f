/**
 * Fluoroscopy of a device, as `cathsim_dmc.imaging` draws it: the signal behind patient
 * and vessel is given, the shadow of the device is laid over it. See the Python package
 * for the derivation (imaging/device.py, imaging/fluoroscopy.py).
 */

import { bends } from "./centreline.js";

const SPACING = 1 / 3; // of the discs along a link, px
const RELATIVE_SPACING = 0.1; // the same on wide shadows, radii
const NEAREST = 0.05; // m before the source, where nothing is imaged

export class Fluoroscope {
  /**
   * @param {object} view Geometry and materials, from views.json.
   * @param {Float32Array} signal Signal without a device, row by row.
   */
  constructor(view, signal) {
    this.view = view;
    this.signal = signal;
    this.depth = new Float32Array(signal.length);
  }

  /** Pixel [column, row] and depth (m) of a world point. */
  project(point) {
    const [right, down, depth] = this.camera(point);
    const { focal, rows, columns } = this.view;
    const scale = focal / depth;
    return {
      pixel: [right * scale + (columns - 1) / 2, down * scale + (rows - 1) / 2],
      depth,
    };
  }

  camera(point) {
    const { axes, source } = this.view;
    const relative = point.map((x, i) => x - source[i]);
    return axes.map((axis) => axis.reduce((sum, x, i) => sum + x * relative[i], 0));
  }

  /**
   * The image of a device.
   * @param {number[][]} line Joints from base to tip, m.
   * @param {number} radius Of the device, m.
   * @param {Uint8ClampedArray} pixels RGBA, written.
   * @param {number} noise Standard deviation of the noise at signal 1; 0 for none.
   * @param {number[]} window Signals that are shown as black and as white.
   */
  render(line, radius, pixels, noise = 0, window = [0, 1 / this.view.gain]) {
    const { depth, signal } = this;
    depth.fill(0);
    const camera = line.map((point) => this.camera(point));
    let toTip = 0;
    for (let link = line.length - 2; link >= 0; link -= 1) {
      toTip += this.addLink(camera, link, radius, toTip);
    }
    const [black, white] = window;
    const scale = 255 / (white - black);
    for (let i = 0; i < signal.length; i += 1) {
      let passed = signal[i];
      if (depth[i] > 0) passed *= Math.exp(-depth[i]);
      if (noise > 0) passed += noise * Math.sqrt(passed) * normal();
      const level = (passed - black) * scale + 0.5;
      const grey = Math.floor(Math.min(Math.max(level, 0), 255));
      pixels[4 * i] = grey;
      pixels[4 * i + 1] = grey;
      pixels[4 * i + 2] = grey;
      pixels[4 * i + 3] = 255;
    }
  }

  /** Adds a link whose distal end is `toTip` from the tip; returns its length. */
  addLink(camera, link, radius, toTip) {
    const { rows, columns, focal, device_mu, marker_mu, marker_length } = this.view;
    let [x0, y0, z0] = camera[link];
    const [x1, y1, z1] = camera[link + 1];
    let [dx, dy, dz] = [x1 - x0, y1 - y0, z1 - z0];
    let length = Math.hypot(dx, dy, dz);
    if (!(length > 0 && length < Infinity)) return 0;
    const cap = ((2 / 3) * radius) / length;
    const back = link === 0 ? cap : 0;
    const stretch = 1 + back + (link === camera.length - 2 ? cap : 0);
    [x0, y0, z0] = [x0 - back * dx, y0 - back * dy, z0 - back * dz];
    [dx, dy, dz, length] = [dx, dy, dz, length].map((x) => x * stretch);
    const nearest = Math.min(z0, z0 + dz);
    if (!(nearest > NEAREST)) return length;
    const wide = (radius * focal) / nearest;
    const [u0, v0] = [(x0 * focal) / z0, (y0 * focal) / z0];
    const [u1, v1] = [((x0 + dx) * focal) / (z0 + dz), ((y0 + dy) * focal) / (z0 + dz)];
    const [broad, high] = [columns / 2 + wide, rows / 2 + wide];
    if (
      Math.min(u0, u1) >= broad ||
      Math.max(u0, u1) <= -broad ||
      Math.min(v0, v1) >= high ||
      Math.max(v0, v1) <= -high
    ) {
      return length;
    }
    const spacing = Math.max(SPACING, RELATIVE_SPACING * wide);
    const most = (4 * (rows + columns)) / SPACING;
    const reach = Math.ceil(Math.hypot(u1 - u0, v1 - v0) / spacing);
    const count = Math.floor(Math.min(Math.max(reach, 1), most));
    const piece = length / count;
    const [start, end] = bends(camera, link);
    for (let step = 0; step < count; step += 1) {
      const fraction = (step + 0.5) / count;
      const t = Math.min(Math.max(fraction * stretch - back, 0), 1);
      const [behind, before] = [t * (1 - t) * (1 - t), t * (1 - t) * t];
      const x = x0 + fraction * dx + behind * start[0] - before * end[0];
      const y = y0 + fraction * dy + behind * start[1] - before * end[1];
      const z = z0 + fraction * dz;
      let weight = device_mu;
      if (marker_length > 0) {
        const distal = toTip + (1 - fraction) * length;
        const inside = (marker_length - distal) / piece + 0.5;
        weight += (marker_mu - device_mu) * Math.min(Math.max(inside, 0), 1);
      }
      const scale = focal / z;
      const slant = Math.hypot(x, y, z) / z;
      weight *= Math.PI * radius ** 2 * piece * slant * scale ** 2;
      addDisc(
        this.depth,
        rows,
        columns,
        y * scale + (rows - 1) / 2,
        x * scale + (columns - 1) / 2,
        radius * scale,
        weight,
      );
    }
    return length;
  }
}

function left(t) {
  return Math.PI / 2 + t * Math.sqrt(1 - t * t) + Math.asin(t);
}

function belowLeft(x, y, leftOf, below) {
  if (x * x + y * y < 1) return (leftOf + below) / 2 + x * y - Math.PI / 4;
  if (x < 0) return y < 0 ? 0 : leftOf;
  return y < 0 ? below : leftOf + below - Math.PI;
}

/** Spreads a weight over the pixels that a disc covers, by the area they share. */
function addDisc(image, rows, columns, row, column, radius, weight) {
  const top = Math.floor(row - radius + 0.5);
  const bottom = Math.floor(row + radius + 0.5);
  const first = Math.floor(column - radius + 0.5);
  const last = Math.floor(column + radius + 0.5);
  if (bottom < 0 || last < 0 || top >= rows || first >= columns) return;
  const edges = [];
  const lefts = [];
  const above = [];
  for (let j = first; j <= last; j += 1) {
    const edge = Math.min((j + 0.5 - column) / radius, 1);
    edges.push(edge);
    lefts.push(left(edge));
    above.push(0);
  }
  for (let i = top; i <= bottom; i += 1) {
    const y = Math.min((i + 0.5 - row) / radius, 1);
    const below = left(y);
    let before = 0;
    for (let j = 0; j < edges.length; j += 1) {
      const corner = belowLeft(edges[j], y, lefts[j], below);
      const added = corner - above[j];
      above[j] = corner;
      const share = added - before;
      before = added;
      const k = first + j;
      if (share > 0 && i >= 0 && i < rows && k >= 0 && k < columns) {
        image[i * columns + k] += (weight / Math.PI) * share;
      }
    }
  }
}

function normal() {
  // A sum of uniform numbers: near enough to a normal deviate for an eye.
  return (Math.random() + Math.random() + Math.random() - 1.5) * 2;
}
