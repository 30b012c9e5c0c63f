"""Rows of the table of observations, with their arrays and specs."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple, cast

import numpy as np
from dm_control.composer.observation import observable
from dm_env import specs

from cathsim_dmc import bounds
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.physics.forces import WallForce
from cathsim_dmc.physics.readings import CoaxialReadings, Readings
from cathsim_dmc.physics.vessel import VesselReadings
from cathsim_dmc.tasks.cameras import CameraOptions
from cathsim_dmc.tasks.common_chain import CommonChain
from cathsim_dmc.tasks.route import Ahead

_IMAGES = np.uint8, np.float32  # types of images
_ROUNDING = 1e-6  # by which a number may exceed its range, relative above 1
Observation = dict[str, np.ndarray]
Shape = int | tuple[int, ...]


class Frame(NamedTuple):
    """Input of the observations after a control step.

    Attributes:
        readings: state of the device.
        wall_force: force on the wall over the control step.
        action: (..., A), the last action, zeros after a reset.
        goal: (3,) or (..., 3), m.
        chain: the device as observations show it.
        images: of the sensors, by name: (..., H, W, P) uint8 of P planes "past_0", the
            last one, "past_1" and "past_2"; (..., H, W, 2 P) uint8 "masks", see
            `imaging.angiograph.masks`; (..., P, K + 1, 2) "pixels" of tracked points
            and goal, (column, row); endoluminal views; "rgb" and "depth".
        ahead: route ahead of the tip; None where no observation needs it.
        devices: state of coaxial devices; None for a single device.
        vessel: state of the vessel; None for a rigid one with blood at rest.
        retry: (..., K), memory of the attempts, see `retry.shown`; None where no
            observation needs it.
    """

    readings: Readings
    wall_force: WallForce
    action: np.ndarray
    goal: np.ndarray
    chain: CommonChain
    images: Mapping[str, np.ndarray]
    ahead: Ahead | None
    devices: CoaxialReadings | None
    vessel: VesselReadings | None
    retry: np.ndarray | None = None


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Sizes that the shapes of observations depend on.

    Attributes:
        actions: entries of an action.
        joints: joints that are shown, see `common_chain.CommonChain`.
        links: links that are shown.
        devices: coaxial devices; 0 for a single device.
        fluoroscopy: set-up of the angiography machine.
        endoluminal: (rows, columns) of endoluminal views.
        cameras: names of MuJoCo's cameras that are shown, and size of their images.
    """

    actions: int = 0
    joints: int = 0
    links: int = 0
    devices: int = 0
    fluoroscopy: FluoroscopyOptions = FluoroscopyOptions()
    endoluminal: tuple[int, int] = (128, 128)
    cameras: CameraOptions = CameraOptions()


@dataclasses.dataclass(frozen=True)
class Entry:
    """One array of an observation.

    Attributes:
        key: name in the observation.
        shape: shape for one simulation or length of a vector, or a function of the
            sizes that returns it.
        unit: of its numbers, by part where parts differ.
        meaning: layout and frame.
        low: least value, -inf if there is no bound; numbers below are refused at the
            start of an episode.
        high: greatest value, likewise.
        dtype: numpy.float64 for numbers, uint8 or float32 for images.

    Raises:
        ValueError: if the type is another one.
    """

    key: str
    shape: Shape | Callable[[Sizes], Shape]
    unit: str
    meaning: str
    low: float = -math.inf
    high: float = math.inf
    dtype: type = np.float64

    def __post_init__(self):
        if self.dtype not in (np.float64, *_IMAGES):
            allowed = "numpy.float64 for numbers, numpy.uint8 or float32 for images"
            bounds.refuse(f"dtype of the entry {self.key!r}", self.dtype, allowed)

    @property
    def is_image(self) -> bool:
        """Whether it is an image."""
        return self.dtype != np.float64

    def spec(self, sizes: Sizes) -> specs.Array:
        """Its spec for one simulation."""
        shape = self.shape(sizes) if callable(self.shape) else self.shape
        shape = (shape,) if isinstance(shape, int) else shape
        if not shape or (self.is_image and len(shape) != 3):
            allowed = "one length or more"
            if self.is_image:
                allowed = "(height, width, channels)"
            bounds.refuse(f"the shape of the entry {self.key!r}", shape, allowed)
        if math.isinf(self.low) and math.isinf(self.high):
            return specs.Array(shape, self.dtype, self.key)
        least, most = (0, 255) if self.dtype == np.uint8 else (-math.inf, math.inf)
        low = np.asarray(max(self.low, least), self.dtype)
        high = np.asarray(min(self.high, most), self.dtype)
        return specs.BoundedArray(shape, self.dtype, low, high, self.key)


