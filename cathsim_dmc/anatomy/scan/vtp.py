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
# Values of all arrays together: four million triangles have 24 million.
_MOST_VALUES = 32_000_000
_MOST_ELEMENTS = 10_000  # of XML; a file with 100 arrays has some 120
_MOST_DICTIONARY = 2**27  # bytes that an lzma block may claim
_UNPACKERS = {
    "vtkZLibDataCompressor": zlib.decompressobj,
    "vtkLZMADataCompressor": lambda: lzma.LZMADecompressor(memlimit=_MOST_DICTIONARY),
}


def read_vtp(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a file's polygons and strips; other cells are left out.

    Memory is bounded by the length of the file and 32 million values.

    Args:
        data: the whole file.

    Returns:
        (vertices (V, 3) float64 in the file's unit, faces (F, 3) int64). Polygons of
        more than three corners become fans.

    Raises:
        ValueError: if the file is none, is damaged or holds too much.
    """
    appended, raw = b"", False
    start = _APPENDED.search(data)
    if start:
        end = data.rindex(b"</AppendedData>")
        raw = b'"raw"' in start.group() or b"'raw'" in start.group()
        appended = data[start.end() : end]
        data = data[: start.end() - 1] + data[end:]
    try:
        root = ElementTree.fromstring(data, ElementTree.XMLParser(target=_Elements()))
    except (ElementTree.ParseError, LookupError) as error:
        raise ValueError(f"its XML is damaged: {error}") from error
    if root.tag != "VTKFile" or root.get("type") != "PolyData":
        raise ValueError(f"it holds {root.get('type', root.tag)!r}, not PolyData")
    arrays = _VtpArrays(root, appended, raw)
    vertices, faces, count = [], [np.empty((0, 3), dtype=np.int64)], 0
    for piece in root.iter("Piece"):
        array = piece.find("Points/DataArray")
        if array is None:
            continue
        points = arrays.read(array).astype(np.float64).reshape(-1, 3)
        vertices.append(points)
        for kind in ("Polys", "Strips"):
            found = {e.get("Name"): e for e in piece.findall(f"{kind}/DataArray")}
            if {"connectivity", "offsets"} <= set(found):
                corners = arrays.read(found["connectivity"]).astype(np.int64)
                stops = arrays.read(found["offsets"]).astype(np.int64)
                if len(corners) and not 0 <= corners.min() <= corners.max() < len(
                    points
                ):
                    raise ValueError(f"its cells name points beyond {len(points)}")
                faces.append(_triangles(corners, stops, kind == "Strips") + count)
        count += len(points)
    if not vertices:
        raise ValueError("it has no points")
    return np.concatenate(vertices), np.concatenate(faces)


class _Elements(ElementTree.TreeBuilder):
    """Builds the tree of a file without declarations, in any encoding."""

    _count = 0

    def doctype(self, name: str, pubid: str, system: str) -> None:
        raise ValueError("it declares XML entities, which no VTK file does")

    def start(self, tag, attrs):
        self._count += 1
        if self._count > _MOST_ELEMENTS:
            raise ValueError(f"it has more than {_MOST_ELEMENTS:,} XML elements")
        return super().start(tag, attrs)


def _triangles(corners: np.ndarray, stops: np.ndarray, strips: bool) -> np.ndarray:
    """Triangles (F, 3) of cells, fans of polygons or strips."""
    sizes = np.diff(stops, prepend=0)
    if (sizes < 0).any() or sizes.sum() != len(corners):
        raise ValueError("its offsets do not fit its connectivity")
    first = np.repeat(stops - sizes, sizes)
    place = np.arange(len(corners)) - first
    last = np.flatnonzero(place >= 2)
    if strips:
        odd = place[last] % 2  # every other triangle is turned
        return corners[np.stack([last - 2 + 2 * odd, last - 1, last - 2 * odd], axis=1)]
    return corners[np.stack([first[last], last - 1, last], axis=1)]


class _VtpArrays:
    """Reads the arrays of a file, `_MOST_VALUES` values in all."""

    def __init__(self, root: ElementTree.Element, appended: bytes, raw: bool):
        self._appended, self._raw = appended, raw
        self._left = _MOST_VALUES
        self._order = ">" if root.get("byte_order") == "BigEndian" else "<"
        header = root.get("header_type", "UInt32")
        if header not in ("UInt32", "UInt64"):
            raise ValueError(f"header_type is {header!r}; it must be UInt32 or UInt64")
        self._header = np.dtype(self._order + _TYPES[header])
        compressor = root.get("compressor", "")
        self._unpacker = _UNPACKERS.get(compressor)
        if compressor and self._unpacker is None:
            raise ValueError(
                f"it is compressed with {compressor}; save it uncompressed or with zlib"
            )

    def read(self, array: ElementTree.Element) -> np.ndarray:
        """Values of a DataArray."""
        kind = array.get("type", "")
        if kind not in _TYPES:
            raise ValueError(f"an array is of type {kind!r}")
        dtype = np.dtype(self._order + _TYPES[kind])
        try:
            if array.get("format", "ascii") == "ascii":
                text = (array.text or "").split(maxsplit=self._left)
                self._claim(len(text))
                return np.array(text, dtype=np.float64).astype(_TYPES[kind])
            return np.frombuffer(self._unwrap(self._fetch(array), dtype), dtype)
        except (zlib.error, lzma.LZMAError, IndexError, TypeError) as error:
            raise ValueError(f"an array is damaged: {error}") from error

    def _claim(self, values: int) -> None:
        if not 0 <= values <= self._left:
            raise ValueError(f"its arrays hold more than {_MOST_VALUES:,} values")
        self._left -= values

    def _fetch(self, array: ElementTree.Element) -> Callable[..., bytes]:
        """A function that gives the bytes of an array from a place on."""
        start = int(array.get("offset", "0"))
        if array.get("format") == "appended":
            if self._raw:
                return _raw(self._appended, start)
            text = self._appended[start:]
        else:
            text = (array.text or "").strip().encode()
        return _base64(text)

    def _unwrap(self, fetch: Callable[..., bytes], dtype: np.dtype) -> bytes:
        wide = self._header.itemsize
        if self._unpacker is None:
            size = int(np.frombuffer(fetch(0, wide), self._header)[0])
            self._claim(size // dtype.itemsize)
            return fetch(wide, size)
        header = np.frombuffer(fetch(0, 3 * wide), self._header)
        count, full, last = (int(number) for number in header)
        if not 0 <= last <= full or count and full == 0:
            raise ValueError("the header of a compressed array is damaged")
        self._claim(max(count * full // dtype.itemsize, count))
        packed = np.frombuffer(fetch(3 * wide, count * wide), self._header).astype(int)
        data = fetch((3 + count) * wide, int(packed.sum()), after=True)
        stops = np.concatenate([[0], np.cumsum(packed)])
        sizes = [full] * count
        if count and last:
            sizes[-1] = last
        blocks = []
        for a, b, size in zip(stops[:-1], stops[1:], sizes, strict=True):
            blocks.append(self._unpacker().decompress(data[a:b], size))
            if len(blocks[-1]) != size:
                raise ValueError("a compressed block is damaged")
        return b"".join(blocks)


def _raw(data: bytes, start: int) -> Callable[..., bytes]:
    def fetch(at: int, size: int, after: bool = False) -> bytes:
        part = data[start + at : start + at + size]
        if len(part) != size:
            raise ValueError("it is cut off")
        return part

    return fetch


def _base64(text: bytes) -> Callable[..., bytes]:
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
