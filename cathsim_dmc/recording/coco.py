"""Labels of a file of fluoroscopy in the format of COCO, masks run-length encoded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import files
from cathsim_dmc.compiled import compiled
from cathsim_dmc.recording.sequences import DEVICE, DEVICE_KEYPOINTS, OSTIA, VESSEL

_CLASSES = (("device", DEVICE, DEVICE_KEYPOINTS), ("vessel", VESSEL, OSTIA))
CATEGORIES = [
    {"id": number, "name": name, "keypoints": list(keypoints), "skeleton": []}
    for number, (name, _, keypoints) in enumerate(_CLASSES, 1)
]
_MOST_ROWS = 10**6  # in one file


def encoded(mask: np.ndarray) -> str:
    """A mask (rows, columns) bool as COCO's compressed run lengths, column by column.

    `pycocotools.mask.decode({"size": mask.shape, "counts": ...})` reads it.
    """
    column_major = np.ascontiguousarray(mask.T, dtype=np.uint8).reshape(-1)
    text = np.empty(7 * len(column_major) + 14, np.uint8)
    return bytes(text[: _encode(column_major, text)]).decode()


@compiled
def _encode(values: np.ndarray, text: np.ndarray) -> int:
    """Writes run lengths as pycocotools does; returns the number of characters.

    Run lengths begin with that of zeros; from the fourth on they are less the one two
    before. Each is written in groups of five bits, least first, with a sign.
    """
    size, now, start, count = 0, 0, 0, 0
    before, last = 0, 0  # the run lengths two before, and one before
    for end in range(len(values) + 1):
        if end < len(values) and values[end] == now:
            continue
        run = end - start
        left = run - before if count > 2 else run
        while True:
            group = left & 31
            left >>= 5
            more = left != -1 if group & 16 else left != 0
            text[size] = group + (32 if more else 0) + 48
            size += 1
            if not more:
                break
        before, last, start, now, count = last, run, end, 1 - now, count + 1
    return size


def labels(path: Path, number: int, pictures: bool = False) -> dict[str, list[Any]]:
    """Images and annotations of one file of sequences.

    Args:
        path: Of the HDF5 file, see `recording.sequences`.
        number: Of the file in its split; ids are unique with it.
        pictures: Whether to write the images as PNG, into a folder beside the file.
    """
    import h5py

    images, annotations = [], []
    with h5py.File(path) as file:
        columns = {
            name: file[name][:] for name in ("keypoints", "sequence", "camera_matrix")
        }
        rows, height, width = file["image"].shape
        masks = file["mask"][:]
        for row in range(rows):
            found = number * _MOST_ROWS + row
            images.append({
                "id": found, "height": height, "width": width,
                "file_name": f"{path.parent.name}/{path.stem}/{row:06d}.png",
                "hdf5": f"{path.parent.name}/{path.name}", "row": row,
                "sequence": int(columns["sequence"][row]),
                "camera_matrix": columns["camera_matrix"][row].round(6).tolist(),
            })  # fmt: skip
            flags, points = masks[row], columns["keypoints"][row].round(2)
            for kind, (_, bit, names) in enumerate(_CLASSES):
                own = points[: len(names)] if not kind else points[-len(names) :]
                annotations.append(
                    {"id": 2 * found + kind, "image_id": found, "category_id": kind + 1}
                    | _annotation(flags & bit > 0, own)
                )
        if pictures and not (folder := path.with_suffix("")).exists():
            with files.atomic_directory(folder) as temporary:
                _write_pictures(file["image"], temporary)
    return {"images": images, "annotations": annotations}


def _annotation(mask: np.ndarray, keypoints: np.ndarray) -> dict[str, Any]:
    """What COCO says of an object with a mask (H, W) bool and keypoints (K, 3)."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    box = [0, 0, 0, 0]
    if len(rows):
        height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
        box = [int(columns[0]), int(rows[0]), int(width), int(height)]
    return {
        "segmentation": {"size": list(mask.shape), "counts": encoded(mask)},
        "area": int(mask.sum()),
        "bbox": box,
        "iscrowd": 0,
        "keypoints": keypoints.reshape(-1).tolist(),
        "num_keypoints": int((keypoints[:, 2] > 0).sum()),
    }


def _write_pictures(images: Any, folder: Path) -> None:
    from PIL import Image

    for row in range(len(images)):
        picture = Image.fromarray(images[row])
        picture.save(folder / f"{row:06d}.png", compress_level=1)
