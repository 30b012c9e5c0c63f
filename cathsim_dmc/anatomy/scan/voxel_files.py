"""Files of voxels that the headers of label maps name: NRRD and MetaImage."""

import re
from collections.abc import Sequence
from pathlib import Path

# Slices by number; anything else in it would be a format of C, run by VTK.
_PATTERN = re.compile(r"[^%]*%(0\d)?\d?d[^%]*")


def beside(path: Path, named: str) -> Path:
    """The file that the header at `path` names; it may be missing.

    ValueError unless it lies in the folder of the header or below it: a header from
    elsewhere may name any file.
    """
    given = Path(named)
    if given.anchor or ".." in given.parts or not given.parts:
        raise ValueError(
            f"its voxels are in another file, {named!r}, outside its folder; put both "
            "into one folder and name it without folders, or save them as one file "
            "(.nrrd, .mha)"
        )
    return path.parent / given


def of_meta(path: Path, named: str, listed: bytes, sizes: Sequence[int]) -> list[Path]:
    """Files of the voxels of a MetaImage; none if they are in the file itself.

    VTK leaves slices undefined for which the header names no file.

    Args:
        named: ElementDataFile.
        listed: What stands behind it.
        sizes: DimSize (3,).
    """
    if named in ("Local", "LOCAL", "local"):
        return []
    if named.startswith("LIST"):
        return _listed(path, named, listed, sizes[-1])
    if "%" in named:
        return _numbered(path, named, sizes[-1])
    return [beside(path, named)]


def _listed(path: Path, named: str, listed: bytes, count: int) -> list[Path]:
    """Files of a list, one slice in a line."""
    if named.split() not in (["LIST"], ["LIST", "2"], ["LIST", "2D"]):
        raise ValueError(  # VTK reads a slice of each file, whatever number stands here
            f"its files are {named!r}; list one file for each slice (LIST), or save "
            "them as one file"
        )
    rows = listed.split(b"\n")[:-1]  # VTK leaves out a line without an end
    names = [row.decode("utf-8", "surrogateescape").strip() for row in rows[:count]]
    if len(names) < count or not all(names):
        raise ValueError(
            f"its list names {sum(map(bool, names)):,} files for {count:,} slices; "
            "name one in each line, and end the last line, too"
        )
    return [beside(path, name) for name in names]


def _numbered(path: Path, named: str, count: int) -> list[Path]:
    """Files of a pattern such as "slice%03d.raw 1 60 1": first, last and step."""
    pattern, *words = named.split()
    numbers = [int(word) for word in words if word.isdecimal()]
    if (
        not _PATTERN.fullmatch(pattern)
        or len(numbers) != len(words)
        or len(numbers) not in (0, 1, 3)  # VTK divides by 0 where the step is missing
        or numbers[2:] == [0]
    ):
        raise ValueError(
            f"its files are named {named!r}; give one %d or %03d, and the numbers of "
            "the first slice, the last slice and the step, or save them as one file"
        )
    first = numbers[0] if numbers else 1
    last, step = numbers[1:] or (first + count - 1, 1)
    held = len(range(first, last + 1, step))
    if held < count:
        raise ValueError(f"its pattern {named!r} names {held:,} of {count:,} slices")
    return [beside(path, pattern % (first + k * step)) for k in range(count)]
