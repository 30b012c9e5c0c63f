import dataclasses
import io
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image
from recording_samples import make_episode, make_tube
from scipy.spatial.transform import Rotation

from cathsim_dmc import suite
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.pictures.moment import Moment
from cathsim_dmc.pictures.recorded import xray_film
from cathsim_dmc.recording import rerun_text
from cathsim_dmc.recording.episode import TERMINATIONS, Episode
from cathsim_dmc.recording.geometry import force_colours, force_text
from cathsim_dmc.recording.recorder import EpisodeRecorder
from cathsim_dmc.recording.records import VesselRecord
from cathsim_dmc.recording.rerun_log import write_rrd
from cathsim_dmc.recording.rerun_scene import BodyGeom, arrow_scale, link_colours

STEPS = 6
GOAL = (0.01, 0.0, 0.03)


def make_geoms():
    common = {"quaternion": [1, 0, 0, 0], "rgba": [1, 0.5, 0, 1]}
    turned = {"quaternion": [0.5**0.5, 0.5**0.5, 0, 0], "rgba": [0, 0, 1, 0.5]}
    return [
        BodyGeom(1, "robot/base", "box", [0.01, 0.02, 0.03], [0, 0, 0], **common),
        BodyGeom(2, "robot/wheel", "cylinder", [0.01, 0.02], [0, 0, 0], **common),
        BodyGeom(2, "robot/wheel", "capsule", [0.01, 0.02], [0.1, 0, 0], **turned),
    ]


def make_recorded():
    episode = make_episode(STEPS, counts=np.array([2, 0, 1, 3, 0, 0]))
    away = np.linalg.norm(episode.head - GOAL, axis=1)
    meta = {"goal_position": GOAL, "goal_radius": 0.008, "distance": away}
    meta["versions"] = {"a|b": "1.0"}
    place, turn = episode.body_pos.copy(), episode.body_quat.copy()
    place[:, 1], turn[:, 1] = place[0, 1], turn[0, 1]
    values = {"meta": episode.meta | meta, "body_pos": place, "body_quat": turn}
    values["time"] = np.nextafter(episode.time, 0)  # as the simulator's clock
    return dataclasses.replace(episode, **values)


class Recording:
    """All rows of a recording: static and temporal values per entity."""

    def __init__(self, path):
        from rerun.chunk import RrdReader

        reader = RrdReader(path)
        self.recordings, self.blueprints = reader.recordings(), reader.blueprints()
        self.static, self.temporal = {}, {}
        for chunk in reader.stream():
            batch = chunk.to_record_batch()
            target = self.static if chunk.is_static else self.temporal
            rows = target.setdefault(chunk.entity_path, {})
            for name in batch.schema.names:
                rows.setdefault(name, []).extend(batch.column(name))
        self.views = {}
        for store in self.blueprints:
            for chunk in reader.stream(store=store):
                batch = chunk.to_record_batch()
                if "ViewBlueprint:space_origin" in batch.schema.names:
                    kind = batch.column("ViewBlueprint:class_identifier")[0].as_py()[0]
                    origin = batch.column("ViewBlueprint:space_origin")[0].as_py()[0]
                    self.views["/" + origin.lstrip("/")] = kind

    def values(self, entity, name):
        return [row.as_py() for row in self.temporal[entity][name]]

    def nanoseconds(self, entity):
        return [row.value for row in self.temporal[entity]["sim_time"]]

    def fixed(self, entity, name):
        return self.static[entity][name][-1].as_py()


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("rrd") / "episode.rrd"
    episode = make_recorded()
    frames = np.arange((STEPS + 1) * 20 * 16, dtype=np.uint32) % 251
    frames = frames.astype(np.uint8).reshape(STEPS + 1, 20, 16, 1)
    shapes = {"robot_geoms": make_geoms(), "fluoroscopy": frames}
    assert write_rrd(episode, make_tube(), path, **shapes) == path
    return episode, frames, path, Recording(path)


