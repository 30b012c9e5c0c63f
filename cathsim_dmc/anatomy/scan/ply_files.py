"""Headers of PLY files, and triangles of binary ones, whose polygons may have any size.

A header ends with a line `end_header`; its lines end in LF, CR LF or CR.
"""

import re
from typing import Any

import numpy as np

_TYPES = {
    kind: code
    for names, code in (
        ("char int8", "i1"),
        ("uchar uint8", "u1"),
        ("short int16", "i2"),
        ("ushort uint16", "u2"),
        ("int int32", "i4"),
        ("uint uint32", "u4"),
        ("float float32", "f4"),
        ("double float64", "f8"),
    )
    for kind in names.split()
}


def header(data: bytes) -> tuple[bytes, int]:
    """Header without comments, its lines ending in LF, and the offset of the body.

    ValueError if there is no line `end_header`.
    """
    found = re.search(rb"[\r\n]end_header[ \t]*(\r\n|[\r\n])", data)
    if found is None:
        raise ValueError("its header has no line 'end_header'")
    head, end = data[: found.start()], found.end()
    if b"\n" not in head and found[1] == b"\r\n":
        end -= 1  # the first byte of a body behind lines that end in CR
    lines = head.splitlines()
    kept = [line for line in lines if not line.startswith((b"comment", b"obj_info"))]
    return b"\n".join([*kept, b"end_header\n"]), end


def triangles(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and triangles (F, 3) int64; polygons are divided.

    ValueError if the file ends early.
    """
    (head, at), body = header(data), data
    order = ">" if b"binary_big" in head else "<"
    found: dict[str, list[np.ndarray]] = {}
    for name, count, properties in _elements(head.decode("latin-1")):
        found[name], at = _rows(body, at, count, properties, order)
    points = [np.stack([rows[axis] for axis in "xyz"], 1) for rows in found["vertex"]]
    faces = [np.empty((0, 3), dtype=np.int64)]
    for rows in found.get("face", ()):
        names = rows.dtype.names or ()
        corners = rows[next(name for name in names if name.startswith("vertex_ind"))]
        faces += [corners[:, [0, k, k + 1]] for k in range(1, corners.shape[1] - 1)]
    return np.concatenate(points).astype(float), np.concatenate(faces).astype(np.int64)


def _elements(header: str) -> list[tuple[str, int, list[list[str]]]]:
    """Name, number of rows, and properties of every element of a header."""
    elements: list[tuple[str, int, list[list[str]]]] = []
    for line in header.splitlines():
        first, *words = line.split() or [""]
        if first == "element":
            elements.append((words[0], int(words[1]), []))
        elif first == "property":
            elements[-1][2].append(words)
    return elements


def _rows(
    body: bytes, at: int, count: int, properties: list[list[str]], order: str
) -> tuple[list[np.ndarray], int]:
    """Rows of an element, in blocks of one type, and the offset of their end."""
    blocks: list[np.ndarray] = []
    left, many = count, count  # usually all rows are like the first one
    while left > 0:
        kind, lengths = _type_of(body, at, properties, order)
        room = (len(body) - at) // kind.itemsize
        if room < 1:
            raise ValueError(f"it ends early, {left:,} of {count:,} rows are missing")
        block = np.frombuffer(body, kind, min(many, left, room), at)
        same = np.ones(len(block), dtype=bool)
        for name, length in lengths.items():
            same &= block[name] == length
        like = len(block) if same.all() else int(same.argmin())
        blocks.append(block[:like])
        at, left, many = at + like * kind.itemsize, left - like, 2 * like
    return blocks, at


def _type_of(
    body: bytes, at: int, properties: list[list[str]], order: str
) -> tuple[np.dtype[Any], dict[str, int]]:
    """Type of the row at an offset, and the lengths of its lists by their fields."""
    fields: list[tuple[Any, ...]] = []
    lengths: dict[str, int] = {}
    for first, *words in properties:
        if first != "list":
            fields.append((words[0], order + _TYPES[first]))
            continue
        kind, of, name = words
        start = at + np.dtype(fields).itemsize
        number = np.dtype(order + _TYPES[kind])
        told = body[start : start + number.itemsize]
        lengths[f"length of {name}"] = length = int.from_bytes(
            told, "big" if order == ">" else "little"
        )
        fields.append((f"length of {name}", number))
        fields.append((name, order + _TYPES[of], (length,)))
    return np.dtype(fields), lengths
