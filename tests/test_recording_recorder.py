import copy
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from dm_control import composer, mjcf
from dm_control.composer.observation import observable
from recording_samples import make_episode

from cathsim_dmc.recording.recorder import EpisodeRecorder, read_step
from cathsim_dmc.recording.scene import body_geoms

LINKS = 3
LINK_LENGTH = 0.02
RADIUS = 0.003
WALL_Z = 0.15
CONTROL_TIMESTEP = 0.02
PUSH = 2.0


class Catheter(composer.Entity):
    """Three rigid links on a slide that a motor pushes along +z."""

    def _build(self):
        self._root = mjcf.RootElement(model="catheter")
        parent = self._root.worldbody
        for i in range(LINKS):
            body = parent.add(
                "body", name=f"link_{i}", pos=[0, 0, LINK_LENGTH if i else 0]
            )
            body.add(
                "geom",
                name=f"link_{i}",
                type="capsule",
                size=[RADIUS],
                fromto=[0, 0, 0, 0, 0, LINK_LENGTH],
                mass=0.05,
            )
            if i == 0:
                slide = body.add(
                    "joint", name="insertion", type="slide", axis=[0, 0, 1], damping=10
                )
            else:
                body.add(
                    "joint",
                    name=f"bend_x_{i}",
                    type="hinge",
                    axis=[1, 0, 0],
                    stiffness=1,
                    damping=0.05,
                )
            parent = body
        parent.add("site", name="head", pos=[0, 0, LINK_LENGTH])
        self._root.actuator.add(
            "motor", name="translation", joint=slide, gear=[PUSH], ctrlrange=[-1, 1]
        )

    @property
    def mjcf_model(self):
        return self._root


class Robot(composer.Entity):
    def _build(self):
        self._root = mjcf.RootElement(model="robot")
        body = self._root.worldbody.add("body", name="carriage", pos=[0, 0, -0.1])
        body.add("geom", name="plate", type="box", size=[0.02, 0.03, 0.004])
        body.add("geom", name="pad", type="sphere", size=[0.01], rgba=[1, 0, 0, 0])

    @property
    def mjcf_model(self):
        return self._root


class PushTask(composer.Task):
    """Push against a wall; the goal is a place in front of it."""

    def __init__(self, goal=0.12, diverge_at=None):
        self._arena = composer.Arena()
        self._arena.mjcf_model.option.gravity = [0, 0, 0]
        self._wall = self._arena.mjcf_model.worldbody.add(
            "geom", name="wall", type="box", size=[0.1, 0.1, 0.01], pos=[0, 0, WALL_Z]
        )
        self._arena.attach(Robot())
        self._catheter = Catheter()
        self._arena.attach(self._catheter)
        self._observables = {
            "time": observable.Generic(lambda physics: np.array([physics.time()]))
        }
        self._observables["time"].enabled = True
        self.set_timesteps(CONTROL_TIMESTEP, 0.002)
        self.goal_position = np.array([0.0, 0.0, goal])
        self.objective = SimpleNamespace(goal_radius=0.004)
        self._diverge_at = diverge_at
        self.termination = None

    @property
    def root_entity(self):
        return self._arena

    @property
    def task_observables(self):
        return self._observables

    def initialize_episode(self, physics, random_state):
        self.termination = None
        physics.named.data.qpos["catheter/insertion"] = random_state.uniform(0, 0.02)

    def before_step(self, physics, action, random_state):
        super().before_step(physics, action, random_state)
        if self._diverge_at is not None and physics.time() >= self._diverge_at:
            physics.named.data.qvel["catheter/insertion"] = np.nan

    def after_step(self, physics, random_state):
        head = physics.named.data.site_xpos["catheter/head"]
        if np.linalg.norm(head - self.goal_position) < self.objective.goal_radius:
            self.termination = "success"
        force = np.linalg.norm(self.contacts(physics).force, axis=-1)
        total, largest = force.sum(), force.max(initial=0.0)
        self.wall_force = SimpleNamespace(
            sum=total, max=largest, peak_sum=2 * total, peak_max=2 * largest
        )
        push = PUSH * float(physics.data.actuator_force[0])
        self.readings = SimpleNamespace(push_force=push)

    def info(self):
        return {"reward_distance": -1.0, "reward_success": 0.0, "distance": 1.0}

    def contacts(self, physics):
        """Forces on the wall at the present state, from MuJoCo's contact forces.

        After composer's step the contacts are new and the forces old, so they are
        computed afresh, on a copy that keeps the actuators on.
        """
        model, data = physics.model.ptr, copy.copy(physics.data.ptr)
        mujoco.mj_forward(model, data)
        wall = physics.model.name2id("wall", "geom")
        position, force = [], []
        for index, contact in enumerate(data.contact):
            if wall not in contact.geom:
                continue
            local = np.zeros(6)
            mujoco.mj_contactForce(model, data, index, local)
            # mj_contactForce acts on geom2, along the axes in the rows of frame.
            sign = 1.0 if contact.geom[1] == wall else -1.0
            position.append(np.array(contact.pos))
            force.append(sign * local[:3] @ contact.frame.reshape(3, 3))
        # As in the real task, empty places of the sensor are marked.
        position.append(np.zeros(3))
        force.append(np.zeros(3))
        return SimpleNamespace(
            position=np.array(position),
            force=np.array(force),
            present=np.arange(len(force)) < len(force) - 1,
        )

    def should_terminate_episode(self, physics):
        return self.termination is not None

    def get_discount(self, physics):
        return 0.0 if self.termination else 1.0

    def get_reward(self, physics):
        head = physics.named.data.site_xpos["catheter/head"]
        return -float(np.linalg.norm(head - self.goal_position))