def test_the_file_holds_one_recording_and_its_layout(written):
    _, _, path, recording = written
    assert len(recording.recordings) == len(recording.blueprints) == 1
    assert recording.recordings[0].application_id == "cathsim"
    assert recording.views["/world"] == "3D"
    assert recording.views["/fluoroscopy"] == "2D"
    assert recording.views["/events"] == "TextLog"
    assert recording.views["/info"] == "TextDocument"
    plots = {o for o, kind in recording.views.items() if kind == "TimeSeries"}
    named = ("reward", "distance_mm", "force", "insertion_mm", "action")
    assert plots == {f"/series/{name}" for name in named}
    assert [p.name for p in path.parent.iterdir()] == ["episode.rrd"]


def test_rerun_itself_accepts_the_file(written):
    command = [sys.executable, "-m", "rerun_cli", "rrd", "verify", str(written[2])]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "verified without error" in done.stdout + done.stderr


def test_every_entity_lives_on_both_timelines_at_the_right_rows(written):
    episode, _, _, recording = written
    states, steps = list(range(STEPS + 1)), list(range(1, STEPS + 1))
    of_states = "world/catheter world/catheter/head world/robot/wheel fluoroscopy "
    of_states += "series/distance_mm series/insertion_mm"
    of_steps = "world/catheter/trail world/contacts world/heat series/reward "
    of_steps += "series/force/wall_sum series/force/wall_max series/force/push "
    of_steps += "world/contacts/largest"
    expected = {"/series/action": states[:-1]}
    expected |= {f"/{entity}": states for entity in of_states.split()}
    expected |= {f"/{entity}": steps for entity in of_steps.split()}
    assert set(recording.temporal) == {*expected, "/events"}
    for entity, rows in expected.items():
        assert recording.values(entity, "step") == rows, entity
        wanted = [40_000_000 * row for row in rows]
        assert recording.nanoseconds(entity) == wanted, entity


def test_capsules_span_the_joints_of_the_catheter(written):
    episode, _, _, recording = written
    entity = "/world/catheter"
    lower = np.array(recording.values(entity, "Capsules3D:translations"))
    lengths = np.array(recording.values(entity, "Capsules3D:lengths"))
    turns = np.array(recording.values(entity, "Capsules3D:quaternions"))
    tips = Rotation.from_quat(turns.reshape(-1, 4)).apply([0, 0, 1])
    upper = lower + lengths[..., None] * tips.reshape(lower.shape)
    np.testing.assert_allclose(lower, episode.catheter[:, :-1], atol=1e-6)
    np.testing.assert_allclose(upper, episode.catheter[:, 1:], atol=1e-5)
    head = np.array(recording.values("/world/catheter/head", "Points3D:positions"))
    np.testing.assert_allclose(head[:, 0], episode.head, atol=1e-6)
    strips = recording.values("/world/catheter/trail", "LineStrips3D:strips")
    way = np.stack([episode.head[:-1], episode.head[1:]], axis=1)
    np.testing.assert_allclose(np.array(strips)[:, 0], way, atol=1e-6)


def test_arrows_show_the_contacts_of_their_step_only(written):
    episode, _, _, recording = written
    vectors = recording.values("/world/contacts", "Arrows3D:vectors")
    origins = recording.values("/world/contacts", "Arrows3D:origins")
    heat = recording.values("/world/heat", "Points3D:positions")
    assert [len(v or []) for v in vectors] == [2, 0, 1, 3, 0, 0]
    # An empty row clears the arrows of the step before; a null would keep them.
    assert all(v is not None for v in vectors)
    expected = arrow_scale(episode) * episode.contact_force
    places = episode.contact_position
    for rows, wanted in ((vectors, expected), (origins, places), (heat, places)):
        found = np.concatenate([row for row in rows if row])
        np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_series_hold_the_values_of_the_episode(written):
    episode, _, _, recording = written

    def scalars(entity):
        return np.array(recording.values(f"/series/{entity}", "Scalars:scalars"))

    np.testing.assert_array_equal(scalars("reward")[:, 0], episode.reward)
    np.testing.assert_array_equal(scalars("action"), episode.action)
    np.testing.assert_array_equal(scalars("force/push")[:, 0], 1e3 * episode.push_force)
    away = 1e3 * np.array(episode.meta["distance"])
    np.testing.assert_allclose(scalars("distance_mm")[:, 0], away)


