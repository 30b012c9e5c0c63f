/**
 * A task of the suite in MuJoCo's WebAssembly build: the scene that `cathsim export`
 * writes, commanded, stepped and judged as the Python task does it. SI units, world
 * frame (patient frame LPS). Runs in browsers and in Node.
 */

export class Simulation {
  /**
   * @param {object} mujoco The loaded module.
   * @param {string} scene Text of scene.xml.
   * @param {object} task Content of task.json.
   */
  constructor(mujoco, scene, task) {
    this.mujoco = mujoco;
    this.task = task;
    this.model = mujoco.MjModel.from_xml_string(scene);
    this.data = new mujoco.MjData(this.model);
    const model = this.model;
    const kinds = mujoco.mjtObj;
    const id = (kind, name) => {
      const found = mujoco.mj_name2id(model, kinds[kind].value, name);
      if (found < 0) throw new Error(`the scene has no ${kind} named ${name}`);
      return found;
    };
    this.links = task.links.map((name) => id("mjOBJ_BODY", name));
    this.head = id("mjOBJ_SITE", task.head);
    this.insertion = model.jnt_qposadr[id("mjOBJ_JOINT", task.insertion)];
    this.actuators = task.actuators.map((name) => id("mjOBJ_ACTUATOR", name));
    this.sensors = {};
    for (const [key, name] of Object.entries(task.sensors)) {
      const sensor = id("mjOBJ_SENSOR", name);
      this.sensors[key] = [model.sensor_adr[sensor], model.sensor_dim[sensor]];
    }
    this.drives = drives(mujoco, model);
    this.branch = task.branch && new Branch(task.branch);
    this.reset();
  }

  /** Begins the episode anew, from the same start. */
  reset() {
    this.mujoco.mj_resetData(this.model, this.data);
    this.data.qpos.set(this.task.qpos);
    this.mujoco.mj_forward(this.model, this.data);
    for (const drive of this.drives) hold(drive, this.data);
    this.steps = 0;
    this.success = false;
    this.wall = { sum: 0, max: 0, peakSum: 0, peakMax: 0 };
  }

  /**
   * One control step.
   * @param {ArrayLike<number>} action Entries in [-1, 1], in the task's order.
   */
  step(action) {
    const { mujoco, model, data } = this;
    const control = data.ctrl;
    this.actuators.forEach((actuator, i) => {
      control[actuator] = Math.min(Math.max(action[i], -1), 1);
    });
    for (const drive of this.drives) {
      follow(drive, data, this.task.control_timestep);
    }
    let peakSum = 0;
    let peakMax = 0;
    let force = { sum: 0, max: 0 };
    for (let substep = 0; substep < this.task.substeps; substep += 1) {
      mujoco.mj_step(model, data);
      force = this.wallForce();
      peakSum = Math.max(peakSum, force.sum);
      peakMax = Math.max(peakMax, force.max);
    }
    this.wall = { ...force, peakSum, peakMax };
    this.steps += 1;
    this.success =
      this.distance < this.task.goal.radius &&
      (!this.branch || this.branch.holds(this.headPosition));
  }

  /** Sum and largest of the contact forces on the wall at present, N. */
  wallForce() {
    let sum = 0;
    let max = 0;
    for (const { magnitude } of this.contacts()) {
      sum += magnitude;
      max = Math.max(max, magnitude);
    }
    return { sum, max };
  }

  /** Contacts with the wall: place (m) and force of the device on the wall (N). */
  contacts() {
    const size = this.task.contact_size;
    const [start, length] = this.sensors.wall_contacts;
    const row = this.data.sensordata;
    const found = [];
    for (let at = start; at < start + length && row[at] > 0; at += size) {
      const [normal, tangent] = [at + 8, at + 11];
      const cross = [
        row[normal + 1] * row[tangent + 2] - row[normal + 2] * row[tangent + 1],
        row[normal + 2] * row[tangent] - row[normal] * row[tangent + 2],
        row[normal] * row[tangent + 1] - row[normal + 1] * row[tangent],
      ];
      const force = cross.map(
        (other, axis) =>
          -(
            row[at + 1] * row[normal + axis] +
            row[at + 2] * row[tangent + axis] +
            row[at + 3] * other
          ),
      );
      found.push({
        position: [row[at + 5], row[at + 6], row[at + 7]],
        force,
        magnitude: Math.hypot(row[at + 1], row[at + 2], row[at + 3]),
      });
    }
    return found;
  }

  /** Joints of the device from base to head, each [x, y, z], m. */
  get line() {
    const places = this.data.xpos;
    const line = this.links.map((body) => [
      places[3 * body],
      places[3 * body + 1],
      places[3 * body + 2],
    ]);
    line.push(this.headPosition);
    return line;
  }

  get headPosition() {
    const places = this.data.site_xpos;
    return [0, 1, 2].map((axis) => places[3 * this.head + axis]);
  }

  /** Straight from head to goal, m. */
  get distance() {
    const head = this.headPosition;
    return Math.hypot(...this.task.goal.position.map((x, i) => x - head[i]));
  }

  /** Insertion of the base, m. */
  get inserted() {
    return this.data.qpos[this.insertion];
  }

