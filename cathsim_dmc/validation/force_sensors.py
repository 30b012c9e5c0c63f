"""`cathsim validate forces`: sensors against known loads, and published protocol."""

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import mujoco
import numpy as np

from cathsim_dmc import bounds, policies, suite
from cathsim_dmc.entities.chain import MAX_PUSH_SPEED
from cathsim_dmc.entities.sheath import CLEARANCE
from cathsim_dmc.physics import forces
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.recorder import EpisodeRecorder
from cathsim_dmc.tasks.config import PHYSICS_TIMESTEP
from cathsim_dmc.validation import convergence, protocol
from cathsim_dmc.validation.checks import Check, Report
from cathsim_dmc.validation.rig import Rig, in_tube

BALANCE_BOUND = 1.0  # %
RESTING_LOADS = (0.01, 0.1, 1.0)  # N
RESTING_TIME = 5.0  # s; the load rises in the first second
# Commands, shares of the full speed; a stalled carriage pushes with 4 N times that.
PUSHES = (0.1, 0.25, 0.5, 1.0)
# Blind tubes, length and radius, m: one guides the device, in the other it buckles.
GUIDING_TUBE = (0.04, 1.5e-3)
WIDE_TUBE = (0.1, 2e-3)
AVERAGING = 1.0  # s
LARGEST_PUSH = 4.0  # N, in a dead end
SETTLING = 3.0  # s, after the tip can have reached the dead end
INSERTION_SPEEDS = (0.25, 0.5, 1.0)  # of 40 mm/s
INSERTION_SEEDS = 5
# Tip commands: straight, and bent towards the wall of the branch.
INSERTION_CURLS = ((0.0, 0.0), (0.0, -0.3))
USUAL_FORCE = 0.2  # N; most forces on phantoms are below
USUAL_SHARE = 90.0  # %, meaning of "most"


def resting_link(load: float) -> np.ndarray:
    """Presses the last link of the straight device on a plate with a load, N.

    Returns:
        Lateral force by the contact sensor, by the load cell under the plate, and by
        the sensor of the base, N; penetration depth, m.
    """
    rig, rows = Rig(), []
    rig.add_plate(rig.device.outer_radius)
    rig.compile()
    for step in range(round(RESTING_TIME / PHYSICS_TIMESTEP)):
        share = min(1.0, step * PHYSICS_TIMESTEP)
        rig.data.xfrc_applied[rig.tip_body, 1] = share * load
        rig.step()
        contacts = forces.Contacts.from_sensor(rig.sensor("wall_contacts"))
        across = contacts.force[..., 1].sum()
        # MuJoCo's sensor gives the force of the support on the phantom.
        cell = -rig.sensor("load_cell")[1]
        base = -rig.sensor(f"{rig.name}/push_force")[1]
        rows.append((across, cell, base, contacts.penetration.max()))
    return np.mean(rows[-round(AVERAGING / PHYSICS_TIMESTEP) :], axis=0)


class DeadEnd(NamedTuple):
    """Forces of the device in the blind end of a tube, averaged over 1 s, N."""

    motor: float  # force limit of the stalled carriage
    push: float  # push force at the base
    load_cell: float  # reading of the phantom's load cell along the axis
    contacts: float  # sum of the contact sensor along the axis
    sheath: float  # axial force on the rim of the sheath
    ripple: float  # standard deviation of the push force


def dead_end(command: float, size: tuple[float, float] = GUIDING_TUBE) -> DeadEnd:
    """Pushes the device of the tasks against the end of a straight tube.

    Args:
        command: command of the translation, in (0, 1].
        size: length and radius of the tube, m.
    """
    # Physics steps without the task do not guide the device in the sheath.
    environment = in_tube(size, sheath_clearance=CLEARANCE)
    task = environment.task
    model, data = environment.physics.model.ptr, environment.physics.data.ptr
    motor = model.actuator(f"{task.scene.catheter.mjcf_model.model}/insertion").id
    push = command * LARGEST_PUSH
    data.ctrl[motor], model.actuator_forcerange[motor] = command, (-push, push)
    sheath = environment.physics.bind([task.scene.sheath.bore.parent]).element_id
    way = size[0] - task.scene.placement.start_depth
    steps = round((SETTLING + way / (command * MAX_PUSH_SPEED)) / PHYSICS_TIMESTEP)
    last, rows = round(AVERAGING / PHYSICS_TIMESTEP), []
    mujoco.mj_step(model, data, steps - last)
    for _ in range(last):
        mujoco.mj_step(model, data)
        reading = task.rollout.index.read(data)
        pressed = task.rollout.index.contacts(data.sensordata).force[:, 2].sum()
        rim = _axial_force_on(model, data, sheath)
        rows.append((reading.push_force, reading.load_cell[2], pressed, rim))
    base, cell, pressed, rim = np.mean(rows, axis=0).tolist()
    ripple = float(np.std(rows, axis=0)[0])
    return DeadEnd(push, base, cell, pressed, rim, ripple=ripple)


