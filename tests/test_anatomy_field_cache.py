"""The cache of fields: found by content, whole or not at all."""

import copy
from pathlib import Path

import numpy as np
import pytest

from cathsim_dmc.anatomy import field_cache, phantoms
from cathsim_dmc.anatomy.builder import ACCESSES
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.field import Field
from cathsim_dmc.anatomy.parts import End

MEND = "run tools/ship_fields.py"
SECOND = ("bovine", "descending")  # of the fields in its file
UP = np.array([0.0, 0.0, 1.0])


def tube(radius=4e-3):
    points = np.linspace(0.0, 20e-3, 11)[:, None] * UP
    line = Centreline(points, np.full(11, radius))
    return VesselTree({"root": Vessel("root", line)})


@pytest.fixture
def folder(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "cathsim_dmc" / "fields"


@pytest.fixture
def built(monkeypatch, folder):
    """Counts the fields that are built; they stand for any."""
    done = []
    one = Field(np.full(9, 7.5), np.zeros(8, np.int16), *np.zeros((2, 1), np.int32))

    def fake(*content):
        done.append(content)
        return one

    monkeypatch.setattr(Field, "of", fake)
    return done


def test_a_cached_field_lies_in_its_file(folder):
    ends = [End("root", np.zeros(3), -UP, 4e-3, True)]
    fields = [field_cache.field_of(tube(), ends) for _ in range(2)]
    points = np.random.default_rng(0).uniform(-5e-3, 5e-3, (50, 3))
    built = Field.of(tube(), ends)
    for field in fields:
        assert built.pages is None and field.pages is not None
        assert np.shares_memory(field.samples, field.pages)
        with_hole, copied = field.with_hole(1e-3), copy.deepcopy(field)
        field.release(), copied.release()
        np.testing.assert_array_equal(copied(points), built(points))
        np.testing.assert_array_equal(field(points), built(points))
        assert with_hole.digest == built.with_hole(1e-3).digest != field.digest


def test_a_user_without_a_home_keeps_no_fields(built, monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(field_cache.Path, "home", lambda: Path("~none").expanduser())
    for _ in range(2):
        assert field_cache.field_of(tube()).pages is None
    assert len(built) == 2


@pytest.mark.parametrize("access", ACCESSES)
@pytest.mark.parametrize("name", phantoms.PHANTOMS)
def test_fields_of_the_phantoms_come_with_the_package(name, access, folder, built):
    anatomy = phantoms.load(name, access=access)
    field = field_cache.field_of(anatomy.tree, anatomy.ends)
    assert not built, MEND
    assert field.pages is not None and field.nbytes > 2e6


@pytest.mark.parametrize(
    ("name", "access"),
    [pytest.param("type2", "ascending", marks=pytest.mark.slow), SECOND],
)
def test_a_field_that_ships_is_the_one_that_would_be_built(name, access, folder):
    anatomy = phantoms.load(name, access=access)
    shipped = field_cache.field_of(anatomy.tree, anatomy.ends)
    built = Field.of(anatomy.tree, anatomy.ends)
    for one, other in zip(shipped.arrays, built.arrays, strict=True):
        # Processors round differently, and a depth is a whole number.
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1, err_msg=MEND)


def test_lumen_and_ends_count(built):
    end = End("root", np.zeros(3), -UP, 4e-3, True)
    for radius in (4e-3, 5e-3):
        for ends in ((), (end,)):
            for _ in range(2):
                field_cache.field_of(tube(radius), ends)
    assert len(built) == 4


def test_a_damaged_field_is_built_again(built, folder):
    field_cache.field_of(tube())
    (path,) = folder.iterdir()
    data = path.read_bytes()
    path.write_bytes(data[:-200])
    field_cache.field_of(tube())
    path.write_bytes(data.replace(np.float64(7.5).tobytes(), b"x" * 8, 1))
    field_cache.field_of(tube())
    field_cache.field_of(tube())
    assert len(built) == 3


def test_the_folder_stays_within_its_bound(built, folder, monkeypatch):
    field_cache.field_of(tube())
    (path,) = folder.iterdir()
    monkeypatch.setattr(field_cache, "KEPT", 2.5 * path.stat().st_size)
    for number in range(5, 9):
        field_cache.field_of(tube(1e-3 * number))
    assert len(list(folder.iterdir())) == 2


def test_a_folder_that_cannot_be_written_to_keeps_nothing(built, folder):
    folder.parent.write_text("a file")
    field_cache.field_of(tube())
    field_cache.field_of(tube())
    assert len(built) == 2
