"""The functions in MuJoCo's callbacks, which call the laws of all effects.

MuJoCo has one `mjcb_passive` and one `mjcb_control` for all models of a process. The
two functions here call the function that was installed before them and then, for a
simulation with a `Layout`, the adapters of its laws in order. `stand` installs them,
also again if they were removed. A function that has replaced them without calling them
is then called before them.
"""

import ctypes
import functools
import hashlib
import inspect
import logging
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.collision import native, own
from cathsim_dmc.collision.native import address_of, call_before, data_field, word
from cathsim_dmc.collision.own import CONTROL, PASSIVE, layout_of
from cathsim_dmc.compiled import compiled
from cathsim_dmc.physics import adapters
from cathsim_dmc.physics.readings import ModelIndex

_LOG = logging.getLogger(__name__)
_BEFORE = {
    "mjcb_passive": native.symbol("cathsim_before_passive", 1),
    "mjcb_control": native.symbol("cathsim_before_control", 1),
}
ACTS_IN = ("passive", "control", "contact")
_callback = native.callback("void(int64, int64)")


@compiled
def _run(laws, model, data, layout):
    """Calls the adapters of a list, see `own.PASSIVE`."""
    for n in range(word(laws)):
        entry = laws + 8 + 16 * n
        native.call_law(word(entry), model, data, layout, word(entry + 8))


@_callback
def _passive(model, data):
    """Runs the laws of passive forces, and of contacts before they get a reference."""
    call_before(address_of("cathsim_before_passive"), model, data)
    layout = layout_of(model, data)
    if layout != 0:
        _run(word(layout + PASSIVE), model, data, layout)


@_callback
def _control(model, data):
    """Zeroes `xfrc_applied` of the links, then runs the laws that add to it."""
    call_before(address_of("cathsim_before_control"), model, data)
    layout = layout_of(model, data)
    if layout != 0 and word(word(layout + CONTROL)) > 0:
        first = word(layout + own.LINK)
        last = first + word(layout + own.LINKS)
        data_field(data, "xfrc_applied")[first:last] = 0.0
        _run(word(layout + CONTROL), model, data, layout)


@native.callback("void(int64, int64, int64, int64)")
def _answer(model, data, layout, start):
    """Law that counts its calls, see `_reaches`."""
    data_field(data, "userdata")[0] += 1.0


class Law(NamedTuple):
    """A law of a layout.

    Attributes:
        name: Name of the class of the effect.
        acts_in: "passive", "control" or "contact".
        adapter: Function that a callback calls, see `adapters`.
        start: Offset of its parameters in `userdata`.
    """

    name: str
    acts_in: str
    adapter: Any
    start: int

    @property
    def address(self) -> int:
        """Address of the compiled adapter; ValueError if numba cannot compile it."""
        try:
            return self.adapter.address
        except native.NotCompiledError as error:
            raise ValueError(
                f"numba cannot compile {self.name}.law, a function of parameters, time "
                "and what it acts on, with numbers and arrays alone (CONTRIBUTING.md): "
                f"{error}"
            ) from error


class Places(NamedTuple):
    """Indices of a device and its vessel in a model, for laws.

    Attributes:
        first_link: Body of the first link; those of the others follow it.
        geoms: (L,), geoms of the links.
        hinges: (3, 2 J), joints of the hinges in the order of the chain, their
            positions and their degrees of freedom.
        wall: Geom of the wall, -1 for none.
        bore: Geom of the bore of the sheath, -1 for none.
        clock: Degree of freedom that moves the wall, see `adapters.motion`, -1 for
            none.
    """

    first_link: int
    geoms: np.ndarray
    hinges: np.ndarray = np.zeros((3, 0))
    wall: int = -1
    bore: int = -1
    clock: int = -1

    @classmethod
    def of(cls, model: mujoco.MjModel, index: ModelIndex) -> "Places":
        """Indices in the scene of a task."""
        qpos = np.sort(index.bends_qpos, axis=None)
        joints = np.searchsorted(model.jnt_qposadr, qpos)
        hinges = np.array([joints, qpos, model.jnt_dofadr[joints]])
        kind = mujoco.mjtObj.mjOBJ_GEOM
        wall = mujoco.mj_name2id(model, kind, "wall")
        bore = mujoco.mj_name2id(model, kind, "sheath/bore")
        ticks = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, "vessel_clock")
        clock = -1 if ticks < 0 else int(model.jnt_dofadr[ticks])
        return cls(index.links.start, index.geoms, hinges, wall, bore, clock)


