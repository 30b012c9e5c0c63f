"""Looking at a state or an episode in one call, on a machine without OpenGL."""

import dataclasses
import re
import sys

import numpy as np
import pytest
from matplotlib.colors import to_hex
from PIL import Image
from recording_samples import make_episode, make_tube, same

import cathsim_dmc
from cathsim_dmc import agents, suite
from cathsim_dmc.anatomy import Anatomy, phantoms
from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.imaging.fluoroscopy import Fluoroscope
from cathsim_dmc.physics.effects import Effect
from cathsim_dmc.physics.forces import PEAK_NOTE
from cathsim_dmc.pictures import animation, curves, recorded
from cathsim_dmc.pictures.anatomies import Picture, draw_anatomy
from cathsim_dmc.pictures.animation import animate
from cathsim_dmc.pictures.figure import draw_fluoroscopy, scene_figure
from cathsim_dmc.pictures.moment import Moment, on_screen, xray
from cathsim_dmc.pictures.readout import LEAST_FORCE
from cathsim_dmc.pictures.recorded import write, xray_film
from cathsim_dmc.pictures.translucent import ParallelProjection, glass
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.geometry import force_colours, force_scale, force_text
from cathsim_dmc.simulation.torchrl import BatchedEnv

TASK = "simple1_bca"


@pytest.fixture(scope="module")
def pushed():
    """An environment whose device presses on the wall, and the record of it."""
    env = suite.load("cathsim", TASK, task_kwargs={"random": 0})
    for steps in range(60, 75):  # contacts come and go
        episode = cathsim_dmc.record(env, "push", seed=0, max_steps=steps)
        if (episode.contact_step == steps - 1).any():
            return env, episode
    raise AssertionError("no control step ends with a contact")


def test_forces_are_those_of_the_task(pushed):
    env, episode = pushed
    readout = cathsim_dmc.forces(env)
    loaded = np.linalg.norm(episode.contact_force, axis=1) >= LEAST_FORCE
    last = (episode.contact_step == episode.steps - 1) & loaded
    np.testing.assert_array_equal(readout.force, episode.contact_force[last])
    np.testing.assert_allclose(
        readout.magnitude, np.linalg.norm(readout.force, axis=1), rtol=1e-9
    )
    assert len(readout) == last.sum() > 0
    assert readout.wall_sum == episode.wall_force_sum[-1]
    assert readout.push_force == episode.push_force[-1]
    assert readout.push_torque == env.task.readings.push_torque != readout.push_force
    np.testing.assert_array_equal(readout.load_cell, env.task.readings.load_cell)
    # What bears a force is pressed in.
    assert (readout.penetration > 0.0).all() and readout.penetration.max() < 1e-3
    text = repr(readout)
    assert f"{1e3 * readout.wall_max:.2f} mN" in text
    means = dataclasses.replace(readout, wall_mean_sum=0.012, wall_mean_max=0.003)
    assert "mean over the step: sum 12.00 mN, largest 3.00 mN" in repr(means)
    cell = ", ".join(f"{1e3 * one:.1f}" for one in readout.load_cell)
    assert f"load cell ({cell}) mN" in text
    row = [*1e3 * readout.position[0], *1e3 * readout.force[0]]
    found = [float(word) for word in text.splitlines()[4].split()]
    np.testing.assert_allclose(found, row, atol=0.051)
    assert readout.wall_mean_sum == episode.meta["wall_force_mean_sum"][-1]
    assert len(text.splitlines()) == 5 + len(readout)
    assert PEAK_NOTE in text
    assert len(readout.position) == len(readout.penetration) == len(readout)


def test_within_a_control_step_forces_are_those_of_the_contacts():
    env = suite.load("cathsim", TASK, {"random": 0, "physics_timestep": 0.001})
    env.reset()
    assert not cathsim_dmc.forces(env).wall_mean_sum
    sums = []

    def sample(physics, random_state):
        with pytest.raises(RuntimeError, match="control step has begun and not ended"):
            cathsim_dmc.forces(env)
        sums.append(env.task.contacts(physics).magnitude.sum())

    env.add_extra_hook("after_substep", sample)
    for _ in range(65):
        sums.clear()
        env.step(np.eye(21)[-1])
    readout = cathsim_dmc.forces(env)
    assert (
        len(sums) == 40
        and max(sums) > 0.0
        and sums[-1] == pytest.approx(readout.wall_sum, rel=1e-12)
    )
    assert sum(sums) == pytest.approx(40 * readout.wall_mean_sum, rel=1e-12)
    assert max(sums) == pytest.approx(readout.wall_peak_sum, rel=1e-12)