def make_env(**kwargs):
    return composer.Environment(
        PushTask(**kwargs),
        time_limit=1.0,
        random_state=0,
        strip_singleton_obs_buffer_dim=True,
    )


@pytest.fixture(scope="module")
def wall_env():
    return make_env(goal=1.0)


def push(timestep):
    return np.array([1.0])


def test_the_record_follows_the_simulation(wall_env):
    seen = []

    def policy(timestep):
        seen.append(float(timestep.observation["time"][0]))
        return np.array([0.5 if len(seen) % 2 else 1.0])

    episode = EpisodeRecorder(wall_env, "push", {"goal": 1.0}).record_episode(
        policy, seed=3
    )
    assert episode.termination == "truncated" and not episode.success
    assert episode.steps == 50
    np.testing.assert_allclose(episode.time, CONTROL_TIMESTEP * np.arange(51))
    np.testing.assert_allclose(episode.time[:-1], seen)
    assert episode.catheter.shape == (51, LINKS + 1, 3)
    lengths = np.linalg.norm(np.diff(episode.catheter, axis=1), axis=-1)
    np.testing.assert_allclose(lengths, LINK_LENGTH)
    names = episode.meta["body_names"]
    link = names.index("catheter/link_2")
    np.testing.assert_array_equal(episode.catheter[:, 2], episode.body_pos[:, link])
    np.testing.assert_allclose(episode.catheter[:, 0, 2], episode.insertion)
    np.testing.assert_array_equal(episode.action[:2, 0], [0.5, 1.0])
    np.testing.assert_allclose(episode.reward, -np.array(episode.meta["distance"])[1:])
    assert episode.meta["catheter_radius"] == [RADIUS] * LINKS
    assert episode.meta["action_names"] == ["catheter/translation"]
    assert episode.meta["task_kwargs"] == {"goal": 1.0}
    assert episode.meta["versions"]["mujoco"] == mujoco.__version__
    physics = wall_env.physics
    np.testing.assert_array_equal(episode.qpos[-1], physics.data.qpos)
    np.testing.assert_array_equal(
        episode.head[-1], physics.named.data.site_xpos["catheter/head"]
    )


def test_contacts_press_on_the_wall_and_agree_with_the_task(wall_env):
    episode = EpisodeRecorder(wall_env).record_episode(push, seed=0)
    assert episode.contact_counts[0] == 0 and episode.contact_counts[-1] > 0
    # At rest the wall takes what the motor gives, along +z.
    final = episode.contact_force[episode.contact_step == episode.steps - 1]
    np.testing.assert_allclose(final.sum(axis=0), [0, 0, PUSH], atol=0.01)
    np.testing.assert_allclose(episode.push_force, PUSH)
    surface = WALL_Z - 0.01
    assert np.abs(episode.contact_position[:, 2] - surface).max() < 0.002
    magnitude = np.linalg.norm(episode.contact_force, axis=-1)
    total = np.bincount(episode.contact_step, magnitude, minlength=episode.steps)
    np.testing.assert_allclose(episode.wall_force_sum, total)
    assert (episode.wall_force_max <= episode.wall_force_sum + 1e-12).all()
    terms = episode.meta["reward_terms"]
    assert terms == {
        "distance": [-1.0] * episode.steps,
        "success": [0.0] * episode.steps,
    }
    peaks = episode.meta["wall_force_peak_max"]
    np.testing.assert_allclose(peaks, 2 * episode.wall_force_max)


