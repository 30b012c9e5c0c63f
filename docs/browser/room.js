/**
 * What a headset shows of a state (state.js): the vessel as glass at its true size, device,
 * forces and goal, the fluoroscopy on a screen on the right and the figures on the left.
 */

import * as THREE from "./vendor/three.module.js";
import { DEVICE, DEVICE_LIGHT, GOAL, HEAD, Trace, arrowLength, figures, forceColour } from "./drawing.js";
import { smooth } from "./centreline.js";

const BACKGROUND = "#bcc4cb"; // of a room without a camera
const AWAY = new THREE.Vector3(0, -0.08, -0.42); // of the arch from the eyes, m
// Width, m, place, turn, rad, and milliseconds between images: a headset draws 72 frames a
// second, and each image costs it several milliseconds.
const SCREEN = { width: 0.2, place: [0.2, 0, 0.02], turn: -0.45, period: 75 };
const PANEL = { width: 0.155, place: [-0.18, 0, 0.02], turn: 0.45, period: 200 };
const PEAK_NOTE = "* Peaks depend on the physics step.";
const PANEL_PIXELS = [600, 800];
const SMALLEST = 0.25; // scale of the arch
const LARGEST = 10;
const PIECES = 5; // of the drawn curve of the device in each link
const AROUND = 12; // vertices around the device
const CONTACTS = 64; // drawn at most
const HEAD_SIZE = 1.5; // radii of the device

// Opacity of the far and the near wall, and colour of the device: on the background, and on
// whatever surrounds the user.
const IN_A_ROOM = { far: 1, near: 0.6, device: DEVICE };
const AMONG_THINGS = { far: 2, near: 1, device: DEVICE_LIGHT };

// Glass as in cathsim_dmc/pictures/translucent.py: denser along the line of sight.
const GLASS_VERTEX = `
  varying vec3 toNormal;
  varying vec3 toEye;
  void main() {
    vec4 seen = modelViewMatrix * vec4(position, 1.0);
    toNormal = normalMatrix * normal;
    toEye = -seen.xyz;
    gl_Position = projectionMatrix * seen;
  }`;
const GLASS_FRAGMENT = `
  uniform float opacity;
  varying vec3 toNormal;
  varying vec3 toEye;
  void main() {
    vec3 normal = normalize(toNormal);
    float facing = dot(normal, normalize(toEye));
    if (facing < 0.0) normal = -normal;
    float dense = mix(0.08, 0.70, pow(1.0 - abs(facing), 2.5));
    vec3 above = normalize((viewMatrix * vec4(-0.35, 0.55, 0.76, 0.0)).xyz);
    float light = clamp(dot(normal, above), 0.0, 1.0);
    vec3 wall = vec3(0.80, 0.36, 0.33) * (0.55 + 0.55 * light) + 0.5 * pow(light, 24.0);
    gl_FragColor = vec4(min(wall, 1.0), min(opacity * dense, 0.95));
  }`;

export class Room {
  /**
   * @param {object} shown As `Headset` is given it.
   * @param {boolean} transparent Whether the surroundings are seen.
   */
  constructor({ state, vessel, screen, help }, transparent) {
    this.help = help;
    this.scene = new THREE.Scene();
    this.scene.background = transparent ? null : new THREE.Color(BACKGROUND);
    this.camera = new THREE.PerspectiveCamera();
    this.scene.add(new THREE.HemisphereLight("#ffffff", "#8a8078", 2.2));
    const lamp = new THREE.DirectionalLight("#ffffff", 1.6);
    lamp.position.set(-0.35, 0.55, 0.76);
    this.scene.add(lamp);
    if (!transparent) this.scene.add(new THREE.GridHelper(6, 24, "#98a2ab", "#a9b2ba"));
    this.patient = new Patient(vessel, state.readings, transparent ? AMONG_THINGS : IN_A_ROOM);
    this.stand = new THREE.Group(); // in front of the eyes
    this.stand.add(this.patient.group);
    this.addScreens(screen);
    this.scene.add(this.stand);
    this.drawn = null;
  }

  addScreens(screen) {
    const [columns, rows] = PANEL_PIXELS;
    this.panel = document.createElement("canvas");
    [this.panel.width, this.panel.height] = [columns, rows];
    this.trace = new Trace(document.createElement("canvas"), (columns - 40) / 2, 75, 2);
    this.screens = [
      this.addScreen(SCREEN, screen.canvas, (readings) => screen.draw(readings)),
      this.addScreen(PANEL, this.panel, (readings) => this.drawPanel(readings)),
    ];
  }

