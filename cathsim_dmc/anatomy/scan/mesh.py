"""Reader of a lumen's triangles from a mesh file."""

import codecs
import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import extras
from cathsim_dmc.anatomy.scan import ply_files, vtk_files

LABEL_MAPS = (".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd")
# What to do with files of other kinds.
_OTHERS = {
    "gz": "unpack it first",
    "zip": "unpack it first",
    "dcm": "that is an image: segment its lumen first (3D Slicer, TotalSegmentator)",
    "vtu": "extract its surface first (ParaView: Extract Surface)",
}
# Endings, and the least bytes that a triangle takes where no header counts them.
FORMATS = {"obj": 35, "stl": 50, "ply": 12, "vtp": 12, "vtk": 12}
_STL_TEXT = 100  # seven lines
_BEHIND = 4096  # bytes that may follow the last triangle of a binary STL
_SAID = 300  # characters of the message of a reader, at most
_COMMENTS = 4096  # bytes at the start of a file with its frame, or at its end
MOST = 4_000_000  # triangles; reading more takes gigabytes


def parsed(path: Path, kind: str, read: Callable[[Path], Any], extra: str) -> Any:
    """Result of `read(path)`; errors become one line that says what to do."""
    if path.is_dir():
        raise ValueError(
            f"{path} is a directory; give one file: a lumen's surface (STL, OBJ, PLY, "
            "VTP or VTK) or a label map (NIfTI, NRRD, MHA), which 3D Slicer makes of "
            "a series of DICOM images."
        )
    if not path.is_file():
        raise FileNotFoundError(
            f"no mesh file {path}; give a lumen's surface (STL, OBJ, PLY, VTP or VTK), "
            "or a label map (NIfTI, NRRD, MHA)."
        )
    if not path.stat().st_size:
        raise ValueError(f"{path} is empty (0 bytes); export it again.")
    try:
        return read(path)
    except ImportError as error:
        raise ValueError(
            f"{path} needs {error.name}: {extras.adding(extra)}."
        ) from error
    except Exception as error:  # readers raise errors of any kind
        said = re.sub(r"\s+", " ", str(error)).strip()[:_SAID] or type(error).__name__
        raise ValueError(
            f"{path} cannot be read as {kind.upper()}: {said}. Export it again."
        ) from error


