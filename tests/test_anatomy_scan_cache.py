"""The cache of imports: found by content, whole or not at all."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys

import numpy as np
import pytest

from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.anatomy.scan import cache


@pytest.fixture
def imports(monkeypatch):
    """Counts imports, which are replaced: the cache is what is tested."""
    done = []

    def fake(mesh, curves=(), *, progress=None, notes=None, **options):
        done.append(options)
        notes.append("unit guessed: mm")
        return arch.load("simple1")

    monkeypatch.setattr(cache, "import_scan", fake)
    return done


@pytest.fixture
def mesh(tmp_path):
    path = tmp_path / "lumen.obj"
    path.write_text("v 0 0 0\n")
    return path


def test_the_second_import_is_read(imports, mesh, tmp_path):
    lines, notes = [], []
    kept = {"folder": tmp_path / "cache", "progress": lines.append, "notes": notes}
    first = cache.cached_import(mesh, units="mm", **kept)
    again = cache.cached_import(mesh, units="mm", **kept)
    assert len(imports) == 1 and notes == ["unit guessed: mm"] * 2
    assert any("from the cache" in line for line in lines)
    np.testing.assert_array_equal(first.surface.vertices, again.surface.vertices)


def test_content_options_and_names_count(imports, mesh, tmp_path):
    folder = tmp_path / "cache"
    cache.cached_import(mesh, folder=folder)
    cache.cached_import(mesh, folder=folder, units="cm")
    curve = tmp_path / "lcca.csv"
    curve.write_text("0,0,0\n")
    cache.cached_import(mesh, [curve], folder=folder)
    curve.rename(tmp_path / "lva.csv")
    cache.cached_import(mesh, [tmp_path / "lva.csv"], folder=folder)
    mesh.write_text("v 0 0 1\n")
    cache.cached_import(mesh, folder=folder)
    assert len(imports) == 5


def test_a_damaged_entry_is_imported_again(imports, mesh, tmp_path):
    folder = tmp_path / "cache"
    cache.cached_import(mesh, folder=folder)
    (entry,) = folder.iterdir()
    geometry = next(entry.glob("geometry-*"))
    geometry.write_bytes(geometry.read_bytes()[:100])
    cache.cached_import(mesh, folder=folder)
    cache.cached_import(mesh, folder=folder)
    assert len(imports) == 2


def test_old_entries_go_and_nothing_half_written_stays(
    imports, mesh, tmp_path, monkeypatch
):
    monkeypatch.setattr(cache, "KEPT", 2)
    folder = tmp_path / "cache"
    for number in range(4):
        mesh.write_text(f"v 0 0 {number}\n")
        cache.cached_import(mesh, folder=folder)
    assert len(list(folder.iterdir())) == 2


KILLED = """
import os, signal, sys
from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.anatomy.scan import cache

def fake(mesh, curves=(), *, progress=None, notes=None, **options):
    return arch.load("simple1")

cache.import_scan = fake
cache.Anatomy.save = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
cache.cached_import(sys.argv[1], folder=sys.argv[2])
"""


def test_what_a_killed_import_leaves_goes_with_the_next_one(imports, mesh, tmp_path):
    folder = tmp_path / "cache"
    died = subprocess.run([sys.executable, "-c", KILLED, str(mesh), str(folder)])
    assert died.returncode == -signal.SIGKILL
    assert all(path.name.startswith(".") for path in folder.iterdir())
    assert len(list(folder.iterdir())) == 2
    mesh.write_text("v 0 0 1\n")
    cache.cached_import(mesh, folder=folder)
    (entry,) = folder.iterdir()
    # Nor is it the owner's alone, as the folders of tempfile are.
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE(entry.stat().st_mode) == 0o777 & ~mask


def test_a_cache_that_cannot_be_written_is_said(imports, mesh, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    lines = []
    cache.cached_import(mesh, folder=blocked / "cache", progress=lines.append)
    assert len(imports) == 1 and any("not kept in the cache" in line for line in lines)
