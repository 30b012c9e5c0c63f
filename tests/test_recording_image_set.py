"""Labelled fluoroscopy: labels fit the images, splits are disjoint, seeds repeat."""

import dataclasses
import json
import shutil
import types
from pathlib import Path

import h5py
import numpy as np
import pytest
from PIL import Image

from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.imaging.carm import SOURCE_ISOCENTRE
from cathsim_dmc.imaging.fluoroscopy import Fluoroscope
from cathsim_dmc.imaging.thickness import surface_thickness
from cathsim_dmc.recording import coco, image_set, sequences
from cathsim_dmc.recording.image_set import ImageSetOptions
from cathsim_dmc.simulation import batch
from cathsim_dmc.tasks.step import Step

OPTIONS = ImageSetOptions(
    sequences=2, frames=2, views=2, stride=4, size=128, anatomies=(1, 0, 0)
)
RANGES = sequences.PRIMARY, sequences.SECONDARY


@pytest.fixture(scope="module")
def arch():
    return phantoms.load("simple1")


@pytest.fixture(scope="module")
def states(arch):
    return sequences.simulate(arch, "bca", "glide_in_berenstein", OPTIONS, [1])


@pytest.fixture(scope="module")
def path(arch, states, tmp_path_factory):
    path = tmp_path_factory.mktemp("set") / "one.h5"
    rows = sequences.write(path, arch, states, OPTIONS, [2], name="one")
    assert rows == 8
    return path


@pytest.fixture(scope="module")
def rows(path):
    with h5py.File(path) as file:
        return {name: file[name][:] for name in file}


def projected(matrix, points):
    """Pixels (n, K, 2) of points (n, K, 3) by matrices (n, 3, 4)."""
    ones = np.ones((*points.shape[:-1], 1))
    image = np.concatenate([points, ones], -1) @ np.swapaxes(matrix, 1, 2)
    return image[..., :2] / image[..., 2:]