class Layout:
    """Layout of all simulations of a model with some effects, for the callbacks.

    Attributes:
        label: Value of the last number of `userdata` in an episode.
    """

    def __init__(self, sizes: Sequence[int], places: Places, laws: Sequence[Law]):
        """Adds the layout to the table of the process, see `layout`.

        Raises:
            MemoryError: if the process has too many layouts.
        """
        self._laws = laws
        start = {law.adapter: law.start for law in laws}
        where = np.concatenate([places.geoms, *places.hinges]).astype(np.int64)
        named = [(law.name, law.acts_in, law.start) for law in laws]
        kind = repr((sizes, places.first_link, places[3:5], where.tolist(), named))
        # Equal in every process, because the label is part of the saved state.
        number = int.from_bytes(hashlib.sha256(kind.encode()).digest()[:6], "big") + 1
        taken = own.TABLE[:, 0].view(np.float64)
        if 2 * np.count_nonzero(taken) >= own.CAPACITY:
            raise MemoryError(
                f"a process can hold {own.CAPACITY // 2} layouts of effects; start "
                "another"
            )
        while 1.0 + number / own.SPAN in taken:
            number += 1
        self.label, slot = 1.0 + number / own.SPAN, number % own.CAPACITY
        while taken[slot]:
            slot = (slot + 1) % own.CAPACITY
        lists = [self._list("passive", "contact"), self._list("control")]
        # Addresses in the table refer to these until the process ends.
        self._kept, self._row = (where, lists), own.TABLE[slot]
        self._row[1 : 1 + len(sizes)] = sizes
        self._row[1 + len(sizes) :] = (
            *(each.ctypes.data for each in lists),
            *(places.first_link, len(places.geoms), places.hinges.shape[1] // 2),
            *(where.ctypes.data, places.wall, places.bore),
            *(start.get(adapters.motion, -1), 0, start.get(adapters.compliance, -1)),
            places.clock,
        )
        # The label is written last: other threads search the table concurrently.
        taken[slot] = self.label

    def _list(self, *callbacks: str) -> np.ndarray:
        """Number of laws of a callback, then adapter and offset of each."""
        found = [law for name in callbacks for law in self._laws if law.acts_in == name]
        rows = [(law.address, law.start) for law in found]
        return np.array([len(rows), *np.ravel(rows)], np.int64)

    def raise_fault(self, warned: np.ndarray) -> None:
        """Raises RuntimeError if a law has failed since the last call.

        Args:
            warned: (N,) bool, whether MuJoCo has warned. A law may then have got
                numbers too large for it: that it writes NaN is only logged.
        """
        fault = own.FAULT // 8
        if not self._row[fault]:
            return
        code, self._row[fault] = int(self._row[fault]), 0
        (name,) = (law.name for law in self._laws if law.start == abs(code) - 1)
        if code < 0:
            text = f"the law of {name} writes a number that is not finite"
            if not warned.any():
                raise RuntimeError(f"{text}, which MuJoCo may ignore")
            _LOG.error(text)
            return
        raise RuntimeError(
            f"the law of {name} has raised an error in a physics step, most likely an "
            "index beyond an array of its parameters or of the device; compare its "
            "indices with the lengths of the arrays"
        )


def laws(effect: Any, kind: Any, start: int) -> list[Law]:
    """List of the law of an `effects.Effect`; empty if it has none.

    Args:
        effect: The effect.
        kind: Class of its parameters.
        start: Offset of its parameters in `userdata`.

    Raises:
        ValueError: if the law is no static method, or the effect does not say where it
            acts.
    """
    name, adapter = type(effect).__qualname__, None
    if effect.adapter is not None:
        adapter = getattr(adapters, effect.adapter)
    elif effect.law is not None:
        if inspect.ismethod(effect.law):
            raise ValueError(
                f"{name}.law is a method; make it a @staticmethod of parameters, time "
                "and what it acts on, without self"
            )
        bounds.choice(f"{name}.acts_in", effect.acts_in, ACTS_IN)
        adapter = adapters.made(effect.law, kind, effect.acts_in)
    return [] if adapter is None else [Law(name, effect.acts_in, adapter, start)]


_layouts: dict[Any, Layout] = {}
_LOCK = threading.RLock()  # held while layouts or callbacks change


def layout(model: mujoco.MjModel, places: Places, laws: Sequence[Law]) -> Layout:
    """Returns the layout of a model with some laws, the same one for equal arguments.

    Raises:
        RuntimeError: if a Python function is installed in a callback.
    """
    sizes = tuple(int(getattr(model, name)) for name in own.SIZES)
    arrays = [np.asarray(each, np.int64).tobytes() for each in places[1:3]]
    key = (sizes, places.first_link, *arrays, *places[3:], tuple(laws))
    with _LOCK:
        if key not in _layouts:
            _layouts[key] = Layout(sizes, places, tuple(laws))
        stand()
        return _layouts[key]


def _standing(name: str) -> int:
    """Address of the function that is installed in a callback, 0 for none.

    Raises:
        RuntimeError: if it is a Python function.
    """
    stood = getattr(mujoco, f"get_{name}")()
    if stood is not None and not hasattr(stood, "argtypes"):
        raise RuntimeError(
            f"{name} is the Python function {stood!r}, which compiled functions cannot "
            "call, so the effects of this package would be missing; remove it with "
            f"mujoco.set_{name}(None), then load or reset the environment"
        )
    return 0 if stood is None else ctypes.cast(stood, ctypes.c_void_p).value or 0


def stand() -> None:
    """Installs the functions of this module in MuJoCo's callbacks, where needed.

    A function that is installed there and does not call them is called before them.

    Raises:
        RuntimeError: if a Python function is installed in a callback.
    """
    with _LOCK:
        for name, function in (("mjcb_passive", _passive), ("mjcb_control", _control)):
            stood = _standing(name)
            if stood == function.address or (stood and _reaches(name)):
                continue
            _BEFORE[name][0] = stood
            getattr(mujoco, f"set_{name}")(function.ctypes)


@functools.cache
def _probe() -> dict[str, tuple[mujoco.MjModel, mujoco.MjData, Layout]]:
    """For each callback, a simulation whose only law is `_answer`."""
    text = "<mujoco><size nuserdata='2'/></mujoco>"
    model = mujoco.MjModel.from_xml_string(text)
    sizes = [int(getattr(model, name)) for name in own.SIZES]
    places, found = Places(0, np.zeros(0)), {}
    for name in _BEFORE:
        law = Law("answer", name.removeprefix("mjcb_"), _answer, 0)
        found[name] = model, mujoco.MjData(model), Layout(sizes, places, (law,))
    return found


def _reaches(name: str) -> bool:
    """Whether the function in a callback calls that of this module."""
    model, data, layout = _probe()[name]
    data.userdata[:] = 0.0, layout.label
    mujoco.mj_forward(model, data)
    return bool(data.userdata[0])
