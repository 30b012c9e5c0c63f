"""Sequences of labelled fluoroscopy in one anatomy.

One HDF5 file holds the frames of an anatomy, sequence after sequence; a row of every
array belongs to one frame.
"""

import dataclasses
import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc import bounds, files
from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.imaging.carm import CArm
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.imaging.fluoroscopy import Fluoroscope
from cathsim_dmc.imaging.options import DETECTOR_SIZE
from cathsim_dmc.imaging.thickness import surface_thickness
from cathsim_dmc.physics.stepper import CONTROL_TIMESTEP
from cathsim_dmc.physics.vessel import PRESETS
from cathsim_dmc.recording.geometry import along
from cathsim_dmc.tasks.anatomies import BRANCHES

# Bits of a mask.
DEVICE, VESSEL = 1, 2
# Distal end and proximal end of the radiopaque marker of the innermost or only device,
# then of the one around it. Then the ostia, where a branch leaves its parent.
DEVICE_KEYPOINTS = ("tip", "marker", "outer_tip", "outer_marker")
OSTIA = tuple(f"ostium_{name}" for name in BRANCHES)
KEYPOINTS = DEVICE_KEYPOINTS + OSTIA
# State of a keypoint, as in COCO.
ABSENT, UNSEEN, SEEN = 0, 1, 2

# Options of the task for each kit of devices, by name.
KITS: dict[str, dict[str, Any]] = {
    "steerable_5f": {"device": "steerable_5f", "rotation": True},
    "steerable_4f": {"device": "steerable_4f", "rotation": True},
    "glide": {"devices": ["wire_035_glide"]},
    "glide_in_berenstein": {"devices": ["wire_035_glide", "berenstein_5f"]},
    "glide_in_vertebral": {"devices": ["wire_035_glide", "vertebral_5f"]},
    "micro": {"devices": ["wire_014_micro", "microcatheter_021"]},
}
# Ranges drawn for each sequence: angles, degrees, within those used for the arch;
# electronic zoom; air kerma, Gy; gain; iodine in the lumen of half of them, kg/m³.
PRIMARY, SECONDARY = (-45.0, 75.0), (-25.0, 25.0)
ZOOM, KERMA, GAIN, IODINE = (1.0, 1.8), (8e-9, 60e-9), (0.6, 0.85), (3.0, 20.0)
_STARTS = (0.0, 0.9)  # start, as a fraction of the route to the branch
_RANDOMISED = {"friction": (0.02, 0.15), "stiffness": (0.8, 1.25), "roll": (-3.1, 3.1)}
# Range of the mean push of a motion; standard deviation and correlation between control
# steps of the noise added to the actions.
_PUSH, _JITTER, _MEMORY = (-0.3, 1.0), 0.3, 0.8


# Parameters and time (s) of a vessel that moves, as `Motion.to_space` takes them.
Warp = tuple[np.ndarray, float]