  addScreen({ width, place, turn, period }, canvas, draw) {
    const texture = new THREE.CanvasTexture(canvas);
    texture.colorSpace = THREE.SRGBColorSpace;
    texture.anisotropy = 4;
    const mesh = new THREE.Mesh(
      new THREE.PlaneGeometry(width, (width * canvas.height) / canvas.width),
      new THREE.MeshBasicMaterial({ map: texture, side: THREE.DoubleSide }),
    );
    mesh.position.set(...place);
    mesh.rotation.y = turn;
    this.stand.add(mesh);
    return { texture, draw, period, shown: null, at: -Infinity };
  }

  /** Draws into a session; `frame` is called before every frame. */
  async begin(session, frame) {
    this.renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
    this.renderer.xr.enabled = true;
    this.renderer.xr.setReferenceSpaceType("local-floor");
    this.grips = [0, 1].map((index) => this.addGrip(index));
    await this.renderer.xr.setSession(session);
    let placed = false;
    this.renderer.setAnimationLoop(() => {
      frame();
      this.renderer.render(this.scene, this.camera);
      if (!placed) this.place(); // where the eyes are is known from here on
      placed = true;
    });
  }

  /** A controller, and which hand holds it. */
  addGrip(index) {
    const grip = this.renderer.xr.getControllerGrip(index);
    const handle = new THREE.Mesh(
      new THREE.CapsuleGeometry(0.014, 0.08, 4, 16).rotateX(Math.PI / 2),
      new THREE.MeshStandardMaterial({ color: "#3c4650", roughness: 0.6 }),
    );
    grip.add(handle);
    grip.addEventListener("connected", ({ data }) => {
      grip.userData.hand = data.handedness;
    });
    grip.addEventListener("disconnected", () => delete grip.userData.hand);
    this.scene.add(grip);
    return grip;
  }

  /** Puts the arch, at its true size, and the screens in front of the eyes. */
  place() {
    const eyes = this.renderer.xr.getCamera();
    const [from, to] = [new THREE.Vector3(), new THREE.Vector3()];
    from.setFromMatrixPosition(eyes.matrixWorld);
    to.setFromMatrixColumn(eyes.matrixWorld, 2); // backwards
    this.stand.rotation.set(0, Math.atan2(to.x, to.z), 0);
    this.stand.position.copy(AWAY).applyEuler(this.stand.rotation).add(from);
    const { group } = this.patient;
    group.position.set(0, 0, 0);
    group.quaternion.identity();
    group.scale.setScalar(1);
    this.stand.updateMatrixWorld(true);
  }

  /** Moves the arch with one hand that grips, turns and scales it with two. */
  hold([left, right]) {
    const hands = this.grips.filter(
      ({ userData: { hand }, visible }) =>
        visible && ((hand === "left" && left) || (hand === "right" && right)),
    );
    const { group } = this.patient;
    const now = hands.map(({ matrixWorld }) => matrixWorld.clone());
    if (now.length > 0 && this.held?.length === now.length) {
      const moved = now.length === 1 ? byOne(this.held, now) : byTwo(this.held, now);
      const inStand = this.stand.matrixWorld.clone().invert();
      const matrix = group.matrix.clone().premultiply(this.stand.matrixWorld);
      matrix.premultiply(moved).premultiply(inStand);
      matrix.decompose(group.position, group.quaternion, group.scale);
      const scale = THREE.MathUtils.clamp(group.scale.x, SMALLEST, LARGEST);
      group.scale.setScalar(scale);
      group.updateMatrix();
    }
    this.held = now;
  }

  /** Draws a state's readings, where others are shown. */
  draw(readings) {
    if (readings !== this.drawn) this.patient.draw(readings);
    this.drawn = readings;
    const now = performance.now();
    for (const screen of this.screens) {
      if (screen.shown === readings || now - screen.at < screen.period) continue;
      screen.draw(readings);
      screen.texture.needsUpdate = true;
      Object.assign(screen, { shown: readings, at: now });
    }
  }