def _axial_force_on(model, data, sheath: np.ndarray) -> float:
    """Sum of the contact forces on static bodies along z, N."""
    total, wrench = 0.0, np.zeros(6)
    for index, contact in enumerate(data.contact[: data.ncon]):
        first, second = np.isin(model.geom_bodyid[contact.geom], sheath)
        mujoco.mj_contactForce(model, data, index, wrench)
        # The first row of the frame is the normal from the first geom to the second.
        # The force acts on the second geom.
        on_second = (contact.frame.reshape(3, 3).T @ wrench[:3])[2]
        total += (second or -int(first)) * on_second
    return float(total)


def _checks(pushed: dict[str, list[DeadEnd]]) -> Iterator[Check]:
    for load in RESTING_LOADS:
        contacts, load_cell, _, depth = resting_link(load)
        name = f"last link resting under {load:g} N, contact sensor"
        note = f"{contacts:.5f} N, load cell {load_cell:.5f} N, "
        note += f"{1e3 * depth:.2f} mm deep"
        yield Check.deviation(name, contacts, load, BALANCE_BOUND, "N", note)
    for one in pushed["guiding"]:
        for what, value in (("load cell", one.load_cell), ("contacts", one.contacts)):
            name = f"dead end, motor {one.motor:g} N: push force = {what}"
            yield Check.deviation(name, value, one.push, BALANCE_BOUND, "N")
    for one in pushed["wide"]:
        name = f"wide dead end, motor {one.motor:g} N: push force = load cell + rim "
        name, value = f"{name}of the sheath", one.load_cell + one.sheath
        yield Check.deviation(name, value, one.push, BALANCE_BOUND, "N")
    # Insertions into the BCA of the type-I arch.
    for speed in INSERTION_SPEEDS:
        scripts = [
            convergence.Script("into the BCA", speed, curl, 4.0 / speed)
            for curl in INSERTION_CURLS
        ]
        drawn = itertools.product(scripts, range(INSERTION_SEEDS))
        runs = [convergence.run(one, seed=seed, goal="bca") for one, seed in drawn]
        every = np.concatenate([run.contact_force for run in runs])
        single = np.linalg.norm(every, axis=-1)
        usual = 100 * float((single <= USUAL_FORCE).mean())
        name = f"insertion into the BCA at {40 * speed:g} mm/s: share of contact "
        name += f"forces up to {USUAL_FORCE:g} N"
        largest = max(max(run.meta["wall_force_peak_max"]) for run in runs)
        note = f"{len(single)} samples of {len(runs)} insertions "
        note += f"({sum(run.success for run in runs)} arrive), mean "
        note += f"{1e3 * single.mean():.2f} mN, largest {largest:.3f} N"
        yield Check.at_least(name, usual, USUAL_SHARE, "%", note)


def expert_cannulation() -> Episode:
    """Episode of the scripted expert on type1_bca."""
    environment = suite.load(suite.DOMAIN, "type1_bca", {"random": 0})
    act = policies.in_environment(policies.make_policy("expert", 0), environment)
    episode = EpisodeRecorder(environment, "type1_bca").record_episode(act, 0)
    environment.close()
    return episode


def compare_forces(
    episode: Episode | None = None,
    mean: float = protocol.REFERENCE_MEAN,
    sd: float = protocol.REFERENCE_SD,
    margin: float = protocol.EQUIVALENCE_MARGIN,
) -> Report:
    """Compares the forces of a cannulation with a normal reference, see `protocol`.

    Args:
        episode: Recorded cannulation, such as a manual one of `cathsim play`; None
            records one of the expert.
        mean: Mean of the normal reference, N.
        sd: Standard deviation of the reference, N.
        margin: Equivalence margin of the means, N.

    Returns:
        A report without checks, with findings "protocol" and data "samples" (n,) N.

    Raises:
        ValueError: if the episode has too few contacts, or a number is not positive.
    """
    bounds.number("mean", mean, low=0.0)
    for name, value in (("sd", sd), ("margin", margin)):
        bounds.number(name, value, positive=True)
    if episode is None:
        episode = expert_cannulation()
    bounds.instance("episode", episode, Episode)
    samples = protocol.load_cell_samples(episode)
    found = protocol.compare(samples, mean, sd, margin)
    about = {"task": episode.task, "termination": episode.termination, **found}
    return Report("forces, protocol", [], {"protocol": about}, {"samples": samples})


def validate_forces(**protocol_options: Any) -> Report:
    """Runs every check of the forces, and the published protocol.

    Args:
        **protocol_options: Arguments of `compare_forces`.
    """
    # Compared first, to refuse an episode without contacts before the long checks.
    compared = compare_forces(**protocol_options)
    pushed = {"guiding": [dead_end(command) for command in PUSHES]}
    pushed["wide"] = [dead_end(command, WIDE_TUBE) for command in PUSHES]
    data = {"pushed": pushed, **compared.data}
    return Report("forces", list(_checks(pushed)), compared.findings, data)
