"""Where MuJoCo's fields lie in memory, and what compiled callbacks read there."""

import ctypes

import mujoco
import numpy as np
import pytest

from cathsim_dmc.collision import native

XML = """
<mujoco>
  <size nuser_geom="2" nuserdata="3"/>
  <worldbody>
    <geom size="1" user="3 4"/>
    <body><freejoint/><geom name="b" size="1" user="5 6"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def scene():
    model = mujoco.MjModel.from_xml_string(XML)
    return model, mujoco.MjData(model)


@pytest.mark.parametrize(
    "name", ["no_such_field", "energy", "opt.no_such_option", "ncon.x"]
)
def test_a_field_without_proof_is_refused(name):
    with pytest.raises(RuntimeError, match=rf"mjData\.{name} of MuJoCo .*pyproject"):
        native.field("mjData", name)


def test_another_layout_is_refused(monkeypatch):
    moved = np.dtype([("more", "i8"), *native.layout("mjModel").descr])
    monkeypatch.setattr(native, "layout", lambda struct: moved)
    with pytest.raises(RuntimeError, match="geom_user of MuJoCo"):
        native.field("mjModel", "geom_user")


def test_a_callback_reads_fields_and_what_a_symbol_names(scene):
    table = native.symbol("cathsim_test_table", 1)
    table[0] = 1
    word, address_of = native.word, native.address_of
    model_field, data_field = native.model_field, native.data_field

    def read(model, data, geom):
        stride, number = model_field(model, "nuser_geom"), 0.0
        number += model_field(model, "geom_user")[stride * geom + 1]
        number += 10 * model_field(model, "opt.timestep")
        number += 100 * model_field(model, "geom_size")[geom, 0]
        number += 1e3 * model_field(model, "body_parentid")[geom]
        number += 1e4 * data_field(data, "time")
        return number + word(address_of("cathsim_test_table"))

    compiled = native.callback("float64(int64, int64, int32)", cache=False)(read)
    numbers = (ctypes.c_int64, ctypes.c_int64, ctypes.c_int32)
    function = ctypes.CFUNCTYPE(ctypes.c_double, *numbers)(compiled.address)
    model, data = scene
    data.time, model.geom_user[1, 1] = 0.25, 7.5
    found = [function(model._address, data._address, geom) for geom in (0, 1)]
    expected = 10 * model.opt.timestep + 100 + 2500 + 1
    np.testing.assert_allclose(found, [4.0 + expected, 7.5 + expected])
