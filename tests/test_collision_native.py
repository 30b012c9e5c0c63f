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
MODEL_FIELDS = ("nuser_geom", "geom_user", "geom_type", "body_parentid", "opt.timestep")
DATA_FIELDS = ("time", "qpos", "xpos", "geom_xpos", "geom_xmat", "userdata")


@pytest.fixture
def scene():
    model = mujoco.MjModel.from_xml_string(XML)
    return model, mujoco.MjData(model)


def test_offsets_lead_to_the_fields_of_any_model(scene):
    model, data = scene
    data.time = 0.25
    for owner, struct, names in (
        (model, "mjModel", MODEL_FIELDS),
        (data, "mjData", DATA_FIELDS),
    ):
        for name, place in zip(names, native.offsets(struct, names), strict=True):
            value = owner.opt.timestep if name == "opt.timestep" else None
            value = getattr(owner, name) if value is None else value
            if isinstance(value, np.ndarray):
                value = value.ctypes.data
            kind = ctypes.c_double if isinstance(value, float) else ctypes.c_int64
            assert kind.from_address(owner._address + int(place)).value == value


@pytest.mark.parametrize("name", ["no_such_field", "energy", "opt.no_such_option"])
def test_a_field_without_proof_is_refused(name):
    with pytest.raises(RuntimeError, match=rf"mjData\.{name} of MuJoCo .*pyproject"):
        native.offsets("mjData", [name])


def test_another_layout_is_refused(monkeypatch):
    moved = {name: place + 8 for name, place in native._places("mjModel").items()}
    monkeypatch.setattr(native, "_places", lambda struct: moved)
    with pytest.raises(RuntimeError, match="geom_user of MuJoCo"):
        native.offsets("mjModel", ["geom_user"])


def test_a_callback_reads_model_and_table(scene):
    """By the offsets in a table, which it knows by a symbol."""
    table = np.zeros(8, np.int64)
    native.symbol("cathsim_test_table", table)
    table[:2] = native.offsets("mjModel", ["nuser_geom", "geom_user"])
    word, numbers, address_of = native.word, native.numbers, native.address_of

    def second_number(model, geom):
        table = address_of("cathsim_test_table")
        stride = word(model + word(table))
        user = numbers(word(model + word(table + 8)), stride * (geom + 1))
        return user[stride * geom + 1]

    compiled = native.callback("float64(int64, int32)")(second_number)
    function = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_int64, ctypes.c_int32)(
        compiled.address
    )
    model, _ = scene
    assert [function(model._address, geom) for geom in (0, 1)] == [4.0, 6.0]
    model.geom_user[1, 1] = 7.5
    assert function(model._address, 1) == 7.5
