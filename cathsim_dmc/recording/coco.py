"""Labels of a file of fluoroscopy in the format of COCO, masks run-length encoded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import files
from cathsim_dmc.recording.sequences import DEVICE, DEVICE_KEYPOINTS, OSTIA, VESSEL

_CLASSES = (("device", DEVICE, DEVICE_KEYPOINTS), ("vessel", VESSEL, OSTIA))
CATEGORIES = [
    {"id": number, "name": name, "keypoints": list(keypoints), "skeleton": []}
    for number, (name, _, keypoints) in enumerate(_CLASSES, 1)
]
_MOST_ROWS = 10**6  # in one file


def described(columns: np.ndarray, bit: int = 1) -> dict[str, Any]:
    """The pixels of a mask that have a bit, as COCO describes an object.

    Run lengths begin with that of zeros; from the fourth on they are less the one two
    before. Each is written in groups of five bits, least first, with a sign.

    Args:
        columns: (columns, rows) uint8, the transposed mask.

    Returns:
        Segmentation in compressed run lengths, which `pycocotools.mask.decode` reads;
        area; bounding box.
    """
    values = columns & bit > 0
    flat = values.ravel()
    runs = np.flatnonzero(np.diff(flat, prepend=False, append=not flat[-1]))
    rest = runs = np.diff(runs, prepend=0)
    if len(runs) > 3:
        rest = np.concatenate([runs[:3], runs[3:] - runs[1:-2]])
    left = rest[:, None] >> 5 * np.arange(7)
    more = left[:, 1:] != -(left[:, :-1] >> 4 & 1)
    codes = (left[:, :-1] & 31) + 32 * more + 48
    there = np.pad(more[:, :-1], ((0, 0), (1, 0)), constant_values=True)
    box = [0] * 4
    if flat.any():
        across, down = (np.flatnonzero(values.any(axis)) for axis in (1, 0))
        first, last = (across[0], down[0]), (across[-1], down[-1])
        box = [int(n) for n in (*first, *np.subtract(last, first) + 1)]
    return {
        "segmentation": {
            "size": list(columns.shape[::-1]),
            "counts": codes[there].astype(np.uint8).tobytes().decode(),
        },
        "area": int(flat.sum()),
        "bbox": box,
        "iscrowd": 0,
    }


def labels(path: Path, number: int, pictures: bool = False) -> dict[str, list[Any]]:
    """Images and annotations of one file of sequences.

    Args:
        path: Of the HDF5 file, see `recording.sequences`.
        number: Of the file in its split; ids are unique with it.
        pictures: Whether to write the images as PNG, into a folder beside the file.
    """
    import h5py
    from PIL import Image

    images, annotations = [], []
    with h5py.File(path) as file:
        rows, height, width = file["image"].shape
        sequence = file["sequence"][:].tolist()
        cameras = file["camera_matrix"][:].round(6).tolist()
        keypoints = file["keypoints"][:].round(2)
        masks = np.ascontiguousarray(file["mask"][:].transpose(0, 2, 1))
        first = number * _MOST_ROWS
        for row in range(rows):
            images.append({
                "id": first + row, "height": height, "width": width,
                "file_name": f"{path.parent.name}/{path.stem}/{row:06d}.png",
                "hdf5": f"{path.parent.name}/{path.name}", "row": row,
                "sequence": sequence[row], "camera_matrix": cameras[row],
            })  # fmt: skip
        start = 0
        for kind, (_, bit, names) in enumerate(_CLASSES):
            own = keypoints[:, start : start + len(names)]
            start += len(names)
            known = (own[..., 2] > 0).sum(axis=1).tolist()
            flat = own.reshape(rows, -1).tolist()
            for row, mask in enumerate(masks):
                image = first + row
                annotations.append({
                    "id": 2 * image + kind, "image_id": image, "category_id": kind + 1,
                    **described(mask, bit), "keypoints": flat[row],
                    "num_keypoints": known[row],
                })  # fmt: skip
        if pictures and not (folder := path.with_suffix("")).exists():
            with files.atomic_directory(folder) as temporary:
                for row, image in enumerate(file["image"]):
                    picture = Image.fromarray(image)
                    picture.save(temporary / f"{row:06d}.png", compress_level=1)
    return {"images": images, "annotations": annotations}