def test_contacts_that_bear_nothing_are_left_out(pushed, monkeypatch):
    env, _ = pushed
    task, number = env.task, len(cathsim_dmc.forces(env))
    contacts = task.contacts(env.physics)
    force, magnitude = contacts.force.copy(), contacts.magnitude.copy()
    first = np.flatnonzero(contacts.present & (magnitude >= LEAST_FORCE))[0]
    for value, kept in ((0.0, number - 1), (4e-6, number - 1), (6e-6, number)):
        magnitude[first] = value
        made = dataclasses.replace(contacts, force=force, magnitude=magnitude)
        monkeypatch.setattr(type(task), "contacts", lambda self, physics, m=made: m)
        readout = cathsim_dmc.forces(env)
        assert len(readout) == kept and f"{kept} contact" in repr(readout)


def test_an_episode_is_plotted_over_time(pushed):
    _, episode = pushed
    figure = cathsim_dmc.plot(episode)
    top, middle, bottom = figure.axes
    curves = {line.get_label(): line.get_xydata() for line in top.lines}
    means = np.array(episode.meta["wall_force_mean_sum"])
    np.testing.assert_allclose(curves["wall, sum"][:, 1], 1e3 * means)
    np.testing.assert_allclose(curves["wall, sum"][:, 0], episode.time[1:])
    peak = curves["wall, peak sum of a physics step*"][:, 1]
    assert (peak >= curves["wall, sum"][:, 1]).all()
    assert any(PEAK_NOTE in text.get_text() for text in top.texts)
    np.testing.assert_allclose(middle.lines[0].get_ydata(), 1e3 * episode.insertion)
    np.testing.assert_allclose(
        bottom.lines[0].get_ydata(), 1e3 * np.array(episode.meta["distance"])
    )
    np.testing.assert_allclose(bottom.lines[1].get_ydata(), 8.0)  # radius of the goal
    assert TASK in figure.get_suptitle() and "truncated" in figure.get_suptitle()
    # Within the goal, after a snapshot of two seconds.
    meta = {**episode.meta, "distance": [1e-3] * len(episode.time)}
    near = dataclasses.replace(episode, meta=meta, time=episode.time + 2.0)
    bottom = cathsim_dmc.plot(near).axes[-1]
    assert bottom.get_ylim()[1] > 8.0
    assert (bottom.get_xlim()[0], bottom.lines[0].get_xdata()[0]) == (0.0, 0.0)
    with pytest.raises(TypeError, match="Episode.load.*str"):
        cathsim_dmc.plot("episode.npz")


def test_each_of_coaxial_devices_has_its_curve():
    ends = np.linspace([0.1, 0.08], [0.12, 0.09], 7)
    series = {"rotation": [0.0] * 7, "tip_rotation": [0.0] * 7, "radius": 1e-3}
    devices = [
        {"name": name, "insertion": way.tolist(), **series}
        for name, way in zip(("wire", "catheter"), ends.T, strict=True)
    ]
    episode = make_episode()
    meta = {**episode.meta, "devices": devices}
    _, axes, _ = cathsim_dmc.plot(dataclasses.replace(episode, meta=meta)).axes
    assert [line.get_label() for line in axes.lines] == ["wire", "catheter"]
    found = [line.get_ydata() for line in axes.lines]
    np.testing.assert_allclose(found, 1e3 * ends.T)


def test_coaxial_devices_have_their_colours_and_their_ends():
    line = np.zeros((7, 5, 3))
    line[..., 2] = 0.01 * np.arange(5)
    ends = np.linspace([0.1, 0.1], [0.12, 0.105], 7)  # at last 15 mm of wire stand out
    turns = {"rotation": [0.0] * 7, "tip_rotation": [0.0] * 7}
    devices = [
        {"name": name, "insertion": way.tolist(), "radius": radius, **turns}
        for name, radius, way in zip(("a", "b"), (0.4e-3, 0.8e-3), ends.T, strict=True)
    ]
    goal = {"goal_position": [0.0, 0.0, 0.0], "goal_radius": 8e-3}
    episode = make_episode(counts=np.zeros(6, int), catheter=line)
    meta = {**episode.meta, **goal, "devices": devices}
    episode = dataclasses.replace(episode, meta=meta)
    moment = Moment.of_episode(episode, make_tube())
    figure = scene_figure(moment, views=("front",), fluoroscopy=False, pixels=100)
    axes = figure.axes[0]
    dark = [each for each in axes.collections if hasattr(each, "get_segments")][1]
    colours = [to_hex(colour) for colour in dark.get_colors()]
    assert colours == 18 * ["#173a63"] + 6 * ["#0b6b5a"]
    points = [one.get_xydata() for one in axes.lines if one.get_marker() == "o"]
    np.testing.assert_allclose(np.concatenate(points)[:2], [[0, 40], [0, 25]])