def test_a_seed_repeats_an_episode_bit_for_bit(wall_env):
    recorder = EpisodeRecorder(wall_env)
    first = recorder.record_episode(push, seed=7, max_steps=8)
    other = recorder.record_episode(push, seed=8, max_steps=8)
    again = recorder.record_episode(push, seed=7, max_steps=8)
    assert again.equals(first)
    assert not np.array_equal(other.qpos, first.qpos)
    unseeded = recorder.record_episode(push, max_steps=8)
    assert unseeded.seed is None
    assert not np.array_equal(unseeded.qpos, again.qpos)


def test_success_ends_the_episode():
    episode = EpisodeRecorder(make_env(goal=0.1)).record_episode(push, seed=0)
    assert episode.success and episode.meta["discount"] == 0.0
    assert episode.meta["distance"][-1] < episode.meta["goal_radius"]
    assert min(episode.meta["distance"][:-1]) >= episode.meta["goal_radius"]


@pytest.mark.parametrize("raises", [True, False])
def test_a_diverged_step_is_left_out(raises):
    env = composer.Environment(
        PushTask(goal=1.0, diverge_at=0.099),
        raise_exception_on_physics_error=raises,
        strip_singleton_obs_buffer_dim=True,
    )
    episode = EpisodeRecorder(env).record_episode(push, seed=0)
    assert episode.termination == "physics_error"
    assert episode.steps == 5
    assert episode.meta["error"]
    np.testing.assert_allclose(episode.time[-1], 0.1)


def test_wrong_actions_are_refused(wall_env):
    recorder = EpisodeRecorder(wall_env)
    with pytest.raises(ValueError, match=r"shape \(2,\)"):
        recorder.record_episode(lambda timestep: np.zeros(2))
    with pytest.raises(ValueError, match="nan"):
        recorder.record_episode(lambda timestep: np.array([np.nan]))
    with pytest.raises(ValueError, match="at least 1"):
        recorder.record_episode(push, max_steps=0)


def test_a_model_without_a_catheter_is_refused():
    class Empty(composer.NullTask):
        pass

    env = composer.Environment(
        Empty(composer.Arena()), strip_singleton_obs_buffer_dim=True
    )
    with pytest.raises(ValueError, match="no body 'catheter/link_0'"):
        EpisodeRecorder(env)


def test_an_unknown_termination_is_refused():
    env = make_env(goal=1.0)
    recorder = EpisodeRecorder(env)

    def policy(timestep):
        env.task.termination = "bored"
        return np.array([0.0])

    with pytest.raises(ValueError, match="bored"):
        recorder.record_episode(policy)


def test_read_step_makes_copies(wall_env):
    wall_env.reset()
    wall_env.step(np.array([1.0]))
    readout = read_step(wall_env.task, wall_env.physics)
    assert readout.contact_force.shape == (0, 3)
    assert readout.wall_force_sum == 0.0


def test_body_geoms_are_the_visible_primitives_of_an_entity(wall_env):
    (plate,) = body_geoms(wall_env.physics)
    assert plate.kind == "box" and plate.body_name == "robot/carriage"
    np.testing.assert_allclose(plate.size, [0.02, 0.03, 0.004])
    episode = EpisodeRecorder(wall_env).record_episode(push, seed=0, max_steps=2)
    np.testing.assert_allclose(episode.body_pos[:, plate.body], [[0, 0, -0.1]] * 3)
    links = body_geoms(wall_env.physics, ["catheter"])
    assert [g.kind for g in links] == ["capsule"] * LINKS
    np.testing.assert_allclose(links[0].size, [RADIUS, LINK_LENGTH / 2])
    assert body_geoms(wall_env.physics, ["sheath"]) == ()


def test_a_recorded_episode_survives_a_file(wall_env, tmp_path):
    episode = EpisodeRecorder(wall_env).record_episode(push, seed=0, max_steps=3)
    loaded = type(episode).load(episode.save(tmp_path / "e.npz"))
    assert loaded.equals(episode) and not loaded.equals(make_episode())
