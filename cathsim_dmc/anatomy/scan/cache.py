"""Cache of imports, by the content of their files and options."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from cathsim_dmc import files
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.scan.importer import import_scan
from cathsim_dmc.anatomy.scan.mesh import read_triangles

KEPT = 16  # imports; the ones used longest ago are dropped
_NOTES = "notes.json"
_ENTRY = "scan-"


def cache_folder() -> Path:
    """Where imports are kept: ``cathsim_dmc/scans`` in the user's cache folder."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "cathsim_dmc" / "scans"


def cached_import(
    mesh_path: str | Path,
    centreline_paths: Sequence[str | Path] = (),
    *,
    folder: str | Path | None = None,
    progress: Callable[[str], None] | None = None,
    notes: list[str] | None = None,
    **options: Any,
) -> Anatomy:
    """As ``import_scan``, with a cache of earlier imports.

    An entry is found by the bytes of mesh and centrelines, their names, the options
    and this package's code, and is put in place in one step: readers find a whole one
    or none. A damaged entry is imported again.

    Args:
        mesh_path: see ``import_scan``.
        centreline_paths: see ``import_scan``.
        folder: of the cache, by default ``cache_folder()``.
        progress: see ``import_scan``.
        notes: see ``import_scan``.
        **options: of ``import_scan``.

    Raises:
        FileNotFoundError: see ``import_scan``.
        ValueError: see ``import_scan``.
    """
    folder = cache_folder() if folder is None else Path(folder)
    place = folder / f"{_ENTRY}{_key(mesh_path, centreline_paths, options)}"
    if place.is_dir():
        try:
            anatomy = Anatomy.load(place)
            said = json.loads((place / _NOTES).read_text())
        except (OSError, ValueError):
            pass  # damaged, or being dropped: import it again
        else:
            os.utime(place)
            if notes is not None:
                notes.extend(map(str, said))
            if progress is not None:
                for text in said:
                    progress(f"note: {text}")
                progress(f"done: read from the cache, {place}")
            return anatomy
    said: list[str] = []
    anatomy = import_scan(
        mesh_path, centreline_paths, progress=progress, notes=said, **options
    )
    if notes is not None:
        notes.extend(said)
    try:
        _keep(anatomy, said, place)
    except OSError as error:  # a full disk or a read-only home is no failed import
        if progress is not None:
            progress(f"note: not kept in the cache {folder}: {error}")
    return anatomy


def _key(mesh_path, centreline_paths, options) -> str:
    if not Path(mesh_path).is_file():
        read_triangles(mesh_path)  # says what is wrong
    digest = hashlib.sha256(_code())
    for path in (mesh_path, *centreline_paths):
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"no file {path}.")
        with path.open("rb") as stream:
            content = hashlib.file_digest(stream, "sha256").digest()
        digest.update(path.name.encode() + b"\0" + content)
    digest.update(json.dumps(options, sort_keys=True, default=str).encode())
    return digest.hexdigest()[:32]


def _code() -> bytes:
    """Digest of the code that an import runs through."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.digest()


def _keep(anatomy: Anatomy, notes: list[str], place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    # What a killed import has left, of whichever scan it was.
    files.remove_abandoned(place.parent)
    try:
        with files.atomic_directory(place) as temporary:
            anatomy.save(temporary)
            (temporary / _NOTES).write_text(json.dumps(notes))
            shutil.rmtree(place, ignore_errors=True)
    except OSError:
        if not place.is_dir():  # else another process was faster
            raise
    entries = sorted(
        place.parent.glob(f"{_ENTRY}*"), key=lambda path: -path.stat().st_mtime
    )
    for old in entries[KEPT:]:
        shutil.rmtree(old, ignore_errors=True)
