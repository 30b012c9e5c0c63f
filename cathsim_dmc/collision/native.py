"""MuJoCo's structs in memory, for callbacks that are compiled.

A compiled callback gets the addresses of `mjModel` and `mjData` as int64. `offsets`
says where their fields lie and proves it; `word`, `number` and `array` read them.
Constants that differ from process to process, such as the address of a table, reach
code that is cached on disk as symbols (`symbol`, `address_of`).
"""

from __future__ import annotations

import ctypes
import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import llvmlite.binding as llvm
import mujoco
import numpy as np
from llvmlite import ir
from mujoco.introspect import ast_nodes, structs
from numba import cfunc
from numba.core import cgutils, types
from numba.extending import intrinsic, register_jitable
from numba.np.numpy_support import carray

from cathsim_dmc.compiled import keep_together

# Compiled code calls what this decorates without its first argument.
_intrinsic: Any = intrinsic

# Bytes of a value of each of MuJoCo's types that is neither a pointer nor a struct.
_SIZES = {"mjtNum": 8, "mjtSize": 8, "mjtBool": 1, "mjtByte": 1, "int": 4, "float": 4}
_SIZES |= {"size_t": 8, "uint64_t": 8, "uintptr_t": 8, "unsigned char": 1}
# Every kind of thing whose arrays callbacks may ask for, so that none is empty.
_PROBE = """
<mujoco>
  <size nuserdata="2" nuser_geom="3" nuser_body="2" nuser_jnt="2" nkey="1"/>
  <worldbody>
    <body>
      <joint name="hinge"/>
      <geom size="1"/>
      <site name="site"/>
    </body>
  </worldbody>
  <actuator><general joint="hinge" dyntype="integrator"/></actuator>
  <sensor><jointpos joint="hinge"/></sensor>
  <custom><numeric name="numeric" data="1 2"/></custom>
</mujoco>
"""


def offsets(struct: str, names: Sequence[str]) -> np.ndarray:
    """Bytes from the beginning of a struct to some of its fields, proved.

    Args:
        struct: "mjModel" or "mjData".
        names: Fields that are arrays behind a pointer, sizes, or numbers of 8 bytes;
            "opt.timestep" is one of `mjOption`.

    Returns:
        (n,) int64.

    Raises:
        RuntimeError: if a field of this MuJoCo does not lie where its own description
            says, or has no proof.
    """
    model, data = _probe()
    owner = {"mjModel": model, "mjData": data}[struct]
    found = []
    for name in names:
        place = _place(struct, name)
        if place is None or not _proved(owner, name, place):
            raise RuntimeError(
                f"{struct}.{name} of MuJoCo {mujoco.__version__} is not where it is "
                "said to be; install a version that pyproject.toml allows"
            )
        found.append(place)
    return np.array(found, dtype=np.int64)


_CONTACT = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 0.9"><freejoint/><geom size="1"/></body>
  </worldbody>
</mujoco>
"""


def contact_places() -> np.ndarray:
    """Where contacts and their constraints lie in memory, proved.

    Returns:
        (11,) int64, bytes: in mjData of the number of contacts (int32), of their
        address and that of the Jacobian; size of a contact, which begins with its
        depth, and in it its position, frame, dimension, second geom and first
        constraint (int32 these three), `solimp` and `solref`.

    Raises:
        RuntimeError: if they do not lie where MuJoCo's own description says.
    """
    model = mujoco.MjModel.from_xml_string(_CONTACT)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    places = _places("mjData")
    inner, size, _ = _lay(structs.STRUCTS["mjContact"].fields)
    names = ("ncon", "contact", "efc_J")
    own = ("pos", "frame", "dim", "geom2", "efc_address", "solimp", "solref")
    found = [places[name] for name in names]
    found += [size, *(inner[name] for name in own)]
    count = ctypes.c_int32.from_address(data._address + places["ncon"]).value
    first = ctypes.c_int64.from_address(data._address + places["contact"]).value
    jacobian = ctypes.c_int64.from_address(data._address + places["efc_J"]).value
    contact = data.contact[0]
    read = [
        ctypes.c_double.from_address(first).value,
        *(ctypes.c_double * 5).from_address(first + inner["solimp"]),
        *(ctypes.c_double * 2).from_address(first + inner["solref"]),
        *(ctypes.c_double * 3).from_address(first + inner["pos"]),
        *(ctypes.c_double * 9).from_address(first + inner["frame"]),
        *(ctypes.c_int32.from_address(first + inner[n]).value for n in own[2:5]),
    ]
    known = [contact.dist, *contact.solimp, *contact.solref, *contact.pos]
    known += [*contact.frame, contact.dim, contact.geom2, contact.efc_address]
    proved = read == known and jacobian == data.efc_J.ctypes.data and count == 1
    if not proved:
        raise RuntimeError(
            f"mjContact of MuJoCo {mujoco.__version__} is not laid out as it is said "
            "to be; install a version that pyproject.toml allows"
        )
    return np.array(found, dtype=np.int64)


def follow(function: Any) -> int:
    """Has MuJoCo call a compiled function in `mjcb_passive`.

    Returns:
        Address of the function that stood there before, which it must call; 0 for none.

    Raises:
        RuntimeError: if a Python function stands there.
    """
    before = mujoco.get_mjcb_passive()
    if before is not None and not hasattr(before, "argtypes"):
        raise RuntimeError(
            f"mjcb_passive is the Python function {before!r}, which compiled functions "
            "cannot call; remove it with mujoco.set_mjcb_passive(None)"
        )
    mujoco.set_mjcb_passive(function.ctypes)
    return 0 if before is None else ctypes.cast(before, ctypes.c_void_p).value or 0


def _proved(owner: mujoco.MjModel | mujoco.MjData, name: str, place: int) -> bool:
    """Whether memory holds what MuJoCo's own Python types know of a field."""
    try:
        known = operator.attrgetter(name)(owner)
    except AttributeError:
        return False
    if isinstance(known, np.ndarray):
        known = known.ctypes.data if known.size else 0
    kind = ctypes.c_double if isinstance(known, float) else ctypes.c_int64
    return bool(known) and kind.from_address(owner._address + place).value == known