@dataclasses.dataclass(frozen=True)
class ImageSetOptions:
    """Content of a dataset.

    Attributes:
        sequences: Number of motions in each anatomy.
        frames: Number of frames of a sequence.
        views: Number of C-arms that image each motion; each gives a sequence.
        stride: Control steps of 40 ms from frame to frame.
        size: Pixels along a side of an image.
        vessel: State of the vessel: rigid, silicone or living.
        anatomies: Number of random arches in train, val and test; or of the given
            anatomies, in their order.
        pictures: Whether the images are also written as PNG, for tools that read COCO
            folders.
        seed: Seed of all random numbers.
        anatomy: Directory of an anatomy, or name of a phantom, in place of random
            arches; repeated for several.
    """

    sequences: int = 32
    frames: int = 32
    views: int = 2
    stride: int = 1
    size: int = 128
    vessel: str = "rigid"
    anatomies: tuple[int, int, int] = (8, 2, 2)
    pictures: bool = False
    seed: int = 0
    anatomy: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        most = {"sequences": 1000, "frames": 1000, "views": 100, "stride": 100}
        for name, limit in most.items():
            bounds.whole(name, getattr(self, name), 1, limit)
        bounds.whole("size", self.size, 16, bounds.MOST_PIXELS)
        bounds.choice("vessel", self.vessel, PRESETS)
        counts = bounds.vector("anatomies", self.anatomies, 3, 0, 50)
        if any(count % 1 for count in counts) or not sum(counts):
            bounds.refuse("anatomies", self.anatomies, "whole numbers, not all 0")
        object.__setattr__(self, "anatomies", tuple(map(int, counts)))
        bounds.switch("pictures", self.pictures)
        bounds.seed("seed", self.seed)
        if isinstance(self.anatomy, str):
            bounds.refuse("anatomy", self.anatomy, "a list of names or directories")
        given = tuple(bounds.text("anatomy", str(one)) for one in self.anatomy)
        object.__setattr__(self, "anatomy", given)
        if (count := len(given)) and sum(self.anatomies) != count:
            few = max(count // 5, int(count > 2))
            example = f"{count - 2 * few} {few} {few}"
            raise ValueError(
                f"{count} anatomies are given (--anatomy), and anatomies is "
                f"{self.anatomies}; give the numbers of them in train, val and test, "
                f"which add up to {count}, such as --anatomies {example}"
            )


class States(NamedTuple):
    """The motions in one anatomy, arrays with leading axes (T frames, N motions)."""

    shadows: Sequence[Shadow]  # one per device, points (T, N, n, 3)
    columns: dict[str, np.ndarray]  # measurements (T, N, ...) by name
    warps: list[list[Warp]]  # T times N motions of the vessel; empty at rest
    kept: np.ndarray  # indices of the motions without a physics error


def simulate(
    anatomy: Anatomy, goal: str, kit: str, options: ImageSetOptions, seed: Sequence[int]
) -> States:
    """Simulates devices with random actions.

    Raises:
        ValueError: the devices do not fit, or the physics fails in all motions.
    """
    from cathsim_dmc import suite
    from cathsim_dmc.simulation.batch import BatchSimulation

    drawn = {"start_along_route": _STARTS, "randomisation": _RANDOMISED, **KITS[kit]}
    drawn |= {"anatomy": anatomy, "goal": goal, "vessel": options.vessel}
    task = suite.make_task("navigate", observation="goal", **drawn)
    random, count = np.random.RandomState(seed), options.sequences
    seeds = random.randint(2**31, size=count).tolist()
    simulation = BatchSimulation(task, count, num_threads=1, seeds=seeds)
    simulation.reset()
    rollout, chain = simulation.rollout, task.scene.catheter
    groups = np.array(chain.action_groups)
    mean = random.uniform(-1.0, 1.0, (count, groups.max() + 1))[:, groups]
    ways = list(chain.translations)
    mean[:, ways] = random.uniform(_PUSH[0], _PUSH[1], (count, len(ways)))
    added, failed = np.zeros_like(mean), np.zeros(count, bool)
    shadows, turns, warps = [], [], []
    for _ in range(options.frames):
        for _ in range(options.stride):
            noise = random.normal(0.0, _JITTER, mean.shape)
            added = _MEMORY * added + np.sqrt(1.0 - _MEMORY**2) * noise
            step = simulation.step(np.clip(mean + added, -1.0, 1.0))
            failed |= step.physics_error
        shadows.append(rollout.shadows)
        state = step.readings
        turn = {"centreline": state.centreline}
        turn["wall_force"] = np.stack(step.wall_force, axis=-1)
        turn["push_force"] = np.stack([state.push_force, state.push_torque], axis=-1)
        turn["load_cell"] = state.load_cell
        if step.vessel is not None:
            for name in ("heart_phase", "breath_phase"):
                turn[name] = getattr(step.vessel, name)
        turns.append(turn)
        if (moving := rollout.moving) is not None:
            every = map(moving.warp, range(count))
            warps.append([(course.copy(), time) for _, course, time in every])
    if failed.all():
        raise ValueError(f"the physics fails in all {count} motions of {kit}")
    columns = {name: np.stack([turn[name] for turn in turns]) for name in turns[0]}
    joined = [
        dataclasses.replace(same[0], points=np.stack([each.points for each in same]))
        for same in zip(*shadows, strict=True)
    ]
    return States(joined, columns, warps, np.flatnonzero(~failed))


def ostia(anatomy: Anatomy) -> np.ndarray:
    """Returns the places (len(OSTIA), 3) of the ostia, m; NaN for missing branches."""
    vessels, none = anatomy.tree.vessels, np.full(3, np.nan)
    return np.array([
        vessels[name].mouth.position if name in vessels else none for name in BRANCHES
    ])  # fmt: skip


def ends(shadow: Shadow) -> np.ndarray:
    """Returns a device's distal end and its marker's proximal end (..., 2, 3), m."""
    back = shadow.points[..., ::-1, :]
    found = np.empty((*back.shape[:-2], 2, 3))
    for row in np.ndindex(back.shape[:-2]):
        found[row] = along(back[row], np.array([0.0, shadow.marker_length]))
    return found


def _within(random: Any, ends: Sequence[float] | np.ndarray) -> float:
    return random.uniform(ends[0], ends[1])


class Camera:
    """C-arm, contrast and dose of one sequence, randomly drawn."""

    def __init__(self, anatomy: Anatomy, size: int, aim: np.ndarray, random: Any):
        """Draws the settings.

        The isocentre lies on the segment from the middle of the lumen's bounding box to
        `aim` (3,), m.
        """
        self.angles = _within(random, PRIMARY), _within(random, SECONDARY)
        middle = np.mean(anatomy.lumen.box, axis=0)
        isocentre = middle + random.uniform() * (aim - middle)
        primary, secondary = np.radians(self.angles)
        self.arm = CArm(
            primary, secondary, magnification=_within(random, ZOOM),
            detector_size=DETECTOR_SIZE, resolution=(size, size),
            isocentre=tuple(isocentre),
        )  # fmt: skip
        iodine = _within(random, IODINE)
        self.iodine = iodine if random.uniform() < 0.5 else 0.0
        self.kerma = float(np.exp(_within(random, np.log(KERMA))))
        self.gain = _within(random, GAIN)

    def seen(self, places: np.ndarray) -> np.ndarray:
        """Returns column, row and state (T, K, 3) of places (T, K, 3), m or NaN."""
        pixels, _ = self.arm.project(np.nan_to_num(places, nan=1e3))
        size = self.arm.resolution[0]
        inside = ((pixels >= -0.5) & (pixels < size - 0.5)).all(axis=-1)
        inside &= np.isfinite(places[..., 0])
        state = np.where(inside, SEEN, ABSENT)
        if not self.iodine:
            state[:, -len(OSTIA) :] = np.minimum(state[:, -len(OSTIA) :], UNSEEN)
        pixels = np.where(inside[..., None], pixels, 0.0)
        return np.concatenate([pixels, state[..., None]], axis=-1)

    def before(self, anatomy: Anatomy, warp: Warp | None = None) -> Fluoroscope:
        """Returns the fluoroscope with the vessel, moved by `warp` if given."""
        surface = anatomy.surface
        if warp is not None:
            parameters, time = warp
            surface = anatomy.motion.surface(parameters, time, surface)
        depth = surface_thickness(self.arm, surface, 1)
        return Fluoroscope(
            self.arm, depth, depth > 0.0, self.iodine, kerma=self.kerma, gain=self.gain
        )


def frames_of(
    anatomy: Anatomy, states: States, options: ImageSetOptions, seed: Sequence[int]
) -> Iterator[dict[str, np.ndarray]]:
    """Yields sequences, arrays of T rows by name, each with a C-arm drawn for it."""
    random = np.random.RandomState(seed)
    rest, found = ostia(anatomy), 0
    here = np.isfinite(rest[:, 0])
    # Rows of the frames with one state of the vessel, and its motion.
    parts = [(slice(row, row + 1), each) for row, each in enumerate(states.warps)]
    device = np.concatenate([ends(shadow) for shadow in states.shadows], axis=-2)
    count = options.frames
    for motion in states.kept:
        for _ in range(options.views):
            aim = device[count // 2, motion, 0]
            camera = Camera(anatomy, options.size, aim, random)
            places = np.full((count, len(KEYPOINTS), 3), np.nan)
            places[:, : device.shape[-2]] = device[:, motion]
            places[:, -len(OSTIA) :] = rest
            image, mask = np.empty((2, count, options.size, options.size), np.uint8)
            for rows, every in parts or [(slice(None), None)]:
                warp = None if every is None else every[motion]
                view = camera.before(anatomy, warp)
                own = [
                    dataclasses.replace(each, points=each.points[rows, motion])
                    for each in states.shadows
                ]
                image[rows] = view.render(own, random)[..., 0]
                mask[rows] = DEVICE * view.device_mask(own)
                mask[rows] |= VESSEL * view.vessel_mask.astype(np.uint8)
                if warp is not None:
                    course, time = warp
                    moved, _ = anatomy.motion.to_space(course, time, rest[here])
                    places[rows, -len(OSTIA) :][:, here] = moved
            yield {
                "image": image,
                "mask": mask,
                "keypoints": camera.seen(places),
                "keypoints_3d": places,
                "camera_matrix": np.tile(camera.arm.matrix, (count, 1, 1)),
                "angles": np.tile(camera.angles, (count, 1)),
                "iodine": np.full(count, camera.iodine),
                "sequence": np.full(count, found),
                "motion": np.full(count, motion),
                "time": CONTROL_TIMESTEP * options.stride * (1.0 + np.arange(count)),
                **{name: each[:, motion] for name, each in states.columns.items()},
            }
            found += 1


_TYPES = {"camera_matrix": "f8", "sequence": "i4", "motion": "i4"}


def write(
    path: Path, anatomy: Anatomy, states: States, options: ImageSetOptions,
    seed: Sequence[int], **about: Any,
) -> int:  # fmt: skip
    """Writes the file of an anatomy, whole or not at all; returns its frame count.

    Args:
        about: attributes of the file.
    """
    import h5py

    rows, count = len(states.kept) * options.views * options.frames, options.frames
    about |= {
        "keypoints": list(KEYPOINTS),
        "mask_bits": json.dumps({"device": DEVICE, "vessel": VESSEL}),
        "units": "m, N, N m, s, kg/m3, degrees, pixels; frame LPS",
    }
    columns: dict[str, h5py.Dataset] = {}
    every = frames_of(anatomy, states, options, seed)
    first = next(every)
    with files.atomic_path(path, ".h5") as temporary:
        # On a full disk HDF5 ends the process with a segmentation fault.
        files.fill(temporary, _most_bytes(first, rows))
        with h5py.File(temporary, "w") as file:
            file.attrs.update(about)
            clips = itertools.chain([first], every)
            for start, clip in zip(range(0, rows, count), clips, strict=True):
                for name, values in clip.items():
                    if name not in columns:
                        columns[name] = _column(file, name, values, rows)
                    columns[name][start : start + count] = values
    return rows


def _column(file: Any, name: str, values: np.ndarray, rows: int) -> Any:
    """Creates an array of a file for `rows` rows of the kind of `values`."""
    pixels, shape = values.dtype == np.uint8, (rows, *values.shape[1:])
    kind = _TYPES.get(name, "u1" if pixels else "f4")
    packed = {"compression": "gzip", "compression_opts": 1} if name == "mask" else {}
    chunks = (1, *shape[1:]) if pixels else True
    return file.create_dataset(name, shape, kind, chunks=chunks, **packed)


def _most_bytes(clip: dict[str, np.ndarray], rows: int) -> int:
    """Returns an upper bound on the bytes of a file of `rows` rows such as a clip's."""
    held = sum(values.nbytes for name, values in clip.items() if name != "mask")
    # A quarter more for compressed masks and chunks; 2 KB per row for its index.
    return 2**20 + (held // len(clip["image"]) * 5 // 4 + 2**11) * rows