  drawPanel(readings) {
    const { panel, trace } = this;
    const pen = panel.getContext("2d");
    pen.fillStyle = "#f6f7f8";
    pen.fillRect(0, 0, panel.width, panel.height);
    const colours = { good: "#12805c", bad: "#b3202c" };
    pen.fillStyle = colours[readings.mood] ?? "#22303c";
    pen.font = "600 30px system-ui, sans-serif";
    pen.fillText(readings.message, 20, 46, panel.width - 40);
    pen.font = "26px system-ui, sans-serif";
    pen.fillStyle = "#22303c";
    const rows = [...figures(readings), ["scale", `× ${this.patient.group.scale.x.toFixed(1)}`]];
    rows.forEach(([name, text], row) => {
      const y = 94 + 36 * row;
      pen.textAlign = "left";
      pen.fillText(name, 20, y);
      pen.textAlign = "right";
      pen.fillText(text, panel.width - 20, y);
    });
    pen.textAlign = "left";
    trace.draw(readings);
    pen.drawImage(trace.canvas, 20, 94 + 36 * rows.length - 16);
    pen.font = "21px system-ui, sans-serif";
    pen.fillStyle = "#63717d";
    [...this.help, PEAK_NOTE].forEach((line, row) =>
      pen.fillText(line, 20, 660 + 28 * row, panel.width - 40),
    );
  }

  end() {
    if (!this.renderer) return;
    this.renderer.setAnimationLoop(null);
    this.scene.traverse(({ geometry, material }) => {
      geometry?.dispose();
      material?.map?.dispose();
      material?.dispose();
    });
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }
}

const placeOf = (matrix) => new THREE.Vector3().setFromMatrixPosition(matrix);

/** The motion of one hand. */
function byOne([before], [now]) {
  return now.clone().multiply(before.clone().invert());
}

/** The motion of two hands: their middle, their direction and their distance. */
function byTwo(before, now) {
  const [a, b, c, d] = [...before, ...now].map(placeOf);
  const [from, to] = [b.clone().sub(a), d.clone().sub(c)];
  const turn = new THREE.Quaternion().setFromUnitVectors(
    from.clone().normalize(),
    to.clone().normalize(),
  );
  const scale = to.length() / Math.max(from.length(), 1e-6);
  const middle = a.add(b).multiplyScalar(0.5);
  const shift = c.add(d).multiplyScalar(0.5);
  return new THREE.Matrix4()
    .compose(shift, turn, new THREE.Vector3().setScalar(scale))
    .multiply(new THREE.Matrix4().makeTranslation(middle.negate()));
}

/** Vessel, device, goal and forces, in metres of the patient frame. */
class Patient {
  constructor({ positions, faces }, { goal, radius, line }, { far, near, device }) {
    this.group = new THREE.Group(); // moved, turned and scaled by hands
    // Patient frame (left, posterior, superior) to the room's (right, up, towards you),
    // as seen from the front.
    this.frame = new THREE.Group();
    this.frame.rotation.x = -Math.PI / 2;
    this.group.add(this.frame);
    const shape = new THREE.BufferGeometry();
    shape.setAttribute("position", new THREE.BufferAttribute(positions, 3));
    shape.setIndex(new THREE.BufferAttribute(faces, 1));
    shape.computeVertexNormals();
    shape.computeBoundingBox();
    const middle = shape.boundingBox.getCenter(new THREE.Vector3());
    this.frame.position.copy(middle.negate().applyEuler(this.frame.rotation));
    // Far walls are drawn before what is inside, near ones over it.
    this.frame.add(glass(shape, THREE.BackSide, 1, far), glass(shape, THREE.FrontSide, 3, near));
    this.device = new Tube(PIECES * (line.length - 1) + 1, radius, device);
    this.head = new THREE.Mesh(
      new THREE.SphereGeometry(HEAD_SIZE * radius, 24, 16),
      new THREE.MeshStandardMaterial({ color: HEAD, roughness: 0.4 }),
    );
    this.goal = new THREE.Mesh(
      new THREE.SphereGeometry(goal.radius, 32, 24),
      new THREE.MeshBasicMaterial({
        color: GOAL,
        transparent: true,
        opacity: 0.3,
        depthWrite: false,
      }),
    );
    this.goal.position.set(...goal.position);
    this.goal.renderOrder = 2;
    this.forces = new Arrows();
    this.frame.add(this.device.mesh, this.head, this.goal, ...this.forces.meshes);
  }

  /** Where points of the patient frame are in the room, m. */
  inRoom(points) {
    return points.map((point) => this.frame.localToWorld(new THREE.Vector3(...point)).toArray());
  }

  draw({ line, contacts }) {
    this.device.draw(smooth(line, PIECES));
    this.head.position.set(...line[line.length - 1]);
    this.forces.draw(contacts);
  }
}