def read_triangles(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 in the file's unit and faces (F, 3) int64, unmended.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the format is unknown, the file is empty, damaged, holds no
            triangles or far too many; the message is one line.
    """
    path = Path(path)
    kind = path.suffix.lower().lstrip(".")
    if kind not in FORMATS and not path.is_dir():
        hint = _OTHERS.get(kind, "convert it (3D Slicer, MeshLab, ParaView)")
        raise ValueError(
            f"{path} has the ending {path.suffix!r}; give a mesh in one of the formats "
            f"{', '.join(FORMATS)}, or a label map in one of "
            f"{', '.join(ending[1:] for ending in LABEL_MAPS)}: {hint}."
        )
    count = parsed(path, kind, _announced, "")
    if count > MOST:
        raise ValueError(
            f"{path} has some {count / 1e6:.1f} million triangles; at most "
            f"{MOST / 1e6:g} million are read. Decimate it before export (3D Slicer: "
            "Surface Toolbox, Decimate)."
        )
    parsed(path, kind, _require_end, "")
    read = vtk_files.triangles if kind in ("vtp", "vtk") else _read_mesh
    vertices, faces = parsed(path, kind, read, "vtp")
    if len(faces) < 4:
        raise ValueError(
            f"{path} has {len(faces)} triangles; give a triangle mesh of the lumen "
            "(points and volumes are none, and lines are centrelines: --centreline), "
            "named after its format."
        )
    # Points of no triangle are dropped: they would change the size.
    used, corners = np.unique(faces, return_inverse=True)
    if used[0] < 0 or used[-1] >= len(vertices):
        raise ValueError(
            f"{path} has triangles that name points which it does not have; export it "
            "again."
        )
    vertices, faces = vertices[used], corners.reshape(-1, 3)
    bad = int((~np.isfinite(vertices).all(axis=1)).sum())
    if bad:
        raise ValueError(
            f"{path} has {bad} vertices whose coordinates are NaN or infinite; export "
            "it again."
        )
    return vertices, faces


def stated_frame(path: str | Path) -> str | None:
    """Frame that a mesh file names, as those of 3D Slicer do: "LPS", "RAS" or None."""
    path = Path(path)
    kind = path.suffix.lower().lstrip(".")
    with path.open("rb") as stream:
        head = stream.read(-1 if kind == "vtp" else _COMMENTS)
    if kind == "vtp":
        named = b'"SPACE"' in head
        said = parsed(path, kind, vtk_files.space, "vtp") if named else ""
    else:
        said = head[:80] if kind == "stl" else re.split(rb"[\r\n]end_header", head)[0]
        lines = said.decode("latin-1").splitlines()
        # A comment of OBJ or PLY, the title of VTK's old files.
        starts = {"obj": "#", "ply": "comment", "vtk": "", "stl": ""}[kind]
        lines = lines[1:2] if kind == "vtk" else lines
        said = "\n".join(line for line in lines if line.startswith(starts))
    found = re.search(r"(?i)\bSPACE=(LPS|RAS)\b", said)
    return found[1].upper() if found else None


def _require_end(path: Path) -> None:
    """ValueError if a text file is truncated."""
    kind = path.suffix.lower().lstrip(".")
    with path.open("rb") as stream:
        head = stream.read(_COMMENTS)
    if kind == "obj":
        _require_obj_end(path)
    elif kind == "ply" and re.search(rb"[\r\n]format ascii", head):
        _require_ply_end(path.read_bytes())


def _tail(path: Path) -> bytes:
    """The last bytes of a file."""
    with path.open("rb") as stream:
        stream.seek(max(path.stat().st_size - _COMMENTS, 0))
        return stream.read()


def _require_obj_end(path: Path) -> None:
    last = re.split(rb"[\r\n]", _tail(path))[-1]
    if last.startswith(b"#") or not last.strip(b"\0 "):
        return
    data = _uncommented(_with_line_feeds(path.read_bytes()))
    # Some programs omit the last line break; a complete file uses all of its points.
    rows = re.findall(rb"(?m)^f[ \t]+(.*)$", data)
    used = {corner.split(b"/")[0] for row in rows for corner in row.split()}
    points = len(re.findall(rb"(?m)^v[ \t]", data))
    relative = any(corner.startswith(b"-") for corner in used)  # to the last point
    if len(used) < points and not relative:
        raise ValueError(
            f"it ends early, in {last[:40].decode('latin-1')!r}: of {points:,} points "
            f"{points - len(used):,} belong to no triangle"
        )


def _require_ply_end(data: bytes) -> None:
    header, start = ply_files.header(data)
    body = data[start:]
    counts = re.findall(rb"(?m)^element (\w+) (\d+)", header)
    whole = sum(int(count) for _, count in counts)
    rows = [row.split() for row in body.splitlines() if row.strip()]
    held = len(rows)
    faces = header.rpartition(b"element ")[2]  # the last element: mostly the faces
    last = re.match(rb"face \d+\s+property list", faces)
    if rows and last and len(rows[-1]) <= int(rows[-1][0]):
        held -= 1  # its last row lacks a corner
    if held < whole:
        raise ValueError(
            f"it ends early, after {held:,} of {whole:,} points and triangles"
        )


def _require_stl_end(path: Path) -> None:
    last = re.split(rb"[\r\n]", _tail(path).strip(b"\0 \r\n\t"))[-1].strip()
    if not last.lower().startswith(b"endsolid"):
        raise ValueError(
            f"it ends early, without 'endsolid', in {last[:40].decode('latin-1')!r}"
        )


def _announced(path: Path) -> int:
    """Number of triangles that a file announces, or the most that fit in its size."""
    kind = path.suffix.lower().lstrip(".")
    with path.open("rb") as stream:
        # The counts of a VTP file may stand anywhere in it.
        head = stream.read(-1 if kind == "vtp" else 4096)
    faces = re.findall(rb'element face (\d+)|NumberOf(?:Polys|Strips)="\s*(\d+)', head)
    corners = re.findall(rb'element vertex (\d+)|NumberOfPoints="\s*(\d+)', head)
    if faces or corners:
        count, points = (sum(int(a or b) for a, b in one) for one in (faces, corners))
        return max(count, points // 3)  # where no two triangles share a vertex
    size = path.stat().st_size
    if kind != "stl":
        return size // FORMATS[kind]
    whole, held = int.from_bytes(head[80:84], "little"), max(size - 84, 0) // 50
    if size == 84 + 50 * whole:
        return whole
    if re.match(rb"(?i)\W*solid", head) and b"\0" not in head:
        _require_stl_end(path)
        return size // _STL_TEXT
    if b"\0" in head and held < whole <= MOST:
        raise ValueError(f"it ends early, after {held:,} of {whole:,} triangles")
    if whole and 0 < size - 84 - 50 * whole <= _BEHIND:
        return whole
    if held > MOST:
        return held
    raise ValueError(
        f"its content is no STL (it begins with {head[:20].decode('latin-1')!r}, and "
        "is not as long as a binary one says); name it after its format"
    )


def _read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    kind = path.suffix.lower().lstrip(".")
    # From bytes and without a resolver: nothing beside the file is opened.
    options = {"skip_materials": True} if kind == "obj" else {}
    data = path.read_bytes()
    if kind == "obj":
        data = _plain_obj(data)
    elif kind == "stl":  # a text file is kept whole
        data = data[: 84 + 50 * int.from_bytes(data[80:84], "little")]
        data = data if b"\0" in data[:84] else _with_line_feeds(data)
    else:
        header, start = ply_files.header(data)
        if b"\nformat binary" in header:
            return ply_files.triangles(data)
        data = header + _with_line_feeds(data[start:])
    stream = io.BytesIO(data)
    try:
        mesh = trimesh.load_mesh(stream, file_type=kind, process=False, **options)
    except Exception as error:
        if comma := re.search(rb"\d+,\d+", data):
            raise ValueError(
                f"its numbers have decimal commas ({comma[0].decode()}); set the "
                "program that writes it to decimal points"
            ) from error
        raise
    faces = np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)
    return np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3), faces


def _with_line_feeds(data: bytes) -> bytes:
    """A text whose lines end in CR alone, as on old Macs, with line feeds."""
    return data if b"\n" in data else data.replace(b"\r", b"\n")


def _uncommented(data: bytes) -> bytes:
    """An OBJ file without comments behind points and triangles."""
    if data.count(b"#") == data.startswith(b"#") + data.count(b"\n#"):
        return data  # ten times faster
    return re.sub(rb"(?m)^([ \t]*(?:v[nt]?|[flp])[ \t][^#\n]*?)[ \t]*#.*", rb"\1", data)


def _plain_obj(data: bytes) -> bytes:
    """An OBJ file with single blanks and absolute indices of its points.

    The reader knows no other white space, and no comments behind numbers or CR as the
    end of a line, and loses a point behind a byte order mark.
    It counts relative indices from the end of the file, not from the last point so far,
    and takes an index 0 as 1.
    """
    data = _uncommented(_with_line_feeds(data.removeprefix(codecs.BOM_UTF8)))
    if b"\t" in data or b"\n " in data:
        data = re.sub(rb"(?m)^ +", b"", data.replace(b"\t", b" "))
    if not re.search(rb"(?m)^f (?:.* )?(?:-|0+(?!\d))", data):
        return data
    lines, points = data.splitlines(), 0
    for row, line in enumerate(lines):
        points += line.startswith(b"v ")
        if line.startswith(b"f "):
            named = [int(corner.partition(b"/")[0]) for corner in line.split()[1:]]
            counted = [k if k >= 0 else points + 1 + k for k in named]
            if min(counted) < 1:
                raise ValueError(
                    f"a triangle names point {min(counted)}; OBJ counts from 1"
                )
            lines[row] = b"f " + b" ".join(b"%d" % k for k in counted)
    return b"\n".join(lines)


def stem(path: str | Path) -> str:
    """Name of a file without its ending, such as .stl, .nii.gz or .seg.nrrd."""
    return re.sub(r"(?i)(?<=.)(\.nii|\.seg)?\.[^.]+$", "", Path(path).name)