@pytest.fixture(scope="module")
def coaxial(tmp_path_factory):
    """An episode of a wire and the catheter that takes the lead, in flowing blood."""
    path, rng = tmp_path_factory.mktemp("rrd") / "pair.rrd", np.random.default_rng(1)
    line = np.zeros((STEPS + 1, 5, 3))
    line[..., 2], turns = 0.01 * np.arange(5), ("rotation", "tip_rotation")
    devices = [
        {
            "name": name,
            "radius": radius,
            "insertion": np.linspace(*ends, STEPS + 1),
            **{kind: rng.normal(size=STEPS + 1) for kind in turns},
        }
        for name, radius, ends in (
            ("wire", 0.4e-3, (0.12, 0.12)), ("catheter", 0.8e-3, (0.105, 0.125))
        )
    ]  # fmt: skip
    names = "heart_phase", "breath_phase", "blood_speed", "indentation", "wall_work"
    vessel = {name: rng.uniform(size=STEPS + 1) for name in names}
    vessel["blood_velocity"], vessel["goal"] = rng.normal(size=(2, STEPS + 1, 3))
    vessel |= {"lattice": [], "parameters": []}
    means = {
        f"wall_force_mean_{kind}": rng.uniform(size=STEPS) for kind in ("sum", "max")
    }
    episode = make_recorded()
    meta = {**episode.meta, "devices": devices, "vessel": vessel, **means}
    meta["action_names"] = ["wire/push", "catheter/push"]
    episode = dataclasses.replace(episode, catheter=line, meta=meta)
    return episode, Recording(write_rrd(episode, make_tube(), path))


def test_every_plot_is_in_its_unit(coaxial):
    episode, recording = coaxial
    meta, wanted = episode.meta, {}
    for kind in ("sum", "max"):
        at_the_end = getattr(episode, f"wall_force_{kind}")
        wanted[f"force/wall_{kind}"] = 1e3 * at_the_end
        mean = np.array(meta[f"wall_force_mean_{kind}"])
        wanted[f"force/wall_mean_{kind}"] = 1e3 * mean
    wanted["insertion_mm"] = 1e3 * episode.insertion
    for one in meta["devices"]:
        name = one["name"]
        wanted[f"insertion_mm/{name}"] = 1e3 * np.array(one["insertion"])
        wanted[f"rotation_deg/{name}"] = np.array(one["rotation"]) * 180 / np.pi
        wanted[f"rotation_deg/{name}_end"] = np.array(one["tip_rotation"]) * 180 / np.pi
    units = {"heart_phase": 1, "breath_phase": 1, "blood_speed": 1}  # m/s
    units |= {"indentation": 1e3, "wall_work": 1e6}  # mm, µJ
    for name, factor in units.items():
        wanted[f"vessel/{name}"] = factor * np.array(meta["vessel"][name])
    for entity, values in wanted.items():
        found = np.array(recording.values(f"/series/{entity}", "Scalars:scalars"))
        np.testing.assert_allclose(found[:, 0], values, rtol=1e-6, err_msg=entity)
    names = recording.fixed("/series/action", "SeriesLines:names")
    assert names == ["wire/push", "catheter/push"]  # of both devices


