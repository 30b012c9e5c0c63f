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


def described(columns: np.ndarray, bit: int = 1) -> dict[str, Any]:
    """The pixels of a mask that have a bit, as COCO describes an object.

    Args:
        columns: (columns, rows) uint8, the transposed mask.

    Returns:
        Segmentation in compressed run lengths, which `pycocotools.mask.decode` reads;
        area; bounding box.
    """
    text = np.empty(7 * columns.size + 14, np.uint8)
    size, area, left, right, top, bottom = _describe(columns, bit, text)
    counts = text[:size].tobytes().decode()
    return {
        "segmentation": {"size": list(columns.shape[::-1]), "counts": counts},
        "area": area,
        "bbox": [left, top, right - left + 1, bottom - top + 1] if area else [0] * 4,
        "iscrowd": 0,
    }


@compiled
def _describe(columns: np.ndarray, bit: int, text: np.ndarray) -> tuple:
    """Writes run lengths as pycocotools does.

    Run lengths begin with that of zeros; from the fourth on they are less the one two
    before. Each is written in groups of five bits, least first, with a sign.

    Returns:
        Number of characters, area, first and last column, first and last row.
    """
    high, values = columns.shape[1], columns.reshape(-1)
    size, now, start, count, area = 0, 0, 0, 0, 0
    before, last = 0, 0  # the run lengths two before, and one before
    left, right, top, bottom = len(columns), -1, high, -1
    for end in range(len(values) + 1):
        if end < len(values) and (values[end] & bit != 0) == now:
            continue
        run = end - start
        if now and run:
            area += run
            left, right = min(left, start // high), (end - 1) // high
            inside = start // high == right  # a run over two columns covers both ends
            top = min(top, start % high if inside else 0)
            bottom = max(bottom, (end - 1) % high if inside else high - 1)
        rest = run - before if count > 2 else run
        while True:
            group = rest & 31
            rest >>= 5
            more = rest != -1 if group & 16 else rest != 0
            text[size] = group + (32 if more else 0) + 48
            size += 1
            if not more:
                break
        before, last, start, now, count = last, run, end, 1 - now, count + 1
    return size, area, left, right, top, bottom


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
        keypoints = columns["keypoints"].round(2)
        masks = np.ascontiguousarray(file["mask"][:].transpose(0, 2, 1))
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
            known = (own[..., 2] > 0).sum(axis=1).tolist()
            flat = own.reshape(len(own), -1).tolist()
            for row, mask in enumerate(masks):
                image = number * _MOST_ROWS + row
                annotations.append({
                    "id": 2 * image + kind, "image_id": image, "category_id": kind + 1,
                    **described(mask, bit), "keypoints": flat[row],
                    "num_keypoints": known[row],
                })  # fmt: skip
        if pictures and not (folder := path.with_suffix("")).exists():
            with files.atomic_directory(folder) as temporary:
                _write_pictures(file["image"], temporary)
    return {"images": images, "annotations": annotations}


def _write_pictures(images: Any, folder: Path) -> None:
    from PIL import Image

    for row in range(len(images)):
        picture = Image.fromarray(images[row])
        picture.save(folder / f"{row:06d}.png", compress_level=1)