# Keys of TorchRL and of the environments, beside the observation.
_RESERVED = ("action", "reward", "done", "terminated", "truncated", "info", "next")
# Requirements of a row of the table, see `ObservationKind.needs`.
FLUOROSCOPY, BIPLANE = "fluoroscopy", "fluoroscopy with two planes"
ROUTE, OPENGL = "a route", "OpenGL"
COAXIAL, LIVING = "coaxial devices", "a living vessel (option vessel)"
COAXIAL_ROUTE = "coaxial devices and a route"


@dataclasses.dataclass(frozen=True)
class ObservationKind:
    """One row of the table.

    Attributes:
        observe: function from a frame to the arrays of the observation.
        entries: its arrays.
        needs: `FLUOROSCOPY`, `BIPLANE`, `ROUTE`, `OPENGL`, `COAXIAL`, `LIVING` or
            `COAXIAL_ROUTE`; empty for nothing.
        joined: names of the rows that coaxial devices add to it.
        images: names of the rows whose images it reads in `Frame.images`, such as
            ("image",), whether the task observes these or not.
    """

    observe: Callable[[Frame], Observation]
    entries: tuple[Entry, ...]
    needs: str = ""
    joined: tuple[str, ...] = ()
    images: tuple[str, ...] = ()


def flat(array: np.ndarray, axes: int) -> np.ndarray:
    """Flattens the last `axes` axes into one."""
    return array.reshape(array.shape[:-axes] + (-1,))


def _within(numbers: np.ndarray, spec: specs.Array) -> bool:
    """Whether numbers are in the range of a spec, if it has one, but for rounding."""
    if not (isinstance(spec, specs.BoundedArray) and numbers.size):
        return True
    low, high = float(spec.minimum), float(spec.maximum)
    below, above = (_ROUNDING * max(1.0, abs(end)) for end in (low, high))
    return numbers.min() >= low - below and numbers.max() <= high + above


class HeldImages(dict[str, np.ndarray]):
    """Images by name; ValueError for one that the sensors do not hold."""

    def __missing__(self, name: str):
        raise ValueError(
            f"an observation reads the image {name!r}, which the task does not render; "
            "declare in its row the observations whose images it reads, such as "
            f"images=('image',); rendered are {', '.join(self) or 'none'}"
        )