def test_phases_are_what_the_base_does(pushed):
    _, episode = pushed
    # 25 mm/s, 1.25 mm/s, -1 mm/s and -2.5 mm/s; the base rests below 2 mm/s.
    steps = [1e-3] * 10, [5e-5] * 10, [1e-3], [-4e-5] * 9, [-1e-4] * 8
    way = np.cumsum([0.0, *np.concatenate(steps)])
    states = len(way)
    made = dataclasses.replace(
        episode,
        time=0.04 * np.arange(states),
        insertion=way,
        **{
            name: np.zeros((states, *getattr(episode, name).shape[1:]))
            for name in ("qpos", "catheter", "body_pos", "body_quat")
        },
        **{
            name: np.zeros((states - 1, *getattr(episode, name).shape[1:]))
            for name in ("action", "reward", "wall_force_sum", "wall_force_max")
        },
        push_force=np.zeros(states - 1),
        contact_step=np.array([3, 4, 4, 9]),
        contact_position=np.zeros((4, 3)),
        contact_force=np.zeros((4, 3)),
        meta={"success": False, "termination": "truncated"},
    )
    # A single step of motion is no phase.
    assert curves.phases(made) == [
        ("advance", 0, 10),
        ("rest", 10, 30),
        ("withdraw", 30, 38),
    ]
    top, _, bottom = cathsim_dmc.plot(made).axes
    bars = [patch for patch in top.patches if patch.get_height() < 0.5]
    spans = [(bar.get_x(), bar.get_x() + bar.get_width()) for bar in bars]
    np.testing.assert_allclose(spans, [(0.12, 0.2), (0.36, 0.4)])
    assert "no goal" in bottom.texts[0].get_text()


def test_the_help_lists_what_there_is():
    text = cathsim_dmc.__doc__ or ""
    listed = set(re.findall(r"(?m)^    (\w+)  ", text))
    assert listed == {*cathsim_dmc._SUBMODULES, *cathsim_dmc._FUNCTIONS}
    assert listed <= set(dir(cathsim_dmc))