function glass(shape, side, order, opacity) {
  const material = new THREE.ShaderMaterial({
    vertexShader: GLASS_VERTEX,
    fragmentShader: GLASS_FRAGMENT,
    uniforms: { opacity: { value: opacity } },
    side,
    transparent: true,
    depthWrite: false,
  });
  const mesh = new THREE.Mesh(shape, material);
  mesh.renderOrder = order;
  return mesh;
}

/** The device as a tube around a line. */
class Tube {
  constructor(points, radius, colour) {
    this.radius = radius;
    this.shape = new THREE.BufferGeometry();
    for (const name of ["position", "normal"]) {
      const array = new Float32Array(3 * AROUND * points);
      const attribute = new THREE.BufferAttribute(array, 3);
      this.shape.setAttribute(name, attribute.setUsage(THREE.DynamicDrawUsage));
    }
    const faces = [];
    for (let point = 0; point + 1 < points; point += 1) {
      for (let side = 0; side < AROUND; side += 1) {
        const [a, b] = [side, (side + 1) % AROUND].map((k) => AROUND * point + k);
        faces.push(a, b, a + AROUND, b, b + AROUND, a + AROUND);
      }
    }
    this.shape.setIndex(faces);
    this.mesh = new THREE.Mesh(
      this.shape,
      new THREE.MeshStandardMaterial({ color: colour, roughness: 0.35 }),
    );
    this.mesh.frustumCulled = false; // it moves
  }

  draw(line) {
    const { position, normal } = this.shape.attributes;
    const points = line.map((point) => new THREE.Vector3(...point));
    const tangent = (i) =>
      points[Math.min(i + 1, points.length - 1)].clone().sub(points[Math.max(i - 1, 0)]).normalize();
    // A normal carried along the line without a turn about it.
    let before = tangent(0);
    const across = Math.abs(before.x) < 0.9 ? new THREE.Vector3(1) : new THREE.Vector3(0, 1);
    const u = across.cross(before).normalize();
    const [v, out, turn] = [new THREE.Vector3(), new THREE.Vector3(), new THREE.Quaternion()];
    points.forEach((point, i) => {
      const along = tangent(i);
      u.applyQuaternion(turn.setFromUnitVectors(before, along)).normalize();
      v.crossVectors(along, u);
      before = along;
      for (let side = 0; side < AROUND; side += 1) {
        const angle = (2 * Math.PI * side) / AROUND;
        out.copy(u).multiplyScalar(Math.cos(angle)).addScaledVector(v, Math.sin(angle));
        normal.setXYZ(AROUND * i + side, out.x, out.y, out.z);
        out.multiplyScalar(this.radius).add(point);
        position.setXYZ(AROUND * i + side, out.x, out.y, out.z);
      }
    });
    position.needsUpdate = normal.needsUpdate = true;
  }
}

/** Forces on the wall as arrows: shafts and tips. */
class Arrows {
  constructor() {
    const shaft = new THREE.CylinderGeometry(0.0007, 0.0007, 1, 10).translate(0, 0.5, 0);
    const tip = new THREE.ConeGeometry(0.0018, 0.005, 16);
    this.meshes = [shaft, tip].map((shape) => {
      const material = new THREE.MeshStandardMaterial({ roughness: 0.5 });
      const mesh = new THREE.InstancedMesh(shape, material, CONTACTS);
      mesh.count = 0;
      mesh.frustumCulled = false;
      return mesh;
    });
  }

  draw(contacts) {
    const shown = contacts.slice(0, CONTACTS);
    const [up, turn] = [new THREE.Vector3(0, 1), new THREE.Quaternion()];
    const matrix = new THREE.Matrix4();
    const [shafts, tips] = this.meshes;
    shown.forEach(({ position, force, magnitude }, i) => {
      const [from, along] = [position, force].map((each) => new THREE.Vector3(...each));
      const length = arrowLength(magnitude);
      turn.setFromUnitVectors(up, along.normalize());
      shafts.setMatrixAt(i, matrix.compose(from, turn, new THREE.Vector3(1, length, 1)));
      from.addScaledVector(along, length);
      tips.setMatrixAt(i, matrix.compose(from, turn, new THREE.Vector3(1, 1, 1)));
      const colour = new THREE.Color(forceColour(magnitude));
      for (const mesh of this.meshes) mesh.setColorAt(i, colour);
    });
    for (const mesh of this.meshes) {
      mesh.count = shown.length;
      mesh.instanceMatrix.needsUpdate = true;
      if (mesh.instanceColor) mesh.instanceColor.needsUpdate = true;
    }
  }
}