def test_blood_goal_and_devices_are_drawn_in_metres(coaxial):
    episode, recording = coaxial
    vessel = episode.meta["vessel"]
    blood = recording.values("/world/blood", "Arrows3D:vectors")
    # An arrow of 20 mm is a metre per second.
    velocity = np.array(vessel["blood_velocity"])
    np.testing.assert_allclose(np.array(blood)[:, 0], 0.02 * velocity, rtol=1e-5)
    origins = recording.values("/world/blood", "Arrows3D:origins")
    np.testing.assert_allclose(np.array(origins)[:, 0], episode.head, atol=1e-6)
    way = recording.values("/world/goal", "Transform3D:translation")
    centre, size = (
        np.array(recording.fixed("/world/goal", f"Ellipsoids3D:{name}")[0])
        for name in ("centers", "half_sizes")
    )
    np.testing.assert_allclose(np.array(way)[:, 0] + centre, vessel["goal"], atol=1e-6)
    np.testing.assert_allclose(size, episode.meta["goal_radius"])
    radii = np.array(recording.values("/world/catheter", "Capsules3D:radii"))
    # 15 mm of wire stand out at first, and none when the catheter has passed it.
    np.testing.assert_allclose(radii[0], [0.8e-3, 0.8e-3, 0.8e-3, 0.4e-3], rtol=1e-5)
    np.testing.assert_allclose(radii[-1], 0.8e-3, rtol=1e-5)
    # Nothing touches the wall at first: the wire is teal, the catheter as it is alone.
    colours = recording.values("/world/catheter", "Capsules3D:colors")[0]
    assert [colour >> 8 for colour in colours] == 3 * [0xD7E4FF] + [0x5ADCBE]
    behind = np.linspace(-0.015, 0.005, STEPS + 1)  # of the wire
    for name, gap in (("wire", behind), ("catheter", -behind)):
        places = recording.values(f"/world/catheter/{name}", "Points3D:positions")
        height = np.array(places)[:, 0, 2]
        np.testing.assert_allclose(height, 0.04 - gap.clip(0.0), atol=1e-6)


def test_events_belong_to_the_states_that_they_lead_to():
    far = np.array([0.1, 0.15, 0.07, 0.045, 0.03, 0.02, 0.05])
    meta = {**make_episode().meta, "distance": far.tolist()}
    counts = np.array([0, 0, 1, 0, 0, 0])
    found = rerun_text.events(make_episode(STEPS, counts=counts, meta=meta))
    rows = {text.split(",")[0]: row for row, text, _ in found}
    assert rows["contact with the wall"] == rows["largest force"] == 3
    assert rows["half of the distance to the goal"] == 3
    assert rows["nearest to the goal"] == 5 and rows["end: success"] == STEPS
    counts = np.zeros(24, int)
    counts[[0, 10, 21]] = 1  # after 9 steps without contact, and after 10
    found = rerun_text.events(make_episode(24, counts=counts))
    assert [row for row, text, _ in found if "contact with" in text] == [1, 22]


def test_text_says_what_happens_when(written):
    episode, _, _, recording = written
    texts = [text[0] for text in recording.values("/events", "TextLog:text")]
    rows = dict(zip(texts, recording.values("/events", "step"), strict=True))
    assert rows["start of type1_bca"] == 0 and rows["end: success"] == STEPS
    row = int(episode.wall_force_max.argmax())
    assert rows[f"largest force, {force_text(episode.wall_force_max[row])}"] == row + 1
    nearest = 1e3 * np.min(episode.meta["distance"])
    row = int(np.argmin(episode.meta["distance"]))
    assert rows[f"nearest to the goal, {nearest:.1f} mm"] == row
    assert len([text for text in texts if text.startswith("contact")]) == 1
    page = recording.fixed("/info", "TextDocument:text")[0].splitlines()
    assert "| outcome | success |" in page and page[0] == "# type1_bca"
    assert r'| versions | {"a\|b": "1.0"} |' in page
    away = 1e3 * np.linalg.norm(episode.head - GOAL, axis=1)[[0, -1]]
    path = 1e3 * np.linalg.norm(np.diff(episode.head, axis=0), axis=1).sum()
    for name, text in (
        ("distance to the goal", "{:.1f} to {:.1f} mm".format(*away)),
        ("last insertion", "100.0 mm"),
        ("path of the head", f"{path:.1f} mm"),
        ("simulated time", "0.24 s"),
    ):
        assert f"| {name} | {text} |" in page
    assert not any(line.startswith("| distance |") for line in page)
    later = dataclasses.replace(episode, time=episode.time + 2.0)
    assert "| simulated time | 0.24 s |" in rerun_text.markdown(later)


