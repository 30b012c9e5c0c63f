"""What a row of the table of observations is: its function, its arrays, their specs."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from dm_control.composer.observation import observable
from dm_env import specs

from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.tasks.cameras import CameraOptions
from cathsim_dmc.tasks.frame import Frame

Observation = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class ImageOptions:
    """Options on which the shapes of images depend.

    Attributes:
      fluoroscopy: set-up of the angiography machine.
      cameras: MuJoCo's cameras and their size.
    """

    fluoroscopy: FluoroscopyOptions = FluoroscopyOptions()
    cameras: CameraOptions = CameraOptions()

    def fluoroscopic(self, channels: int) -> tuple[int, ...]:
        """Shape (rows, columns, channels of all planes) of a fluoroscopic image."""
        fluoroscopy = self.fluoroscopy
        return (*fluoroscopy.resolution, fluoroscopy.planes * channels)


@dataclasses.dataclass(frozen=True)
class Entry:
    """One array of an observation, as people and specs need to know it.

    Attributes:
      key: name in the observation; `<camera>` stands for the name of each camera.
      unit: of its numbers, by part where parts differ.
      meaning: layout and frame.
      low: least value, -inf if there is no bound.
      high: greatest value.
      dtype: of an image; None for numbers, whose spec composer infers.
      shape: shape of an image by the options; None for numbers.
    """

    key: str
    unit: str
    meaning: str
    low: float = -math.inf
    high: float = math.inf
    dtype: type | None = None
    shape: Callable[[ImageOptions], tuple[int, ...]] | None = None

    def keys(self, options: ImageOptions) -> tuple[str, ...]:
        """Names in the observation."""
        if "<camera>" not in self.key:
            return (self.key,)
        return tuple(self.key.replace("<camera>", n) for n in options.cameras.names)

    def spec(self, options: ImageOptions) -> specs.Array | None:
        """Spec of an image; None for numbers."""
        if self.shape is None:
            return None
        shape = self.shape(options)
        if self.dtype is np.uint8:
            return specs.BoundedArray(shape, np.uint8, int(self.low), int(self.high))
        return specs.Array(shape, self.dtype)


@dataclasses.dataclass(frozen=True)
class ObservationKind:
    """One row of the table.

    Attributes:
      observe: function from a frame to the arrays of the observation.
      entries: its arrays.
      fluoroscopic: whether it needs the angiography machine.
      routed: whether it needs the route to the goal.
    """

    observe: Callable[[Frame], Observation]
    entries: tuple[Entry, ...]
    fluoroscopic: bool = False
    routed: bool = False


class FrameObservable(observable.Generic):
    """One entry of the observation, with the range of an image in its spec."""

    def __init__(self, read: Callable, spec: specs.Array | None):
        super().__init__(read)
        self._spec = spec
        self.enabled = True

    @property
    def array_spec(self) -> specs.Array | None:
        """Spec of an image; None for numbers, whose spec composer infers."""
        return self._spec