  /** Axial force of the drive on the device, N. */
  get pushForce() {
    return this.data.sensordata[this.sensors.push_force[0] + 2];
  }

  /** Force of the phantom on the load cell, N, [x, y, z]. */
  get loadCell() {
    const [start] = this.sensors.load_cell;
    const row = this.data.sensordata;
    return [0, 1, 2].map((axis) => -row[start + axis]);
  }

  /** Simulated time since the start, s. */
  get time() {
    return this.steps * this.task.control_timestep;
  }

  /** Whether the simulation has left what can be computed. */
  get failed() {
    return !this.headPosition.every(Number.isFinite);
  }
}

/** Largest speed of a platform that makes up for a load, over that of the full command. */
const FASTEST = 1.1;

/** Servos of the base, see cathsim_dmc/physics/drives.py. */
function drives(mujoco, model) {
  const found = [];
  for (let actuator = 0; actuator < model.nu; actuator += 1) {
    const kind = model.actuator_dyntype[actuator];
    if (kind !== mujoco.mjtDyn.mjDYN_INTEGRATOR.value) continue;
    const joint = model.actuator_trnid[2 * actuator];
    const width = model.actuator_gainprm.length / model.nu;
    const gain = model.actuator_gainprm[width * actuator];
    const stiffness = -model.actuator_biasprm[width * actuator + 1];
    const inertia = model.dof_armature[model.jnt_dofadr[joint]];
    found.push({
      actuator,
      act: model.actuator_actadr[actuator],
      qpos: model.jnt_qposadr[joint],
      dof: model.jnt_dofadr[joint],
      gain,
      stiffness,
      damping:
        model.opt.timestep * stiffness - model.actuator_biasprm[width * actuator + 2],
      limit: model.actuator_forcerange[2 * actuator + 1],
      rise: (Math.sqrt(stiffness * inertia) * gain * Math.E) / stiffness,
      load: loadSensor(mujoco, model, joint),
      told: 0,
    });
  }
  return found;
}

/** Place among the sensors of the force or torque of a platform on its device. */
function loadSensor(mujoco, model, joint) {
  const slides = model.jnt_type[joint] === mujoco.mjtJoint.mjJNT_SLIDE.value;
  const { mjSENS_FORCE, mjSENS_TORQUE } = mujoco.mjtSensor;
  const kind = (slides ? mjSENS_FORCE : mjSENS_TORQUE).value;
  for (let sensor = 0; sensor < model.nsensor; sensor += 1) {
    if (model.sensor_type[sensor] !== kind) continue;
    const body = model.site_bodyid[model.sensor_objid[sensor]];
    if (body === model.jnt_bodyid[joint]) return model.sensor_adr[sensor] + 2;
  }
  throw new Error("a drive has no sensor of its load");
}

/** Sets the command of a drive to where its base stands. */
function hold(drive, data) {
  drive.told = data.qpos[drive.qpos];
  data.act[drive.act] = (drive.told * drive.stiffness) / drive.gain;
}

/**
 * Lets a clamp slip and makes up for a load, before a control step of some seconds; see
 * cathsim_dmc/laws/drive.py.
 */
function follow(drive, data, seconds) {
  const { gain, stiffness, limit } = drive;
  const command = data.ctrl[drive.actuator];
  const velocity = data.qvel[drive.dof];
  const act = gain * data.act[drive.act];
  const pull = act - stiffness * data.qpos[drive.qpos] - drive.damping * velocity;
  const slip = (pull - Math.min(Math.max(pull, -limit), limit)) / stiffness;
  const speed = (stiffness / gain) * velocity;
  const pace = Math.max(Math.abs(command), Math.abs(speed));
  const rise = drive.rise * Math.max(FASTEST - pace, 0);
  let borne = act - stiffness * drive.told;
  const missing = data.sensordata[drive.load] - borne;
  borne += Math.min(Math.max(missing, -rise), rise);
  const place = drive.told - slip;
  data.act[drive.act] = (stiffness * place + borne) / gain;
  drive.told = place + command * (gain / stiffness) * seconds;
}

/** The target branch: whether a point lies in it, past its ostium. */
class Branch {
  constructor({ points, radii, ostium }) {
    Object.assign(this, { points, radii, ostium });
  }

  holds(point) {
    let best = { distance: Infinity };
    let before = 0;
    for (let i = 0; i + 1 < this.points.length; i += 1) {
      const start = this.points[i];
      const along = this.points[i + 1].map((x, axis) => x - start[axis]);
      const length = Math.hypot(...along);
      const offset = point.map((x, axis) => x - start[axis]);
      const share = Math.min(Math.max(dot(offset, along) / length ** 2, 0), 1);
      const distance = Math.hypot(...offset.map((x, axis) => x - share * along[axis]));
      if (distance < best.distance) {
        const radius = (1 - share) * this.radii[i] + share * this.radii[i + 1];
        best = { distance, radius, arc: before + share * length };
      }
      before += length;
    }
    return best.distance <= best.radius && best.arc >= this.ostium;
  }
}

function dot(a, b) {
  return a.reduce((sum, x, axis) => sum + x * b[axis], 0);
}