def flag(mask, bit, pixels):
    """Whether masks (n, H, W) have a bit within a pixel of places (n, 2)."""
    found = []
    for one, (column, row) in zip(mask, np.rint(pixels).astype(int), strict=True):
        part = one[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        found.append(bool((part & bit).any()))
    return np.array(found)


def test_keypoints_are_where_the_camera_matrix_puts_them_and_on_their_masks(
    rows, states
):
    pixels = projected(rows["camera_matrix"], rows["keypoints_3d"])
    seen = rows["keypoints"][..., 2] > 0
    error = (pixels - rows["keypoints"][..., :2])[seen]
    assert np.abs(error).max() < 0.01
    for number, name in enumerate(sequences.KEYPOINTS):
        bit = sequences.VESSEL if "ostium" in name else sequences.DEVICE
        inside = seen[:, number]
        assert flag(rows["mask"][inside], bit, pixels[inside, number]).all(), name
    assert seen[:, :4].any(axis=0).all() and seen[:, 4:].any(), "all are tested"
    for number, shadow in enumerate(states.shadows):  # tip and marker of each
        marked = np.diff(rows["keypoints_3d"][:, 2 * number : 2 * number + 2], axis=1)
        length = np.linalg.norm(marked, axis=-1)
        assert 1e-3 < 0.9 * shadow.marker_length < length.min()
        assert length.max() < shadow.marker_length + 1e-6
    # The head of the chain is the tip of the device that leads.
    heads = rows["centreline"][:, -1]
    tips = np.linalg.norm(rows["keypoints_3d"][:, [0, 2]] - heads[:, None], axis=-1)
    assert tips.min(axis=1).max() < 1e-6


def test_every_row_says_its_time_its_motion_and_its_angles(rows):
    """Two motions, each of two frames a sixth of a second apart, before two C-arms."""
    np.testing.assert_allclose(rows["time"], 4 * [0.16, 0.32])
    assert rows["motion"].tolist() == 4 * [0] + 4 * [1]
    assert rows["sequence"].tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    x, y, z = rows["camera_matrix"][:, 2, :3].T  # from source to detector
    angles = np.rad2deg([np.arctan2(x, -y), np.arcsin(z)]).T
    np.testing.assert_allclose(rows["angles"], angles, atol=1e-4)
    for low, high, found in zip(*np.array(RANGES).T, angles.T, strict=True):
        assert np.ptp(found) > 1.0 and low <= found.min() <= found.max() <= high
    force, torque = np.abs(rows["push_force"]).max(axis=0)
    assert 1e-3 < force < 5.0 and torque < 0.05 * force  # N, N m


def test_the_isocentre_lies_between_the_middle_of_the_lumen_and_the_tip(arch, rows):
    """The tip in the second of two frames."""
    matrix = rows["camera_matrix"]
    source = -np.linalg.solve(matrix[..., :3], matrix[..., 3:])[..., 0]
    isocentre = source + SOURCE_ISOCENTRE * matrix[:, 2, :3]
    middle = np.mean(arch.lumen.box, axis=0)
    way = np.repeat(rows["keypoints_3d"][1::2, 0], 2, axis=0) - middle
    share = np.vecdot(isocentre - middle, way) / np.vecdot(way, way)
    assert share.min() > 0.0 and share.max() < 1.0
    np.testing.assert_allclose(isocentre, middle + share[:, None] * way, atol=1e-6)


def test_the_settings_of_the_c_arm_fill_their_ranges(arch):
    random = np.random.RandomState(0)
    cameras = [sequences.Camera(arch, 64, np.zeros(3), random) for _ in range(80)]
    iodine = np.array([one.iodine for one in cameras])
    lit = iodine[iodine > 0.0]
    assert 20 < len(lit) < 60
    for drawn, limits in (
        ([one.angles[0] for one in cameras], sequences.PRIMARY),
        ([one.angles[1] for one in cameras], sequences.SECONDARY),
        ([one.arm.magnification for one in cameras], sequences.ZOOM),
        ([one.gain for one in cameras], sequences.GAIN),
        (np.log([one.kerma for one in cameras]), np.log(sequences.KERMA)),
        (lit, sequences.IODINE),
    ):
        share = (np.array(drawn) - limits[0]) / np.ptp(limits)
        assert 0.0 <= share.min() < 0.2 and 0.8 < share.max() <= 1.0
        assert 0.35 < share.mean() < 0.65


@pytest.mark.parametrize("iodine", [0.0, 8.0])
def test_ostia_are_seen_in_contrast_alone(arch, iodine):
    camera = sequences.Camera(arch, 64, np.zeros(3), np.random.RandomState(0))
    camera.iodine = iodine
    places = np.zeros((2, len(sequences.KEYPOINTS), 3)) + camera.arm.isocentre
    places[1, 1], places[1, -1] = np.nan, 1.0
    state = camera.seen(places)[..., 2]
    ostium = sequences.SEEN if iodine else sequences.UNSEEN
    assert (state[:, 0] == sequences.SEEN).all() and (state[0, 4:] == ostium).all()
    assert state[1, 1] == state[1, -1] == sequences.ABSENT
    shown = camera.before(arch)
    assert (shown.contrast, shown.kerma, shown.gain) == (
        iodine, camera.kerma, camera.gain
    )  # fmt: skip


def test_the_mask_is_where_the_device_changes_the_image(arch, states):
    random = np.random.RandomState(0)
    camera = sequences.Camera(arch, 128, states.shadows[0].points[0, 0, -1], random)
    vessel = surface_thickness(camera.arm, arch.surface, 1)
    view = Fluoroscope(camera.arm, vessel, vessel > 0, contrast=0.0)
    for shadow in states.shadows:
        own = [dataclasses.replace(shadow, points=shadow.points[:1, 0])]
        away = [dataclasses.replace(own[0], points=own[0].points + 5.0)]
        changed = (view.render(own) != view.render(away))[0, ..., 0]
        mask = view.device_mask(own)[0]
        assert mask.sum() > 40 and changed[mask].all()
        # What is changed beside the mask are its neighbours, which are covered less.
        wide = np.pad(mask, 1)
        near = sum(
            np.roll(wide, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)
        )
        assert not (changed & (near[1:-1, 1:-1] == 0)).any()


def test_the_same_seed_gives_the_same_bytes(arch, states, path, tmp_path):
    sequences.write(tmp_path / "again.h5", arch, states, OPTIONS, [2], name="one")
    assert (tmp_path / "again.h5").read_bytes() == path.read_bytes()
    again = sequences.simulate(arch, "bca", "glide_in_berenstein", OPTIONS, [1])
    for name, values in states.columns.items():
        np.testing.assert_array_equal(values, again.columns[name])


def test_a_full_disk_is_told_before_hdf5_meets_it(
    arch, states, path, tmp_path, small_disk, monkeypatch
):
    def never(*_, **__):
        raise AssertionError("HDF5 ends the process on a full disk")

    monkeypatch.setattr(h5py, "File", never)
    size = path.stat().st_size - 1
    with small_disk(size), pytest.raises(OSError, match=r"too large.*/one\.h5"):
        sequences.write(tmp_path / "one.h5", arch, states, OPTIONS, [2], name="one")
    assert not list(tmp_path.iterdir())


def test_motions_start_along_the_route_and_are_a_mean_with_coloured_noise(
    arch, monkeypatch
):
    class Free:
        """Simulations in which nothing happens."""

        def __init__(self, task, count, **_):
            drawn = task.config.randomisation
            assert task.config.start_along_route == (0.0, 0.9)
            assert all([drawn.friction, drawn.stiffness, drawn.roll])
            self.rollout = types.SimpleNamespace(shadows=[], moving=None)
            self._none = np.zeros(count)

        def reset(self):
            pass

        def step(self, actions):
            acted.append(actions)
            force = {"push_force": self._none, "push_torque": self._none}
            line = {"centreline": self._none, "load_cell": self._none}
            return types.SimpleNamespace(
                physics_error=self._none > 0, wall_force=[self._none], vessel=None,
                readings=types.SimpleNamespace(**force, **line),
            )  # fmt: skip

    acted = []
    monkeypatch.setattr(batch, "BatchSimulation", Free)
    options = dataclasses.replace(OPTIONS, sequences=100, frames=60)
    sequences.simulate(arch, "bca", "steerable_5f", options, [1])
    action = np.array(acted)  # (240, 100, 22): tip motors, push, turn
    assert action.shape == (240, 100, 22) and np.abs(action).max() == 1.0
    mean = action.mean(axis=0)
    assert 0.85 < np.ptp(mean[:, :20]) / 2 < 1.0  # both ways
    push = np.quantile(mean[:, 20], (0.01, 0.5, 0.99))
    np.testing.assert_allclose(push, (-0.29, 0.35, 0.9), atol=0.07)
    # Where nothing is clipped, the noise is seen as it is.
    inner = np.abs(mean) < 0.1
    noise = (action - mean)[20:, inner]
    assert noise.std() == pytest.approx(0.3, rel=0.03)
    after = (noise[1:] * noise[:-1]).mean() / noise.var()
    assert after == pytest.approx(0.8, abs=0.02)
    # Motors of one axis have one mean.
    axis = np.arange(20) % 2
    together = np.corrcoef(mean.T)[:20, :20] > 0.9
    np.testing.assert_array_equal(together, axis[:, None] == axis)


def test_a_device_whose_motions_all_fail_is_one_that_does_not_fit(arch, monkeypatch):
    fails = property(lambda step: np.ones(len(step.errors), bool))
    monkeypatch.setattr(Step, "physics_error", fails)
    with pytest.raises(ValueError, match="fails in all .* glide"):
        sequences.simulate(arch, "bca", "glide", OPTIONS, [1])


def test_a_motion_that_fails_once_is_left_out(arch, monkeypatch):
    def fails(step):
        calls.append(step)
        return np.array([len(calls) == 1, False])

    calls = []
    monkeypatch.setattr(Step, "physics_error", property(fails))
    options = dataclasses.replace(OPTIONS, stride=3)
    states = sequences.simulate(arch, "bca", "glide_in_berenstein", options, [1])
    assert states.kept.tolist() == [1]
    assert len(calls) == 6  # three control steps from frame to frame
    clip = next(sequences.frames_of(arch, states, options, [2]))
    assert clip["motion"].tolist() == [1, 1]


def test_a_vessel_that_moves_takes_its_mask_and_its_ostia_along(arch):
    options = dataclasses.replace(OPTIONS, vessel="living", views=1, frames=3, stride=6)
    states = sequences.simulate(arch, "bca", "steerable_5f", options, [3])
    clip = next(sequences.frames_of(arch, states, options, [4]))
    ostia = clip["keypoints_3d"][:, 4:]
    there = np.isfinite(ostia[0, :, 0])
    moved = np.linalg.norm(np.diff(ostia[:, there], axis=0), axis=-1)
    assert there.sum() == 3 and moved.max() > 0.5e-3
    pixels = projected(clip["camera_matrix"], ostia[:, there])
    seen = clip["keypoints"][:, 4:][:, there, 2] > 0
    for number in range(3):
        inside = seen[:, number]
        at = pixels[inside, number]
        assert flag(clip["mask"][inside], sequences.VESSEL, at).all()
    assert len(np.unique(clip["heart_phase"])) == 3


def decoded(size, text):
    """Reads COCO's compressed run lengths, by its description."""
    runs, at = [], 0
    while at < len(text):
        value, shift, more = 0, 0, True
        while more:
            code = ord(text[at]) - 48
            value |= (code & 31) << shift
            more, shift, at = bool(code & 32), shift + 5, at + 1
        if code & 16:
            value -= 1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
    values = np.repeat(np.arange(len(runs)) % 2, runs)
    return values.reshape(size[::-1]).T.astype(bool)


def test_labels_are_those_of_coco(path, rows):
    labels = coco.labels(path, 3)
    by_image = {image["id"]: image for image in labels["images"]}
    assert len(by_image) == len(rows["image"])
    names_of = {each["id"]: each["keypoints"] for each in coco.CATEGORIES}
    # No two annotations have one id, nor those of another file of the split.
    every = [labels["annotations"], coco.labels(path, 4)["annotations"]]
    assert len({one["id"] for part in every for one in part}) == sum(map(len, every))
    for one in labels["annotations"]:
        image = by_image[one["image_id"]]
        bit = {1: sequences.DEVICE, 2: sequences.VESSEL}[one["category_id"]]
        mask = (rows["mask"][image["row"]] & bit) > 0
        text = one["segmentation"]["counts"]
        np.testing.assert_array_equal(decoded(mask.shape, text), mask)
        assert one["segmentation"]["size"] == list(mask.shape) and one["iscrowd"] == 0
        names = names_of[one["category_id"]]
        places = [sequences.KEYPOINTS.index(name) for name in names]
        there = rows["keypoints"][image["row"], places]
        assert one["keypoints"] == there.round(2).ravel().tolist()
        known = [state for state in one["keypoints"][2::3] if state > 0]
        assert one["num_keypoints"] == len(known)


def test_annotations_of_coco_have_ids_from_one_on(path):
    """COCO's own evaluation takes an annotation of id 0 for an unmatched one."""
    many = [each["id"] for n in (0, 1) for each in coco.labels(path, n)["annotations"]]
    assert min(many) == 1 and len(set(many)) == len(many)
    assert {type(one) for one in many} == {int}


def test_what_an_image_does_not_show_has_no_annotation(path, tmp_path):
    one, every = tmp_path / "one.h5", coco.labels(path, 0)["annotations"]
    shutil.copyfile(path, one)
    with h5py.File(one, "r+") as file:
        file["mask"][2] &= sequences.VESSEL  # no device
    left = coco.labels(one, 0)["annotations"]
    device = {"image_id": 2, "category_id": 1}
    assert left == [a for a in every if not device.items() <= a.items()]
    assert len(left) == len(every) - 1 and all(min(a["bbox"][2:]) for a in left)


def test_each_image_of_coco_has_its_camera_and_its_sequence(path, rows):
    images = coco.labels(path, 0)["images"]
    found = [image["camera_matrix"] for image in images]
    np.testing.assert_allclose(found, rows["camera_matrix"], atol=1e-6)
    assert [image["sequence"] for image in images] == rows["sequence"].tolist()
    assert [image["row"] for image in images] == list(range(len(images)))


def test_no_anatomy_is_in_two_splits(tmp_path):
    options = dataclasses.replace(OPTIONS, anatomies=(50, 50, 50), seed=7)
    shards = image_set._shards(tmp_path, options)
    sets = [(image_set.SPLITS[s.split], set(s.candidates)) for s in shards]
    for number, (kind, chosen) in enumerate(sets):
        for other, those in sets[:number]:
            assert kind != other or not chosen & those
    assert len(shards) == 150


def test_each_anatomy_has_draws_of_its_own_which_its_file_tells(tmp_path, monkeypatch):
    simulated, written = [], []

    def simulate(anatomy, goal, kit, options, seed):
        simulated.append((anatomy, goal, kit, tuple(seed)))

    def write(path, anatomy, states, options, seed, **about):
        written.append((anatomy, about, tuple(seed)))
        return 8

    monkeypatch.setattr(sequences, "simulate", simulate)
    monkeypatch.setattr(sequences, "write", write)
    options = dataclasses.replace(OPTIONS, anatomies=(4, 2, 0))
    for shard in image_set._shards(tmp_path, options):
        image_set._simulate_shard(shard)
    for (anatomy, goal, kit, _), (same, about, _) in zip(
        simulated, written, strict=True
    ):
        assert anatomy is same and about["name"] == anatomy.name
        assert (about["goal"], about["devices"]) == (goal, kit)
        assert goal in anatomy.goals and goal != "descending"
        first = anatomy.tree.root.centreline.points[0]
        entered = np.allclose(anatomy.inlet.position, first, atol=1e-9)
        assert about["access"] == ("ascending" if entered else "descending")
    seeds = [row[-1] for row in (*simulated, *written)]
    assert len(set(seeds)) == len(seeds) == 12
    assert {about["access"] for _, about, _ in written} == {"ascending", "descending"}


def test_a_set_is_resumed_and_refused_where_it_must_be(tmp_path, monkeypatch, path):
    def simulate_shard(shard):
        shard.path.write_bytes(path.read_bytes())
        return 8, shard.path.name

    monkeypatch.setattr(image_set, "_simulate_shard", simulate_shard)
    out = tmp_path / "set"
    options = dataclasses.replace(OPTIONS, anatomies=(2, 1, 1))
    with monkeypatch.context() as interrupted:
        interrupted.setattr(image_set, "SPLITS", ("train", 0))
        with pytest.raises(TypeError):
            image_set.write(out, options, processes=1)
    # Processor time is counted in steps of 10 ms.
    monkeypatch.setattr(image_set.os, "times", lambda: (0.0,) * 5)
    done = image_set.write(out, options, processes=1)
    assert done["frames"] == {"train": 16, "val": 8, "test": 8} and done["new"] == 32
    assert "| train | 2 | 16 |" in (out / "README.md").read_text()
    (out / "train" / "train_001.h5").unlink()
    assert image_set.write(out, options, processes=1)["new"] == 8
    test = out / "test" / "test_000.h5"
    test.write_bytes(test.read_bytes()[:-1])
    with pytest.raises(ValueError, match="test_000.h5 is damaged; remove it and give"):
        image_set.write(out, options, processes=1)
    found = json.loads((out / "annotations/train.json").read_text())["images"]
    assert len({image["id"] for image in found}) == 16
    with pytest.raises(ValueError, match=r"other options.*\(anatomies \[2, 1, 1\]\)"):
        image_set.write(out, OPTIONS, processes=1)
    with pytest.raises(ValueError, match="not empty"):
        image_set.write(path.parent, OPTIONS, processes=1)
    with pytest.raises(FileNotFoundError, match="create it"):
        image_set.write(tmp_path / "a" / "b", OPTIONS, processes=1)


def test_given_anatomies_are_dealt_out_in_their_order(tmp_path):
    own = tmp_path / "own"
    phantoms.load("simple2").save(own)
    names = ("type1", str(own), "bovine", "simple1")
    options = dataclasses.replace(OPTIONS, anatomies=(2, 1, 1), anatomy=names)
    shards = image_set._shards(tmp_path, options)
    assert [(one.split, one.number, one.anatomy) for one in shards] == [
        ("train", 0, "type1"), ("train", 1, str(own)), ("val", 0, "bovine"),
        ("test", 0, "simple1"),
    ]  # fmt: skip
    image_set._begin(tmp_path / "set", options)
    about = json.loads((tmp_path / "set" / "dataset.json").read_text())
    assert about["options"]["anatomy"] == list(names) and len(about["lumens"]) == 4
    card = image_set._card(options, {"train": 2, "val": 1, "test": 1})
    assert "train: type1, own; val: bovine; test: simple1." in card
    assert "random aortic arches" not in card
    image_set._begin(tmp_path / "set", options)
    shutil.rmtree(own)
    phantoms.load("type3").save(own)  # another anatomy in the same folder
    with pytest.raises(ValueError, match="was begun with other options"):
        image_set._begin(tmp_path / "set", options)


def test_a_set_of_random_arches_is_described_as_before(tmp_path):
    image_set._begin(tmp_path / "set", OPTIONS)
    about = json.loads((tmp_path / "set" / "dataset.json").read_text())
    assert "lumens" not in about and "anatomy" not in about["options"]
    card = image_set._card(OPTIONS, {"train": 1, "val": 0, "test": 0})
    assert "in two splits. Train and val hold random aortic arches of all" in card


@pytest.mark.parametrize(
    ("anatomies", "names", "message"),
    [
        ((8, 2, 2), ("type1", "type2", "bovine"), "add up to 3, such as .* 1 1 1"),
        ((1, 0, 0), ("type1", "type2"), "add up to 2, such as --anatomies 2 0 0"),
        ((1, 0, 1), "type1", "anatomy is 'type1'"),
        ((1, 0, 1), ("type1", ""), "anatomy is ''"),
    ],
)
def test_a_split_that_cannot_be_made_is_refused(anatomies, names, message):
    with pytest.raises(ValueError, match=message):
        ImageSetOptions(anatomies=anatomies, anatomy=names)


def test_one_lumen_in_two_splits_is_refused(tmp_path):
    phantoms.load("simple1", access="descending").save(tmp_path / "copy")
    for names, message in (
        (("simple1", "simple1"), "simple1 and simple1 are one lumen"),
        (("simple1", str(tmp_path / "copy")), "simple1 and .*copy are one lumen"),
        (("simple1", "nowhere"), "no anatomy at 'nowhere'"),
    ):
        options = ImageSetOptions(anatomies=(1, 0, 1), anatomy=names)
        with pytest.raises(ValueError, match=message):
            image_set.write(tmp_path / "set", options, processes=1)
        assert not (tmp_path / "set").exists()


@pytest.mark.slow
def test_given_anatomies_have_the_same_labels(tmp_path, cathsim):
    phantoms.load("simple2").save(tmp_path / "own")
    code, out, err = cathsim(
        *("dataset", tmp_path / "set", "--anatomies", 1, 0, 1, "--processes", 1),
        *("--anatomy", "simple1", "--anatomy", tmp_path / "own", "--sequences", 1),
        *("--frames", 2, "--views", 1, "--size", 64),
    )
    assert code == 0, err
    assert "2 train, 0 val, 2 test images" in out
    found = {}
    for split in ("train", "test"):
        with h5py.File(tmp_path / "set" / split / f"{split}_000.h5") as file:
            attributes = dict(file.attrs)
            found[split] = attributes["name"], attributes["access"]
            assert set(file) == set(
                "image mask keypoints keypoints_3d camera_matrix centreline wall_force "
                "push_force load_cell angles iodine time sequence motion".split()
            )
            ostia = file["keypoints_3d"][0, len(sequences.DEVICE_KEYPOINTS) :, 0]
            assert np.isfinite(ostia).any()
        labels = json.loads((tmp_path / f"set/annotations/{split}.json").read_text())
        assert len(labels["images"]) == 2 and len(labels["annotations"]) == 4
    assert found["train"][0] == "simple1" and found["test"] == ("simple2", "own")


@pytest.mark.parametrize(
    ("option", "value"),
    [("size", 4), ("frames", 0), ("vessel", "alive"), ("anatomies", (0, 0, 0))],
)
def test_a_wrong_option_is_named(option, value):
    with pytest.raises(ValueError, match=option):
        dataclasses.replace(OPTIONS, **{option: value})


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 1.0])
def test_the_description_of_a_mask_is_that_of_its_pixels(share):
    mask = (np.random.RandomState(0).uniform(size=(31, 17)) < share).astype(np.uint8)
    mask[:, 3:5] |= 2  # of another object
    found = coco.described(np.ascontiguousarray(mask.T))
    rows, columns = np.nonzero(mask & 1)
    box = [0] * 4
    if len(rows):
        box = [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]
    assert found["area"] == len(rows) and found["bbox"] == [int(one) for one in box]