@functools.cache
def _probe() -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(_PROBE)
    data = mujoco.MjData(model)
    data.time = 0.5
    return model, data


def _place(struct: str, name: str) -> int | None:
    """Offset of a field, perhaps one of a struct in the struct, bytes."""
    if name.startswith("opt."):
        inner = _places("mjOption").get(name.removeprefix("opt."))
        return None if inner is None else _places(struct)["opt"] + inner
    return _places(struct).get(name)


@functools.cache
def _places(struct: str) -> dict[str, int]:
    return _lay(structs.STRUCTS[struct].fields)[0]


def _lay(fields) -> tuple[dict[str, int], int, int]:
    """Offsets of fields as C lays them out, their size and alignment in bytes."""
    places, end, widest = {}, 0, 1
    for field in fields:
        size, alignment = _size(field.type)
        end += -end % alignment
        places[field.name] = end
        end, widest = end + size, max(widest, alignment)
    return places, end + -end % widest, widest


def _size(kind) -> tuple[int, int]:
    if isinstance(kind, ast_nodes.PointerType):
        return 8, 8
    if isinstance(kind, ast_nodes.ArrayType):
        size, alignment = _size(kind.inner_type)
        return size * int(np.prod(kind.extents)), alignment
    if isinstance(kind, ast_nodes.AnonymousStructDecl):
        return _lay(kind.fields)[1:]
    if kind.name in structs.STRUCTS:
        return _lay(structs.STRUCTS[kind.name].fields)[1:]
    size = _SIZES.get(kind.name, 4)  # the others are enumerations
    return size, size


def symbol(name: str, array: np.ndarray) -> None:
    """Gives an array that lives as long as the process a name for `address_of`."""
    llvm.add_symbol(name, array.ctypes.data)


@_intrinsic
def address_of(_, name):
    """Address (int64) of the array that `symbol` has given a name, a literal."""
    if not isinstance(name, types.StringLiteral):
        return None

    def generate(context, builder, signature, arguments):
        whole = ir.IntType(64)
        known = builder.module.globals.get(name.literal_value)
        place = known or ir.GlobalVariable(builder.module, whole, name.literal_value)
        return builder.ptrtoint(place, whole)

    return types.int64(name), generate


def _load(kind: ir.Type):
    def generate(context, builder, signature, arguments):
        place = builder.inttoptr(arguments[0], kind.as_pointer())
        return builder.load(place)

    return generate


@_intrinsic
def word(_, address):
    """The int64 at an address: a size, or the address of an array."""
    return types.int64(types.int64), _load(ir.IntType(64))


@_intrinsic
def fused(_, one, other, more):
    """The number one * other + more, rounded once; so numpy sums squares."""

    def generate(context, builder, signature, arguments):
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), generate


@_intrinsic
def pointer(_, address):
    """An address as the untyped pointer that `numba.carray` takes."""

    def generate(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(types.int64), generate


@register_jitable
def numbers(address, count):
    """The array (count,) of float64 at an address; it owns nothing."""
    return carray(pointer(address), count, np.float64)


@register_jitable
def wholes(address, count):
    """The array (count,) of int32 at an address; it owns nothing."""
    return carray(pointer(address), count, np.int32)


@register_jitable
def shorts(address, count):
    """The array (count,) of int16 at an address; it owns nothing."""
    return carray(pointer(address), count, np.int16)


@_intrinsic
def call_collision(_, address, model, data, contacts, geom1, geom2, margin):
    """Calls a function of MuJoCo's collision table; returns the number of contacts."""

    def generate(context, builder, signature, values):
        kinds = [value.type for value in values[1:]]
        kind = ir.FunctionType(ir.IntType(32), kinds)
        place = builder.inttoptr(values[0], kind.as_pointer())
        return builder.call(place, values[1:])

    places = [types.int64] * 4
    return types.int32(*places, types.int32, types.int32, types.float64), generate


@_intrinsic
def call_callback(_, address, model, data):
    """Calls one of MuJoCo's callbacks on a model and its data, given by addresses."""

    def generate(context, builder, signature, values):
        kind = ir.FunctionType(ir.VoidType(), [value.type for value in values[1:]])
        place = builder.inttoptr(values[0], kind.as_pointer())
        builder.call(place, values[1:])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), generate


@_intrinsic
def call_error(_, address, text, number):
    """Calls `mju_error` with the text at an address, and an int32 for its %d."""

    def generate(context, builder, signature, values):
        kind = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t], var_arg=True)
        place = builder.inttoptr(values[0], kind.as_pointer())
        line = builder.inttoptr(values[1], cgutils.voidptr_t)
        builder.call(place, [line, values[2]])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int32), generate


def callback(signature: str, cache: bool = True) -> Callable:
    """Compiles a function that C calls, once on each machine as `compiled` does.

    Args:
        signature: numba's, such as "void(int64, int64)"; a pointer is an int64.
        cache: Whether it is kept on disk.
    """
    keep_together()

    def decorate(function: Callable):
        options = {"nopython": True, "error_model": "numpy"}
        try:
            return cfunc(signature, cache=cache, **options)(function)
        except RuntimeError:  # neither this folder nor the user's can be written to
            return cfunc(signature, **options)(function)

    return decorate
