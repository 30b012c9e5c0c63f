"""Access of compiled callbacks to MuJoCo's structs.

A compiled callback receives the addresses of `mjModel` and `mjData` as int64. The
readers `model_field`, `data_field` and `contact_field` read fields by name. Field
offsets are determined and verified when the callback is compiled; cached code is
compiled again for another version of MuJoCo. Cached code refers to constants that
differ between processes, such as the address of a table, by symbol (`symbol`,
`address_of`).
"""

from __future__ import annotations

import ctypes
import functools
import math
import operator
import re
from collections.abc import Callable
from typing import Any

import llvmlite.binding as llvm
import mujoco
import numpy as np
from llvmlite import ir
from numba.core import cgutils, sigutils, types
from numba.core.ccallback import CFunc
from numba.core.errors import NumbaError
from numba.extending import intrinsic, overload, register_jitable
from numba.np.arrayobj import populate_array
from numba.np.numpy_support import from_dtype

from cathsim_dmc import compiled_cache, compiled_parts

# Compiled code calls intrinsics without their first argument.
_intrinsic: Any = intrinsic
_typed: Any = intrinsic(prefer_literal=True)

COUNT = 1 << 40  # length of arrays of unknown length; not checked
# NumPy types of scalars; all types not listed are enumerations.
_KINDS = {"mjtNum": "f8", "float": "f4", "mjtBool": "i1", "mjtByte": "i1"}
_KINDS |= dict.fromkeys(("mjtSize", "size_t", "uint64_t", "uintptr_t"), "i8")
# A model in which no array that callbacks may read is empty.
_PROBE = """
<mujoco>
  <size nuserdata="2" nuser_geom="3" nuser_body="2" nuser_jnt="2" nkey="1"/>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 0.9">
      <joint name="hinge"/>
      <joint type="slide" axis="0 0 1"/>
      <geom size="1"/>
      <site name="site"/>
    </body>
  </worldbody>
  <actuator><general joint="hinge" dyntype="integrator"/></actuator>
  <sensor><jointpos joint="hinge"/></sensor>
  <custom><numeric name="numeric" data="1 2"/></custom>
</mujoco>
"""


@functools.cache
def layout(struct: str) -> Any:
    """NumPy dtype of a struct of MuJoCo, such as "mjData", in C layout."""
    from mujoco.introspect import ast_nodes, structs

    def kind(of) -> np.dtype:
        if isinstance(of, ast_nodes.PointerType):
            return np.dtype("i8")
        if isinstance(of, ast_nodes.ArrayType):
            return np.dtype((kind(of.inner_type), of.extents))
        if isinstance(of, ast_nodes.AnonymousStructDecl):
            return whole(of)
        if of.name in structs.STRUCTS:
            return layout(of.name)
        return np.dtype(_KINDS.get(of.name, "i4"))

    def whole(of) -> np.dtype:
        return np.dtype(
            [(each.name, kind(each.type)) for each in of.fields], align=True
        )

    return whole(structs.STRUCTS[struct])


@functools.cache
def _probe() -> dict[str, tuple[Any, int]]:
    """A sample of each struct and its address."""
    model = mujoco.MjModel.from_xml_string(_PROBE)
    data = mujoco.MjData(model)
    data.time = 0.5
    mujoco.mj_forward(model, data)
    first = layout("mjData").fields["contact"][1]
    contact = ctypes.c_int64.from_address(data._address + first).value
    return {
        "mjModel": (model, model._address),
        "mjData": (data, data._address),
        "mjContact": (data.contact, contact),
    }


def field(struct: str, name: str) -> tuple[int, Any, Any]:
    """Offset of a field of a struct, verified against MuJoCo's Python bindings.

    Args:
        struct: "mjModel", "mjData" or "mjContact".
        name: An array, a size or a number; "opt.timestep" is one of `mjOption`.

    Returns:
        Offset in bytes, type of the field, and its value in a sample of the struct.

    Raises:
        RuntimeError: if the offset in MuJoCo's description is wrong, or cannot be
            verified.
    """
    owner, address = _probe()[struct]
    place, kind = 0, layout(struct)
    try:
        for part in name.split("."):
            kind, offset = kind.fields[part][:2]
            place += offset
        known = operator.attrgetter(name)(owner)
        if struct == "mjContact":  # contains its arrays, without pointers
            proved = known.ctypes.data == address + place
            proved &= known.strides[0] == layout(struct).itemsize
        else:
            pointer = isinstance(known, np.ndarray)
            value = (known.ctypes.data if known.size else 0) if pointer else known
            held = ctypes.string_at(address + place, kind.itemsize)
            proved = bool(value) and held == np.array(value, kind).tobytes()
    except (AttributeError, KeyError, TypeError):
        proved = False
    if not proved:
        raise RuntimeError(
            f"{struct}.{name} of MuJoCo {mujoco.__version__} has another offset than "
            "documented; install a version that pyproject.toml allows"
        )
    return place, kind, known