def test_two_processes_may_write_the_pictures_of_a_data_set(tmp_path, monkeypatch):
    path, rows = tmp_path / "train" / "train_000.h5", 3
    path.parent.mkdir()
    image = np.random.RandomState(0).randint(256, size=(rows, 12, 16)).astype("u1")
    shapes = {"sequence": (rows,), "camera_matrix": (rows, 3, 4)}
    shapes |= {"keypoints": (rows, len(sequences.KEYPOINTS), 3), "mask": image.shape}
    with h5py.File(path, "w") as file:
        file["image"] = image
        for name, shape in shapes.items():
            file[name] = np.ones(shape, "u1" if name == "mask" else "f4")
    save, others = Image.Image.save, []

    def saved(self, target, **options):
        if not others:  # the other process begins later, and is the first to end
            others.append(True)
            others.append(coco.labels(path, 0, pictures=True))
        save(self, target, **options)

    monkeypatch.setattr(Image.Image, "save", saved)
    assert coco.labels(path, 0, pictures=True) == others[1]
    files = sorted((tmp_path / "train" / "train_000").iterdir())
    assert [file.name for file in files] == [f"{row:06d}.png" for row in range(rows)]
    for label, file, wanted in zip(others[1]["images"], files, image, strict=True):
        assert np.array_equal(np.asarray(Image.open(file)), wanted)
        assert (label["height"], label["width"]) == wanted.shape
        assert (tmp_path / label["file_name"], tmp_path / label["hdf5"]) == (file, path)
    sizes = [one["segmentation"]["size"] for one in others[1]["annotations"]]
    assert sizes == [[12, 16]] * rows
    assert len(list((tmp_path / "train").iterdir())) == 2


def test_the_detector_says_which_folder_it_takes(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "examples")
    import train_tip_detector

    with pytest.raises(SystemExit, match="train holds no .h5 file; give a folder of"):
        train_tip_detector.load(tmp_path, "train")
