"""Labels of a file of fluoroscopy in the format of COCO, masks run-length encoded."""

from __future__ import annotations

from collections.abc import Iterator
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
    return text[: _encode(column_major, text)].tobytes().decode()


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
        masks, keypoints = file["mask"][:], columns["keypoints"].round(2)
        cameras = columns["camera_matrix"].round(6).tolist()
        for row, sequence in enumerate(columns["sequence"].tolist()):
            images.append({
                "id": number * _MOST_ROWS + row, "height": height, "width": width,
                "file_name": f"{path.parent.name}/{path.stem}/{row:06d}.png",
                "hdf5": f"{path.parent.name}/{path.name}", "row": row,
                "sequence": sequence, "camera_matrix": cameras[row],
            })  # fmt: skip
        for kind, (_, bit, names) in enumerate(_CLASSES):
            own = keypoints[:, -len(names) :] if kind else keypoints[:, : len(names)]
            for row, one in enumerate(_annotations(masks & bit > 0, own)):
                found = number * _MOST_ROWS + row
                annotations.append(
                    {"id": 2 * found + kind, "image_id": found, "category_id": kind + 1}
                    | one
                )
        if pictures and not (folder := path.with_suffix("")).exists():
            with files.atomic_directory(folder) as temporary:
                _write_pictures(file["image"], temporary)
    return {"images": images, "annotations": annotations}


def _annotations(masks: np.ndarray, keypoints: np.ndarray) -> Iterator[dict[str, Any]]:
    """What COCO says of objects with masks (n, H, W) bool and keypoints (n, K, 3)."""
    size, areas = list(masks.shape[1:]), masks.sum(axis=(1, 2)).tolist()
    ends = []
    for axis in (1, 2):  # columns, then rows
        covered = np.asarray(masks.any(axis=axis))
        first, length = covered.argmax(axis=1), covered.shape[1]
        last = length - 1 - covered[:, ::-1].argmax(axis=1)
        ends.append((first.tolist(), (last - first + 1).tolist()))
    known = (keypoints[..., 2] > 0).sum(axis=1).tolist()
    flat = keypoints.reshape(len(keypoints), -1).tolist()
    for row, mask in enumerate(masks):
        box = [ends[0][0][row], ends[1][0][row], ends[0][1][row], ends[1][1][row]]
        yield {
            "segmentation": {"size": size, "counts": encoded(mask)},
            "area": areas[row],
            "bbox": box if areas[row] else [0, 0, 0, 0],
            "iscrowd": 0,
            "keypoints": flat[row],
            "num_keypoints": known[row],
        }


def _write_pictures(images: Any, folder: Path) -> None:
    from PIL import Image

    for row in range(len(images)):
        picture = Image.fromarray(images[row])
        picture.save(folder / f"{row:06d}.png", compress_level=1)