def _load(builder, place, kind):
    """Loads the value at an address."""
    return builder.load(builder.inttoptr(place, kind.as_pointer()))


def _array_at(context, builder, kind, place, shape):
    """Array of a type and shape at an address, without ownership."""
    data = builder.inttoptr(place, context.get_data_type(kind.dtype).as_pointer())
    size = context.get_abi_sizeof(context.get_data_type(kind.dtype))
    numbers = [size * math.prod(shape[axis + 1 :]) for axis in range(len(shape))]
    extent, strides, size = (
        [context.get_constant(types.intp, number) for number in row]
        for row in (shape, numbers, [size])
    )
    array = context.make_array(kind)(context, builder)
    populate_array(array, data, extent, strides, size[0], meminfo=None)
    return array._getvalue()  # noqa: SLF001


def _reader(struct: str) -> Any:
    @_typed
    def read(_, address, name):
        """Field of the struct at an address, a number or an array, by a literal name.

        An array (COUNT,) or (COUNT, n) is a view, and its bounds are not checked.
        """
        if not isinstance(name, types.StringLiteral):
            return None
        place, held, known = field(struct, name.literal_value)
        shape, inside = (), struct == "mjContact"
        if isinstance(known, np.ndarray):
            held, shape = known.dtype, known.shape[1:]
            # The widths of user fields depend on the model.
            wide = () if name.literal_value.endswith("_user") else shape
            shape = shape or (1,) if inside else (COUNT, *wide)
        kind = from_dtype(held)
        kind = types.Array(kind, len(shape), "C") if shape else kind

        def generate(context, builder, signature, arguments):
            there = builder.add(arguments[0], ir.Constant(ir.IntType(64), place))
            if shape and not inside:
                there = _load(builder, there, ir.IntType(64))
            if not shape:
                return _load(builder, there, context.get_data_type(kind))
            return _array_at(context, builder, kind, there, shape)

        return kind(address, name), generate

    return read


model_field = _reader("mjModel")
data_field = _reader("mjData")
contact_field = _reader("mjContact")


def contact_at(data, number):
    """Address of a contact in the `mjData` at an address."""


@overload(contact_at)
def _contact_at(data, number):
    place = layout("mjData").fields["contact"][1]
    size = layout("mjContact").itemsize
    return lambda data, number: word(data + place) + number * size


def symbol(name: str, count: int) -> np.ndarray:
    """Zeros (count,) of int64, whose address compiled code gets from `address_of`."""
    array = np.zeros(count, np.int64)
    llvm.add_symbol(name, array.ctypes.data)
    return array


@_intrinsic
def address_of(_, name):
    """Address (int64) of the array of `symbol` with a name, a literal."""
    if not isinstance(name, types.StringLiteral):
        return None

    def generate(context, builder, signature, arguments):
        whole = ir.IntType(64)
        known = builder.module.globals.get(name.literal_value)
        place = known or ir.GlobalVariable(builder.module, whole, name.literal_value)
        return builder.ptrtoint(place, whole)

    return types.int64(name), generate


@_intrinsic
def word(_, address):
    """The int64 at an address: a size, or the address of an array."""

    def generate(context, builder, signature, arguments):
        return _load(builder, arguments[0], ir.IntType(64))

    return types.int64(types.int64), generate


@_intrinsic
def fused(_, one, other, more):
    """Fused multiply-add one * other + more, with which NumPy sums squares."""

    def generate(context, builder, signature, arguments):
        return builder.fma(arguments[0], arguments[1], arguments[2])

    return types.float64(types.float64, types.float64, types.float64), generate


def _array(kind: Any) -> Any:
    @_intrinsic
    def array(_, address):
        """Array (COUNT,) at an address, without ownership."""
        array = types.Array(kind, 1, "C")

        def generate(context, builder, signature, arguments):
            return _array_at(context, builder, array, arguments[0], (COUNT,))

        return array(types.int64), generate

    return array


