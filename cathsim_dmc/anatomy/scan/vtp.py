"""Triangles of a VTK PolyData file (.vtp), without VTK.

XML with arrays as text, base64 or appended bytes, plain or compressed with zlib or
lzma: what ParaView, 3D Slicer and VMTK write. Format: VTK file formats, section "XML
file formats", https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html
"""

from __future__ import annotations

import base64
import lzma
import re
import zlib
from collections.abc import Callable
from xml.etree import ElementTree

import numpy as np

_TYPES = {
    "Float32": "f4",
    "Float64": "f8",
    "Int32": "i4",
    "UInt32": "u4",
    "Int64": "i8",
    "UInt64": "u8",
    "Int8": "i1",
    "UInt8": "u1",
    "Int16": "i2",
    "UInt16": "u2",
}
_APPENDED = re.compile(rb"<AppendedData[^>]*>\s*_")
_MOST = 2**31  # bytes of one array; larger ones are no vessel's


def read_vtp(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a file's polygons and strips; other cells are left out.

    Args:
        data: the whole file.

    Returns:
        (vertices (V, 3) float64 in the file's unit, faces (F, 3) int64). Polygons of
        more than three corners become fans.

    Raises:
        ValueError: if the file is none or is damaged.
    """
    if b"<!DOCTYPE" in data[:4096] or b"<!ENTITY" in data:
        raise ValueError("it declares XML entities, which no VTK file does")
    appended, raw = b"", False
    start = _APPENDED.search(data)
    if start:
        end = data.rindex(b"</AppendedData>")
        raw = b'"raw"' in start.group() or b"'raw'" in start.group()
        appended = data[start.end() : end]
        data = data[: start.end() - 1] + data[end:]
    try:
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise ValueError(f"its XML is damaged: {error}") from error
    if root.tag != "VTKFile" or root.get("type") != "PolyData":
        raise ValueError(f"it holds {root.get('type', root.tag)!r}, not PolyData")
    read = _array_reader(root, appended, raw)
    vertices, faces, count = [], [], 0
    for piece in root.iter("Piece"):
        array = piece.find("Points/DataArray")
        if array is None:
            continue
        points = read(array).astype(np.float64).reshape(-1, 3)
        vertices.append(points)
        for kind, split in (("Polys", _fans), ("Strips", _strips)):
            arrays = {e.get("Name"): e for e in piece.findall(f"{kind}/DataArray")}
            if {"connectivity", "offsets"} <= set(arrays):
                corners = read(arrays["connectivity"]).astype(np.int64)
                stops = read(arrays["offsets"]).astype(np.int64)
                if len(stops) and (stops[-1] != len(corners) or stops.min() < 0):
                    raise ValueError("its offsets do not fit its connectivity")
                if len(corners) and not 0 <= corners.min() <= corners.max() < len(
                    points
                ):
                    raise ValueError(f"its cells name points beyond {len(points)}")
                faces.append(split(corners, stops) + count)
        count += len(points)
    if not vertices:
        raise ValueError("it has no points")
    empty = np.empty((0, 3), dtype=np.int64)
    return np.concatenate(vertices), np.concatenate([empty, *faces])


def _fans(corners: np.ndarray, stops: np.ndarray) -> np.ndarray:
    starts = np.concatenate([[0], stops[:-1]]).astype(np.int64)
    sizes = stops - starts
    faces = []
    for size in np.unique(sizes[sizes >= 3]):
        rows = corners[starts[sizes == size][:, None] + np.arange(size)]
        for k in range(1, size - 1):
            faces.append(rows[:, [0, k, k + 1]])
    return np.concatenate(faces) if faces else np.empty((0, 3), dtype=np.int64)


def _strips(corners: np.ndarray, stops: np.ndarray) -> np.ndarray:
    faces, start = [np.empty((0, 3), dtype=np.int64)], 0
    for stop in stops:
        strip = corners[start:stop]
        if len(strip) >= 3:
            three = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1)
            three[1::2] = three[1::2, ::-1]  # every other triangle is turned
            faces.append(three)
        start = stop
    return np.concatenate(faces)


def _array_reader(
    root: ElementTree.Element, appended: bytes, raw: bool
) -> Callable[[ElementTree.Element], np.ndarray]:
    """A function that reads the values of a DataArray."""
    order = ">" if root.get("byte_order") == "BigEndian" else "<"
    header = np.dtype(order + _TYPES[root.get("header_type", "UInt32")])
    compressor = root.get("compressor", "")
    unpack = {
        "": None,
        "vtkZLibDataCompressor": lambda block, size: zlib.decompressobj().decompress(
            block, size
        ),
        "vtkLZMADataCompressor": lambda block, size: lzma.LZMADecompressor().decompress(
            block, size
        ),
    }.get(compressor, False)
    if unpack is False:
        raise ValueError(
            f"it is compressed with {compressor}; save it uncompressed or with zlib"
        )

    def sized(block: bytes, size: int) -> bytes:
        values = unpack(block, size)
        if len(values) != size:
            raise ValueError("a compressed block is damaged")
        return values

    def unwrap(fetch: Callable[..., bytes]) -> bytes:
        """Bytes of an array; ``fetch`` gives decoded bytes from a place on."""
        wide = header.itemsize
        if unpack is None:
            size = int(np.frombuffer(fetch(0, wide), header)[0])
            if size > _MOST:
                raise ValueError("an array is larger than 2 GB")
            return fetch(wide, size)
        count, full, last = np.frombuffer(fetch(0, 3 * wide), header).astype(int)
        if not 0 <= count * max(full, 1) <= _MOST:
            raise ValueError("an array is larger than 2 GB")
        packed = np.frombuffer(fetch(3 * wide, count * wide), header).astype(int)
        data = fetch((3 + count) * wide, int(packed.sum()), after=True)
        stops = np.concatenate([[0], np.cumsum(packed)])
        sizes = [full] * count
        if count and last:
            sizes[-1] = last
        return b"".join(
            sized(data[a:b], int(size))
            for a, b, size in zip(stops[:-1], stops[1:], sizes, strict=True)
        )

    def read(array: ElementTree.Element) -> np.ndarray:
        kind = array.get("type", "")
        if kind not in _TYPES:
            raise ValueError(f"an array is of type {kind!r}")
        dtype = np.dtype(order + _TYPES[kind])
        how = array.get("format", "ascii")
        try:
            if how == "ascii":
                text = (array.text or "").split()
                return np.array(text, dtype=np.float64).astype(_TYPES[kind])
            if how == "appended" and raw:
                start = int(array.get("offset", "0"))
                data = unwrap(_raw(appended, start))
            else:
                text = (array.text or "").strip().encode()
                if how == "appended":
                    text = appended[int(array.get("offset", "0")) :]
                data = unwrap(_base64(text, unpack is not None, header.itemsize))
            return np.frombuffer(data, dtype)
        except (zlib.error, lzma.LZMAError, IndexError, TypeError) as error:
            raise ValueError(f"an array is damaged: {error}") from error

    return read


def _raw(data: bytes, start: int) -> Callable[..., bytes]:
    def fetch(at: int, size: int, after: bool = False) -> bytes:
        part = data[start + at : start + at + size]
        if len(part) != size:
            raise ValueError("it is cut off")
        return part

    return fetch


def _base64(text: bytes, compressed: bool, wide: int) -> Callable[..., bytes]:
    """Decoded bytes; a compressed array's header is encoded apart from its blocks."""

    def decoded(begin: int, size: int) -> bytes:
        length = 4 * -(-size // 3)
        part = base64.b64decode(text[begin : begin + length])
        if len(part) < size:
            raise ValueError("it is cut off")
        return part

    def fetch(at: int, size: int, after: bool = False) -> bytes:
        if not after:
            return decoded(0, at + size)[at : at + size]
        return decoded(4 * -(-at // 3), size)

    return fetch