def test_a_film_as_mp4_plays_the_episode(pushed, tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra video")
    import imageio.v2 as imageio

    env, episode = pushed
    surface = env.task.scene.anatomy.surface
    path = animate(episode, surface, tmp_path / "film.mp4", frames=4, width=321)
    with imageio.get_reader(path) as film:
        about = film.get_meta_data()
        frames = [np.asarray(frame).astype(int) for frame in film]
    assert about["codec"] == "h264" and about["pix_fmt"].startswith("yuv420p")
    columns, rows = about["size"]
    assert rows % 2 == columns % 2 == 0 and abs(columns - 321) < 4
    # Four pictures, and the last one for a while.
    seconds = episode.time[-1] - episode.time[0]
    assert len(frames) == 4 + int(1500 // (1000 * seconds / 3))
    assert about["duration"] == pytest.approx(seconds / 3 * len(frames), abs=0.1)
    moved = np.abs(frames[0] - frames[3]).mean()
    still = np.abs(frames[3] - frames[-1]).mean()
    assert moved > 1 > 3 * still


def test_the_x_ray_of_a_scan_that_lies_is_not_too_small_to_see(pushed, tmp_path):
    env, episode = pushed
    surface = env.task.scene.anatomy.surface
    lying = dataclasses.replace(surface, vertices=surface.vertices * [6.0, 1.0, 1.0])
    path = animate(episode, lying, tmp_path / "film.webp", frames=1, width=320)
    with Image.open(path) as film:
        width, height = film.size
    # As wide as 0.66 of the height of the film.
    assert height > width / 2.5


@pytest.mark.parametrize("upright", [True, False])
def test_the_sides_of_a_patient_are_named_where_they_are_known(pushed, upright):
    env, episode = pushed
    assert episode.meta["upright"]
    meta = {**episode.meta, "upright": upright}
    kept = dataclasses.replace(episode, meta=meta)
    moment = Moment.of_episode(kept, env.task.scene.anatomy.surface)
    front = scene_figure(moment, fluoroscopy=False, pixels=100).axes[0]
    assert ("front" in front.get_title()) == upright
    assert ("head" in front.get_ylabel()) == ("left" in front.get_xlabel()) == upright


def test_without_an_encoder_no_work_is_lost(pushed, tmp_path, monkeypatch):
    env, _ = pushed
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)

    def never(observation):
        raise AssertionError("it was played")

    with pytest.raises(ImportError, match=r"\.\[video\]"):
        cathsim_dmc.record(env, never, tmp_path / "film.mp4")
    assert not list(tmp_path.iterdir())


def test_a_film_that_its_encoder_cuts_short_is_refused(pushed, tmp_path, small_disk):
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra video")
    env, episode = pushed
    (tmp_path / "film.mp4").write_bytes(b"older")
    surface, short = env.task.scene.anatomy.surface, r"0 of \d+ pictures.*film\.mp4"
    with small_disk(10_000), pytest.raises(OSError, match=short):
        animate(episode, surface, tmp_path / "film.mp4", frames=4, width=320)
    assert [one.read_bytes() for one in tmp_path.iterdir()] == [b"older"]


def test_the_fluoroscopy_of_a_state_shows_where_the_head_is(pushed):
    env, _ = pushed
    options = {"size": 96, "contrast": False}
    image = cathsim_dmc.fluoroscopy(env, **options)
    assert image.shape == (96, 96) and image.dtype == np.uint8
    arm = dataclasses.replace(env.task.config.fluoroscopy, **options).carms(
        env.task.scene.anatomy.surface.vertices
    )[0]
    column, row = arm.project(env.task.readings.head)[0].round().astype(int)
    assert image[row, column] < image.max() - 20


@pytest.mark.parametrize(
    ("task", "options"),
    [
        (TASK, {"randomisation": {"view": [4, 5], "gain": [0.85, 0.9]}}),
        ("simple1_lcca_pair", {}),
        (TASK, {"vessel": "living"}),
        (TASK, {"fluoroscopy": {"view": "best", "biplane": "best", "size": 64}}),
    ],
)
def test_x_ray_pictures_show_what_the_task_observes(task, options):
    usual = {"fluoroscopy": {"view": [30, 10], "size": 64}, "observation": "image"}
    options = usual | options
    env = suite.load("cathsim", task, {"random": 0, **options})
    forward = np.eye(env.action_spec().shape[0])[-2 if task.endswith("pair") else -1]
    episode = cathsim_dmc.record(env, lambda _: forward, seed=3, max_steps=8)
    image = env.task.observation["image"][0, ..., 0]
    np.testing.assert_array_equal(cathsim_dmc.fluoroscopy(env), image)
    surface = env.task.scene.anatomy.surface
    moment = Moment.of_episode(episode, surface)
    np.testing.assert_allclose(moment.goal, env.task.rollout.goal.reshape(3))
    own = moment.x_ray.options
    assert np.abs(xray(moment, own).astype(int) - image).max() <= 1
    film = xray_film(episode, surface, own)[-1, ..., 0]  # in the contrast of a screen
    assert np.corrcoef(film.ravel(), image.ravel())[0, 1] > 0.9999
    axes, turned = Picture().add_subplot(), moment.x_ray.deviation
    draw_fluoroscopy(axes, moment)
    angles = turned.primary, turned.secondary
    (arm,) = on_screen(own).carms(surface.vertices, angles)
    ring = axes.patches[0].center
    np.testing.assert_allclose(ring, arm.project(moment.goal)[0])


def test_a_film_is_drawn_a_few_states_at_a_time(pushed, monkeypatch):
    """Images of all states at once take gigabytes: half of a minute in the system."""
    env, episode = pushed
    own = env.task.config.fluoroscopy
    options, surface = on_screen(own, size=32), env.task.scene.anatomy.surface
    drawn, render = [], Fluoroscope.render

    def count(self, shadows, *random_states):
        images = render(self, shadows, *random_states)
        drawn.append(len(images))
        return images

    monkeypatch.setattr(Fluoroscope, "render", count)
    film = xray_film(episode, surface, options)
    assert sum(drawn) == episode.steps + 1 > max(drawn) * 4
    assert (film.min(), film.max()) == (0, 255)
    monkeypatch.setattr(recorded, "_TOGETHER", 1000)
    np.testing.assert_array_equal(xray_film(episode, surface, options), film)


def test_an_episode_is_drawn_in_its_own_anatomy(pushed, tmp_path):
    env, episode = pushed
    other = dataclasses.replace(episode, meta=episode.meta | {"anatomy": "type2"})
    for draw in (
        lambda: cathsim_dmc.show(env, other),
        lambda: write(other, env, tmp_path / "other.gif"),
    ):
        with pytest.raises(ValueError, match="'type2 .*'simple1 .*load the task"):
            draw()
    other = dataclasses.replace(episode, meta=episode.meta | {"lumen": "0badcafe"})
    with pytest.raises(ValueError, match="'simple1 0badcafe'.*'simple1 [0-9a-f]{8}'"):
        cathsim_dmc.show(env, other)
    gone = "anatomy", "lumen", "x_ray"
    kept = {k: v for k, v in episode.meta.items() if k not in gone}
    old = dataclasses.replace(episode, meta=kept)
    assert cathsim_dmc.show(env, old, views=())


@pytest.mark.slow
def test_a_picture_shows_every_panel_and_is_the_same_again(pushed):
    env, episode = pushed
    figure = cathsim_dmc.show(env)
    titles = [axes.get_title() for axes in figure.axes]
    assert {"from the front", "from the left", "fluoroscopy"} <= set(titles)
    assert TASK in figure.get_suptitle() and "mN" in figure.get_suptitle()
    assert figure._repr_png_() == cathsim_dmc.show(env)._repr_png_()
    one = cathsim_dmc.show(env, episode, step=0, views=("front",), fluoroscopy=False)
    assert "no contact" in one.get_suptitle()
    assert one._repr_png_() != figure._repr_png_()


def test_the_moment_of_a_record_is_that_of_the_environment(pushed):
    env, episode = pushed
    live = Moment.of(env)
    kept = Moment.of_episode(episode, live.surface)
    for name in ("device", "radius", "goal", "position", "force"):
        np.testing.assert_allclose(
            getattr(kept, name), getattr(live, name), atol=1e-12, err_msg=name
        )
    start = Moment.of_episode(episode, live.surface, 0)
    assert len(start.force) == 0 and len(start.path) == 1


def test_glass_covers_what_the_surface_covers_and_darkens_at_the_rim():
    tube = make_tube(radius=0.02, length=0.08, sides=48, rings=9)
    projection = ParallelProjection.of(tube.vertices, margin=0.01, size=200)
    picture = glass(tube, projection)
    alpha = picture.behind[..., 3]
    rows, columns = projection.shape
    assert alpha.shape == (rows, columns)
    middle = alpha[rows // 2]
    inside = np.flatnonzero(middle > 0)
    width = len(inside) / projection.pixels
    assert abs(width - 0.04) < 1.5 / projection.pixels
    # Two walls behind each other cover more than one, the rim most of all.
    assert picture.glaze[rows // 2, columns // 2, 3] < middle[columns // 2]
    assert middle[inside[2]] > 2 * middle[columns // 2]
    assert alpha[0].max() == 0 == alpha[:, 0].max()


def test_glass_draws_the_nearest_of_many_walls():
    tube = make_tube(radius=0.02, length=0.08, sides=48, rings=9)
    projection = ParallelProjection.of(tube.vertices, margin=0.01, size=60)
    wall = tube.vertices * (1.0, 1e-3, 1.0)  # two flat walls, one behind the other
    away = -projection.towards * 1e-3 * np.arange(16)[:, None]
    walls = [wall + step for step in away]
    tilted = tube.vertices + 0.1 * projection.towards  # in front of them, rounder
    drawn = [
        glass(Surface(np.vstack(vertices), np.vstack(faces)), projection)
        for vertices, faces in (
            _stacked([*walls, tilted], tube.faces),
            _stacked([*walls[:7], tilted], tube.faces),
        )
    ]
    np.testing.assert_array_equal(drawn[0].behind, drawn[1].behind)


def _stacked(vertices, faces):
    return vertices, [faces + len(vertices[0]) * i for i in range(len(vertices))]


@pytest.mark.parametrize("right", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.6, 0.8, 0.0)])
def test_a_projection_maps_points_to_their_pixels(right):
    points = np.random.default_rng(0).normal(size=(20, 3))
    projection = ParallelProjection.of(points, right)
    # The viewer of the front stands before the chest: towards him is -y.
    np.testing.assert_allclose(projection.towards, [right[1], -right[0], 0.0])
    pixel = projection.pixel(points)
    rows, columns = projection.shape
    assert (pixel >= 0).all() and (pixel <= [columns, rows]).all()
    highest = points[:, 2].argmax()
    assert pixel[highest, 1] == pixel[:, 1].min()


@pytest.mark.parametrize(
    "suffix",
    [
        ".rrd",
        ".npz",
        pytest.param(".webp", marks=pytest.mark.slow),
        pytest.param(".gif", marks=pytest.mark.slow),
    ],
)
def test_a_function_of_the_observation_is_recorded(pushed, tmp_path, suffix):
    env, _ = pushed
    seen = []

    def policy(observation):
        seen.append(sorted(observation))
        return np.eye(21)[20]  # forward

    path = tmp_path / f"episode{suffix}"
    episode = cathsim_dmc.record(env, policy, path, seed=1, max_steps=4)
    assert episode.task == TASK and episode.steps == 4 and len(seen) == 4
    assert seen[0] == sorted(env.observation_spec())
    assert episode.insertion[-1] > episode.insertion[0]
    if suffix == ".npz":
        assert same(Episode.load(path), episode)
    if suffix in (".gif", ".webp"):
        film = Image.open(path)
        assert film.n_frames == 5 and film.size[0] == 860
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_seed_is_that_of_a_random_policy_too(pushed):
    env, _ = pushed
    first, again, other = (
        cathsim_dmc.record(env, "random", seed=seed, max_steps=2).action
        for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).all()


def test_the_frames_of_a_film_differ_where_the_device_moves(pushed, tmp_path):
    env, episode = pushed
    surface = env.task.scene.anatomy.surface
    path = animate(episode, surface, tmp_path / "a.webp", frames=3, width=400)
    film, frames = Image.open(path), []
    for number in range(3):
        film.seek(number)
        frames.append(np.asarray(film.convert("RGB"), dtype=int))
    assert film.info["duration"] > 1000  # the last one stays
    assert np.abs(frames[0] - frames[-1]).max() > 100


@pytest.mark.parametrize(
    "steps, count, tick, seconds",
    [(4, 5, 500, 2.0), (103, 90, 46, 4.12)],  # a GIF has steps of 10 ms
)
def test_a_film_takes_the_time_of_the_episode_and_a_rest(
    steps, count, tick, seconds, tmp_path, monkeypatch
):
    grey = np.tile(np.arange(64, dtype=np.uint8)[:, None], (64, 1, 3))

    def frames(episode, surface, width, steps):
        return (np.roll(grey, number, axis=1) for number in range(len(steps)))

    monkeypatch.setattr(animation, "_frames", frames)
    film = Image.open(animate(make_episode(steps), make_tube(), tmp_path / "a.gif"))
    times = []
    for number in range(film.n_frames):
        film.seek(number)
        times.append(film.info["duration"])
    assert film.n_frames == count and times[-1] == 1500
    assert sum(times[:-1]) == pytest.approx(1000 * seconds, abs=40)
    assert abs(np.array(times[:-1]) - tick).max() <= 10


def test_the_contacts_of_a_state_are_those_of_the_step_that_leads_to_it():
    counts = np.array([2, 0, 3])
    meta = {"goal_position": [0.0, 0.0, 0.0], "goal_radius": 8e-3}
    episode = make_episode(3, counts=counts)
    episode = dataclasses.replace(episode, meta=episode.meta | meta)
    for state, rows in enumerate(([], [0, 1], [], [2, 3, 4])):
        moment = Moment.of_episode(episode, make_tube(), state)
        np.testing.assert_array_equal(moment.position, episode.contact_position[rows])
        np.testing.assert_array_equal(moment.force, episode.contact_force[rows])
        np.testing.assert_array_equal(moment.device, episode.catheter[state])
        assert len(moment.path) == state + 1


def test_the_cursor_of_a_film_stands_at_the_time_of_the_state(pushed, monkeypatch):
    env, episode = pushed
    drawn, draw = [], animation._draw_force

    def kept(axes, episode):
        drawn.append((axes, draw(axes, episode)))
        return drawn[-1][1]

    def x_ray(axes, moment, options, seed, window):
        looks.append((options.noise, options.kerma, seed, window))
        return draw_fluoroscopy(axes, moment, options, seed, window)

    looks = []
    monkeypatch.setattr(animation.drawing, "draw_fluoroscopy", x_ray)
    monkeypatch.setattr(animation, "_draw_force", kept)
    steps = np.array([0, episode.steps // 2, episode.steps])
    surface, places = env.task.scene.anatomy.surface, []
    for _ in animation._frames(episode, surface, 200, steps):
        places.append(drawn[0][1].get_xdata()[0])
    np.testing.assert_allclose(places, 0.04 * steps)
    # Noise of each state is its own, and the grey levels are those of the first.
    noise, dose, seeds, (first, *others) = zip(*looks, strict=True)
    assert all(noise) and set(dose) == {4e-7} and list(seeds) == steps.tolist()
    assert first is None and len(set(others)) == 1 and others[0] is not None
    time, force = drawn[0][0].lines[0].get_data()
    np.testing.assert_allclose(time, 0.04 * np.arange(1, episode.steps + 1))
    largest = np.array(episode.meta["wall_force_mean_max"])
    np.testing.assert_allclose(force, 1e3 * largest)


@pytest.mark.parametrize(
    ("call", "kind", "message"),
    [
        (lambda env: cathsim_dmc.record(env, "expret"), ValueError, "expert"),
        (lambda env: cathsim_dmc.record(env, 3), TypeError, "function"),
        (
            lambda env: cathsim_dmc.record(env, "pretrained:a"),
            ValueError,
            "load_policy",
        ),
        (lambda env: cathsim_dmc.record(env, "push", seed=-1), ValueError, "from 0 to"),
        (lambda env: cathsim_dmc.record(env, str, seed=1.5), ValueError, "an integer"),
        (lambda env: cathsim_dmc.fluoroscopy(env, "LAO45"), TypeError, "positional"),
        (lambda env: cathsim_dmc.fluoroscopy(env, vieww=1), TypeError, "vieww.*view"),
        (lambda env: cathsim_dmc.fluoroscopy(env, biplane="AP"), TypeError, "biplane;"),
        (lambda env: cathsim_dmc.show(env, foo=1), TypeError, "foo.*views"),
        (lambda env: cathsim_dmc.show(env, "a.npz"), ValueError, "it must be an Ep"),
        (lambda env: cathsim_dmc.record(env, "push", "e.avi"), ValueError, "rrd, .npz"),
        (
            lambda env: cathsim_dmc.record(env, "push", "no/e.gif"),
            OSError,
            "no directory",
        ),
        (lambda env: cathsim_dmc.show(env, views=("top",)), ValueError, "front"),
        (
            lambda env: cathsim_dmc.show(env, views=[], fluoroscopy=0),
            ValueError,
            "left",
        ),
        (lambda env: cathsim_dmc.show("env"), TypeError, "suite.load"),
        (lambda env: cathsim_dmc.forces(env.task), TypeError, "suite.load"),
    ],
)
def test_wrong_inputs_say_what_is_allowed(pushed, call, kind, message):
    with pytest.raises(kind, match=message):
        call(pushed[0])


def test_steps_beyond_the_episode_are_refused(pushed):
    env, episode = pushed
    surface = env.task.scene.anatomy.surface
    with pytest.raises(IndexError, match=f"{episode.steps + 1} states"):
        Moment.of_episode(episode, surface, episode.steps + 1)
    with pytest.raises(ValueError, match="film"):
        animate(episode, surface, "episode.avi")


def test_the_scale_of_forces_holds_them_all_and_their_text_has_three_digits():
    scales = [force_scale(np.array(each)) for each in ([], [0.05], [0.01, 0.06], [3.0])]
    assert scales == [0.02, 0.05, 0.1, 0.4]
    lightness = force_colours(np.linspace(0, 0.5, 30), 0.4) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness[:25]) < 0).all() and np.ptp(lightness[25:]) == 0
    texts = [force_text(each) for each in (0.0, 0.01234, 0.9994, 0.9996, 1.1749)]
    assert texts == ["0 mN", "12.3 mN", "999 mN", "1 N", "1.17 N"]


def test_tasks_and_anatomies_say_what_they_are(pushed):
    env, _ = pushed
    for text in (TASK, "'simple1'", "'bca'", "8 mm", "21 actions", "internal"):
        assert text in repr(env.task)
        assert text in repr(env)
    anatomy = env.task.scene.anatomy
    assert len(repr(anatomy)) < 300
    for text in ("simple1", "bca, lcca", "inlet in aorta"):
        assert text in repr(anatomy)
    saved = env.snapshot()
    done = f"of 3 simulations after {3 * saved.arrays['rollout.steps'].tolist()} "
    for text in (done, "goal 'bca'", "'steerable_5f'", "['simple1 "):
        assert text in repr(saved.repeat(3)) and len(repr(saved.repeat(3))) < 400
    assert len(repr(saved.repeat(1000))) < 400
    assert repr(dataclasses.replace(saved, task={})).startswith("<Snapshot of 1 sim")


def test_a_figure_shows_forces_along_themselves_and_tells_them(pushed):
    moment = Moment.of(pushed[0])
    moment = dataclasses.replace(
        moment,
        position=moment.device[[5, 9, 7]] + [0.0, 0.01, 0.0],
        force=np.array([[0.03, 0.01, 0.04], [-0.1, 0.0, 0.05], [0.0, 0.0, 1e-3]]),
        force_scale=0.2,
    )  # fmt: skip
    figure = scene_figure(moment, views=("front",), fluoroscopy=False, pixels=200)
    axes, bar = figure.axes
    goal, arrows = axes.patches[0], next(c for c in axes.collections if hasattr(c, "U"))
    assert goal.radius == pytest.approx(1e3 * moment.goal_radius)
    # From the front, x is to the right and z up; the largest is 22 mm long in space.
    way = 1e3 * (moment.position - moment.goal)[:, [0, 2]]
    np.testing.assert_allclose(arrows.XY - goal.center, way, atol=1e-6)
    wanted = moment.force[:, [0, 2]] * 22 / np.linalg.norm(moment.force[1])
    wanted[2] = 0.0, 5.0  # the shortest
    np.testing.assert_allclose(np.column_stack([arrows.U, arrows.V]), wanted)
    np.testing.assert_allclose(axes.texts[-1].xy, arrows.XY[1] + wanted[1])
    colours = force_colours(np.linalg.norm(moment.force, axis=1), 0.2) / 255
    np.testing.assert_allclose(arrows.get_facecolors()[:, :3], colours)
    assert bar.get_ylim() == (0.0, 200.0) and "mN" in bar.get_ylabel()
    sizes = np.linalg.norm(moment.force, axis=1)
    told = f"3 contacts, {force_text(sizes.sum())} in all, {force_text(sizes[1])} the"
    assert told in figure.get_suptitle()


def test_the_ring_in_the_fluoroscopy_has_the_size_of_the_goal(pushed):
    moment, axes = Moment.of(pushed[0]), Picture().add_subplot()
    own = on_screen(moment.x_ray.options)
    for zoom, centre, shown in (2.0, None, 2.0), (1.0, (0.0, 0.0, 0.0), 1.0):
        given = dataclasses.replace(own, magnification=zoom, centre=centre)
        assert on_screen(given).magnification == shown
    assert own.magnification == 1.3
    draw_fluoroscopy(axes, moment)
    (arm,) = own.carms(moment.rest.vertices)
    ends = moment.goal + moment.goal_radius * np.array([-arm.axes[0], arm.axes[0]])
    left, right = arm.project(ends)[0]
    ring = axes.patches[0]
    np.testing.assert_allclose(ring.center, (left + right) / 2)
    assert 2 * ring.radius == pytest.approx(right[0] - left[0])


@pytest.mark.parametrize(
    ("view", "plane", "up"),
    [("front", (0, 2), 1), ("left", (1, 2), 1), ("below", (0, 1), -1)],
)
def test_the_arrow_at_the_inlet_points_into_the_lumen(view, plane, up, monkeypatch):
    room = 5.0 if view == "below" else 9.0  # mm, of the goals
    monkeypatch.setattr(Anatomy, "goal_room", lambda *_: 1e-3 * room)
    anatomy, axes = phantoms.load("type1", access="descending"), Picture().add_subplot()
    draw_anatomy(axes, anatomy, view)
    arrow = next(text for text in axes.texts if text.arrow_patch is not None)
    way = np.subtract(arrow.xy, arrow.xyann)
    wanted = 30 * anatomy.inlet.direction[[*plane]] * (1, up)
    np.testing.assert_allclose(way, wanted, atol=1e-6)
    assert {ring.radius for ring in axes.patches if not ring.fill} == {min(room, 8.0)}
    rings = {tuple(np.round(ring.center, 6)) for ring in axes.patches if not ring.fill}
    goals = {
        tuple(np.round(line.get_xydata()[0], 6))
        for line in axes.lines
        if line.get_marker() == "."
    }
    assert goals <= rings and len(goals) == len(anatomy.goals)


def test_contacts_without_force_are_drawn(pushed, recwarn):
    moment = Moment.of(pushed[0])
    touching = dataclasses.replace(moment, force=np.zeros_like(moment.force))
    scene_figure(touching, views=("front",), fluoroscopy=False, pixels=200)
    assert not recwarn.list


def test_a_record_keeps_the_options_of_its_task():
    options = {"friction": 0.1, "max_steps": 2, "effects": [Effect()]}
    env = suite.load("cathsim", "simple1_bca", task_kwargs=options)
    episode = cathsim_dmc.record(env, "push", seed=1)
    assert episode.meta["task_kwargs"] == {"friction": 0.1, "max_steps": 2}
    assert (episode.steps, episode.termination) == (2, "truncated")


def test_policies_batches_and_episodes_are_shown_by_what_they_are(pushed):
    env, episode = pushed
    assert repr(episode) == (
        f"<Episode of {TASK!r}, seed {episode.seed}, {episode.steps} control steps, "
        f"{episode.termination}>"
    )
    policy = agents.load_policy("push")
    assert repr(policy) == "<Push 'push' for any task, reads nothing>"
    batch = BatchedEnv(TASK, 2)
    assert repr(batch) == f"BatchedEnv({TASK!r}, 2, device='cpu')"
    batch.close()