@pytest.mark.parametrize("end", TERMINATIONS)
def test_every_end_is_an_event(end):
    meta = {"success": end == "success", "termination": end}
    *_, (row, text, _) = rerun_text.events(make_episode(meta=meta))
    assert (row, text) == (6, f"end: {end.replace('_', ' ')}")


def test_the_largest_force_of_a_step_is_written_at_the_end_of_its_arrow(written):
    episode, _, _, recording = written
    entity = "/world/contacts/largest"
    places = recording.values(entity, "Points3D:positions")
    labels = recording.values(entity, "Points3D:labels")
    for step in range(STEPS):
        rows = np.flatnonzero(episode.contact_step == step)
        force = np.linalg.norm(episode.contact_force[rows], axis=1)
        assert labels[step] == [force_text(f) for f in force if f == force.max()]
        if len(rows):
            top = rows[force.argmax()]
            end = episode.contact_position[top]
            end = end + arrow_scale(episode) * episode.contact_force[top]
            np.testing.assert_allclose(places[step], [end], atol=1e-6)


def test_links_take_the_colour_of_what_they_press(written):
    episode, _, _, recording = written
    colours = np.array(recording.values("/world/catheter", "Capsules3D:colors"))
    plain = colours[0, 0]
    assert (colours[0] == plain).all()  # nothing is known of the start
    touched = (colours != plain).any(axis=1)[1:]
    assert touched.tolist() == [bool(n) for n in episode.contact_counts]


def test_the_link_next_to_a_contact_takes_its_colour():
    line = np.zeros((3, 5, 3))
    line[..., 2] = 0.01 * np.arange(5)
    episode = make_episode(2, counts=np.array([2, 0]), catheter=line)
    places = np.array([[1e-3, 0, 0.016], [1e-3, 0, 0.034]])
    force = np.array([[0.04, 0, 0], [0, 0.01, 0]])
    episode = dataclasses.replace(episode, contact_position=places, contact_force=force)
    plain = np.full((3, 4, 3), 7, np.uint8)
    found = link_colours(episode, plain)
    # The scale ends at 50 mN, the least of its tops that holds both.
    hot = force_colours(np.array([0.04, 0.01]), 0.05)
    np.testing.assert_array_equal(found[1], [plain[0, 0], hot[0], plain[0, 0], hot[1]])
    np.testing.assert_array_equal(found[[0, 2]], plain[:2])


def test_the_scene_is_in_the_patient_frame_with_a_translucent_vessel(written):
    _, _, _, recording = written
    tube = make_tube()
    drawn = recording.fixed("/world/vessel", "Mesh3D:vertex_positions")
    np.testing.assert_allclose(drawn, tube.vertices, atol=1e-6)
    drawn = recording.fixed("/world/vessel", "Mesh3D:triangle_indices")
    np.testing.assert_array_equal(drawn, tube.faces)
    rgba = recording.fixed("/world/vessel", "Mesh3D:albedo_factor")[0]
    assert 0 < rgba & 0xFF < 128
    # Left, back, up in Rerun's numbering of directions.
    assert list(recording.fixed("/world", "ViewCoordinates:xyz")[0]) == [4, 6, 1]
    goal = recording.fixed("/world/goal", "Ellipsoids3D:centers")[0]
    np.testing.assert_allclose(goal, GOAL, atol=1e-6)


