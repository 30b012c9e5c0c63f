/**
 * The curve of a device through its joints, the same in every view: cubics whose tangent at
 * a joint is shared by the two links that meet there (cathsim_dmc/imaging/device.py).
 */

const difference = (a, b) => a.map((x, axis) => x - b[axis]);

/** Tangent less chord of a link at the joint it shares with another, times its length. */
function turn(joints, link, other) {
  if (!(other >= 0 && other + 1 < joints.length)) return null; // a free end
  const own = difference(joints[link + 1], joints[link]);
  const next = difference(joints[other + 1], joints[other]);
  const [length, beside] = [Math.hypot(...own), Math.hypot(...next)];
  if (!(beside > 0 && beside < Infinity)) return null;
  const share = length / (length + beside);
  return own.map((x, axis) => share * ((next[axis] * length) / beside - x));
}

/** Turns of a link's curve at its two ends, of a parabola where one end is free. */
export function bends(joints, link) {
  const [start, end] = [turn(joints, link, link - 1), turn(joints, link, link + 1)];
  const mirrored = (other) => other?.map((x) => -x) ?? [0, 0, 0];
  return [start ?? mirrored(end), end ?? mirrored(start)];
}

/**
 * Points of the curve, some for each link, from the first joint to the last.
 * @param {number[][]} joints Each [x, y, z], m.
 * @param {number} pieces Points for each link.
 */
export function smooth(joints, pieces) {
  const points = [];
  for (let link = 0; link + 1 < joints.length; link += 1) {
    const [from, to] = [joints[link], joints[link + 1]];
    const [start, end] = bends(joints, link);
    for (let piece = 0; piece < pieces; piece += 1) {
      const t = piece / pieces;
      const [behind, before] = [t * (1 - t) * (1 - t), t * (1 - t) * t];
      points.push(
        from.map((x, i) => x + t * (to[i] - x) + behind * start[i] - before * end[i]),
      );
    }
  }
  points.push(joints[joints.length - 1]);
  return points;
}