class ObservationTable(dict[str, ObservationKind]):
    """Observations by name."""

    def row(self, *entries: Entry, **options) -> Callable:
        """Returns a decorator that adds a function to the table under its own name.

        ValueError if a key of an entry or the name is reserved or taken.
        """

        def add(function: Callable[[Frame], Observation]):
            name = function.__name__
            if reserved := sorted({entry.key for entry in entries} & {*_RESERVED}):
                raise ValueError(
                    f"entries {', '.join(reserved)} of observation {name!r} are names "
                    "that environments use; choose another"
                )
            there = {entry.key: entry for entry in self.entries(self)}
            taken = [e.key for e in entries if there.get(e.key, e) != e]
            if name in self or taken:
                what = f"entries {', '.join(taken)}" if taken else "name"
                raise ValueError(
                    f"the {what} of observation {name!r} are taken by others with "
                    "another meaning; choose another"
                )
            kind = ObservationKind(function, entries, **options)
            if not all(one in self for one in kind.images):
                bounds.refuse(
                    f"images of {name!r}", kind.images, f"of {', '.join(self)}"
                )
            self[name] = kind
            return function

        return add

    def resolve(
        self,
        names: str | Sequence[str],
        coaxial: bool | None = None,
        living: bool | None = None,
    ) -> tuple[str, ...]:
        """Checks names of rows; returns them, followed by their `joined` rows.

        Args:
            coaxial: Whether the devices are coaxial, which adds the joined rows; None
                if that is not known, which adds none.
            living: Whether the vessel is living; None if that is not known.

        Raises:
            ValueError: if there is no name, a name is unknown or repeated, or a row
                needs coaxial devices or a living vessel, which the task lacks.
        """
        listed = isinstance(names, Sequence) and not isinstance(names, str | bytes)
        chosen = cast(tuple[str, ...], tuple(names) if listed else (names,))
        pair, lives = coaxial is not False, living is not False
        there = {COAXIAL: pair, COAXIAL_ROUTE: pair, LIVING: lives}
        allowed = [n for n, row in self.items() if there.get(row.needs, True)]
        unknown = [n for n in chosen if not isinstance(n, str) or n not in allowed]
        if unknown or not chosen or len(set(chosen)) < len(chosen):
            known = [n for n in unknown if isinstance(n, str) and n in self]
            hints = [f"{n!r} needs {self[n].needs}; " for n in known]
            raise ValueError(
                f"observation is {names!r}; {''.join(hints)}give one of "
                f"{', '.join(allowed)}, or a list of different ones"
            )
        joined = [n for name in chosen for n in self[name].joined if coaxial]
        return tuple(dict.fromkeys([*chosen, *joined]))

    def needs(self, names: Sequence[str], *what: str) -> bool:
        """Whether any of the named rows, or one whose images it reads, has a need."""
        return any(self[name].needs in what for name in self.with_images(names))

    def with_images(self, names: Sequence[str]) -> tuple[str, ...]:
        """Names of rows, followed by those whose images they read."""
        read = (one for name in names for one in self[name].images)
        return tuple(dict.fromkeys([*names, *read]))

    def observe(self, names: Sequence[str], frame: Frame) -> Observation:
        """Computes the named rows; arrays may share memory with the frame.

        Raises:
            ValueError: if a row is no mapping.
        """
        rows = {name: self[name].observe(frame) for name in names}
        for name, row in rows.items():
            if not isinstance(row, Mapping):
                what = "a mapping of its entries to arrays (N, ...)"
                bounds.refuse(f"what observation {name!r} returns", row, what)
        return {key: value for row in rows.values() for key, value in row.items()}

    def check(
        self,
        observation: Observation,
        wanted: Mapping[str, specs.Array],
        begun: np.ndarray,
    ) -> None:
        """Raise ValueError if arrays (N, ...) do not fit a simulation's specs.

        Args:
            begun: (K,) numbers of the simulations that begin an episode, whose entries
                must be finite and in the declared range, but for rounding; the others
                may have diverged.
        """
        for key in sorted(observation.keys() | wanted.keys()):
            value, entry = observation.get(key), f"entry {key!r} of an observation"
            if value is not None and not isinstance(value, np.ndarray):
                bounds.refuse(entry, value, "an array (N, ...)")
            found = None if value is None else value.shape[1:]
            spec = wanted[key].shape if key in wanted else None
            if value is None or found != spec:
                raise ValueError(
                    f"{entry} has the shape {found} for one simulation, and its row "
                    f"declares {spec}; return what it declares"
                )
            if value.dtype != wanted[key].dtype:
                raise ValueError(
                    f"{entry} is of {value.dtype}, and its row declares "
                    f"{wanted[key].dtype}; return what it declares"
                )
            numbers, fault = value[begun], ""
            if value.dtype.kind == "f" and not np.isfinite(numbers).all():
                fault = "its numbers must be finite"
            elif not _within(numbers, wanted[key]):
                low, high = wanted[key].minimum, wanted[key].maximum
                fault = f"its row declares numbers from {low:g} to {high:g}"
            if fault:
                raise ValueError(
                    f"{entry} is {bounds.shown(numbers)} at the start of an episode; "
                    f"{fault}"
                )

    def entries(self, names: Iterable[str]) -> list[Entry]:
        """Entries of the named rows."""
        return [entry for name in names for entry in self[name].entries]

    def plain_keys(self, names: str | Sequence[str]) -> list[str]:
        """Keys of the entries of rows, in the order of the networks.

        Those of "route" and of "biplane", its reconstruction, have the same keys.
        """
        keys = sorted(entry.key for entry in self.entries(self.resolve(names)))
        return [key.removeprefix("route_").removeprefix("biplane_") for key in keys]

    def entry_specs(self, names: Sequence[str], sizes: Sizes) -> dict[str, specs.Array]:
        """Specs of the entries of the named rows, for one simulation."""
        return {entry.key: entry.spec(sizes) for entry in self.entries(names)}


class FrameObservable(observable.Generic):
    """One entry of the observation, with its spec."""

    def __init__(self, read: Callable, spec: specs.Array):
        super().__init__(read)
        self._spec = spec
        self.enabled = True

    @property
    def array_spec(self) -> specs.Array:
        """Shape, type and bounds."""
        return self._spec