numbers, wholes, shorts = map(_array, (types.float64, types.int32, types.int16))
longs = _array(types.int64)


@_typed
def stacked(_, rows, columns):
    """Scratch (rows, columns) of float64 on the stack of the calling function.

    Both sizes are literals. The array is not initialised.
    """
    sizes = rows, columns
    if not all(isinstance(size, types.IntegerLiteral) for size in sizes):
        return None
    shape = tuple(size.literal_value for size in sizes)
    kind = types.Array(types.float64, 2, "C")

    def generate(context, builder, signature, arguments):
        room = ir.ArrayType(ir.DoubleType(), math.prod(shape))
        place = cgutils.alloca_once(builder, room)
        address = builder.ptrtoint(place, ir.IntType(64))
        return _array_at(context, builder, kind, address, shape)

    return kind(rows, columns), generate


def _call(builder, values, result, variadic=False):
    """Calls the function at the address `values[0]` with the other values."""
    kinds = [value.type for value in values[1:]]
    kind = ir.FunctionType(result, kinds[:1] if variadic else kinds, var_arg=variadic)
    place = builder.inttoptr(values[0], kind.as_pointer())
    return builder.call(place, values[1:])


@_intrinsic
def call_collision(_, address, model, data, contacts, geom1, geom2, margin):
    """Calls a function of MuJoCo's collision table; returns the number of contacts."""

    def generate(context, builder, signature, values):
        return _call(builder, values, ir.IntType(32))

    places = [types.int64] * 4
    return types.int32(*places, types.int32, types.int32, types.float64), generate


@_intrinsic
def call_callback(_, address, model, data):
    """Calls one of MuJoCo's callbacks on a model and its data, given by addresses."""

    def generate(context, builder, signature, values):
        _call(builder, values, ir.VoidType())
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), generate


@_intrinsic
def call_law(_, address, model, data, layout, start):
    """Calls an adapter at an address, see `physics.adapters`."""

    def generate(context, builder, signature, values):
        _call(builder, values, ir.VoidType())
        return context.get_dummy_value()

    return types.void(*[types.int64] * 5), generate


@_intrinsic
def call_error(_, address, text, number):
    """Calls `mju_error` with the text at an address, and an int32 for its %d."""

    def generate(context, builder, signature, values):
        _call(builder, values, ir.VoidType(), variadic=True)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int32), generate


@register_jitable
def call_before(table, model, data):
    """Calls the callback whose address is at `table`, if any (`physics.dispatcher`)."""
    before = word(table)
    if before != 0:
        call_callback(before, model, data)


class NotCompiledError(ValueError):
    """A function cannot be compiled; the message is numba's, in one line."""


class Callback:
    """A function that C calls, compiled when its address is first requested.

    Attributes:
        left_out: Whether it is not compiled in this process; its address is 0 then.
    """

    left_out = False

    def __init__(self, function: Callable, signature: str, cache: bool):
        self._function, self._signature, self._cache = function, signature, cache

    @functools.cached_property
    def made(self) -> CFunc:
        """The compiled function; raises NotCompiledError."""
        options = {"nopython": True, "error_model": "numpy"}
        kinds = sigutils.normalize_signature(self._signature)
        own = compiled_parts.PackageCompiler
        made = CFunc(self._function, kinds, {}, options, pipeline_class=own)
        if self._cache:
            compiled_cache.keep(made, self._function)
        try:
            made.compile()
        except NumbaError as error:
            text = re.sub(r"\x1b\[[0-9;]*m", "", str(error))
            text = re.sub(r"Failed in nopython mode pipeline \(.*\)", "", text)
            raise NotCompiledError(" ".join(text.split())) from error
        return made

    @property
    def address(self) -> int:
        """Address of the compiled function; 0 for none."""
        return 0 if self.left_out else int(self.made.address or 0)

    @property
    def ctypes(self) -> Any:
        """The function for ctypes."""
        return self.made.ctypes


def callback(signature: str, cache: bool = True) -> Callable[[Callable], Callback]:
    """Decorator of a function that C calls, compiled once on each machine if cached.

    Args:
        signature: numba's, such as "void(int64, int64)"; a pointer is an int64.
        cache: Whether the compiled function is kept on disk.
    """
    return lambda function: Callback(function, signature, cache)