def test_an_episode_without_extras_opens_without_them(tmp_path):
    episode = make_episode(STEPS, counts=np.zeros(STEPS, int))
    recording = Recording(write_rrd(episode, make_tube(), tmp_path / "e.rrd"))
    assert "/world/goal" not in recording.static
    assert "/series/distance_mm" not in recording.temporal
    assert "/fluoroscopy" not in recording.views
    assert "/series/distance_mm" not in recording.views
    arrows = recording.values("/world/contacts", "Arrows3D:vectors")
    assert arrows == [[]] * STEPS


def test_two_planes_are_two_images(tmp_path):
    frames = np.full((STEPS + 1, 16, 16, 2), (60, 200), np.uint8)
    path = tmp_path / "e.rrd"
    write_rrd(make_recorded(), make_tube(), path, fluoroscopy=frames)
    recording = Recording(path)
    for plane, entity in enumerate(("/fluoroscopy", "/fluoroscopy_lateral")):
        assert recording.views[entity] == "2D"
        blob = recording.values(entity, "EncodedImage:blob")[3][0]
        image = np.asarray(Image.open(io.BytesIO(bytes(blob))))
        np.testing.assert_allclose(image, frames[3, ..., plane], atol=2)


def test_a_living_vessel_is_kept_and_its_wall_moves_in_the_file(tmp_path):
    env = suite.load("cathsim", "simple1_bca", {"vessel": "living", "random": 0})
    recorder = EpisodeRecorder(env)
    recorded = recorder.record_episode(lambda _: np.zeros(21), seed=0, max_steps=8)
    episode = Episode.load(recorded.save(tmp_path / "episode.npz"))
    record = VesselRecord.of(episode)
    phase, goal = 0.04 * np.arange(9), record.series["goal"]
    np.testing.assert_allclose(record.series["heart_phase"], phase, atol=1e-9)
    assert record.series["blood_speed"].max() > 0.1
    assert episode.meta["distance"][-1] == env.task.info()["distance"]
    surface = env.task.scene.anatomy.surface
    path = write_rrd(episode, surface, tmp_path / "episode.rrd")
    places = Recording(path).values("/world/vessel", "Mesh3D:vertex_positions")
    moved = np.linalg.norm(np.subtract(places[2], places[0]), axis=-1)
    np.testing.assert_allclose(places[0], surface.vertices, atol=1e-6)
    assert len(places) == 3 and moved.max() > 1e-3
    assert np.linalg.norm(goal[8] - goal[0]) > 1e-4
    drawn, present = Moment.of_episode(episode, surface, 8), Moment.of(env)
    # The record keeps the motion to six digits.
    apart = np.abs(drawn.surface.vertices - present.surface.vertices)
    assert apart.max() < 1e-7
    np.testing.assert_allclose(drawn.surface.vertices, places[2], atol=1e-6)
    np.testing.assert_array_equal(drawn.goal, goal[8])
    film = xray_film(episode, surface, FluoroscopyOptions(size=64))
    assert (film[0] != film[4]).mean() > 0.01


def test_a_body_has_its_pose_before_its_shape(tmp_path):
    """A viewer that is still reading shows what it has, wherever it is."""
    from rerun.chunk import RrdReader

    geoms = [
        geom._replace(body=1 + number % 2, body_name=f"robot/part_{number % 2}")
        for number, geom in enumerate(40 * make_geoms())
    ]
    path = write_rrd(
        make_recorded(), make_tube(), tmp_path / "order.rrd", robot_geoms=geoms
    )
    order = [str(chunk.entity_path) for chunk in RrdReader(path).stream()]
    shapes = [name for name in order if name.count("/") == 4 and "/robot/" in name]
    assert len(shapes) == 6
    for shape in shapes:
        assert order.index(shape.rpartition("/")[0]) < order.index(shape)
