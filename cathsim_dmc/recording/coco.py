"""Labels of fluoroscopy in the COCO format, with run-length encoded masks."""

import contextlib
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import extras, files
from cathsim_dmc.recording.sequences import DEVICE, DEVICE_KEYPOINTS, OSTIA, VESSEL

_CLASSES = (("device", DEVICE, DEVICE_KEYPOINTS), ("vessel", VESSEL, OSTIA))
CATEGORIES = [
    {"id": number, "name": name, "keypoints": list(keypoints), "skeleton": []}
    for number, (name, _, keypoints) in enumerate(_CLASSES, 1)
]
_MOST_ROWS = 10**6  # in one file
_SHIFTS = 5 * np.arange(7)  # enough for masks of 2**30 pixels


def described(columns: np.ndarray, bit: int = 1) -> dict[str, Any]:
    """Returns the COCO description of the pixels of a mask in which a bit is set.

    Run lengths begin with a run of zeros. From the fourth on, each is stored as its
    difference from the run two before. A number is a sequence of five-bit groups, least
    significant first, with a sign.

    Args:
        columns: (columns, rows) uint8, the transposed mask.

    Returns:
        "segmentation" in compressed run lengths, which `pycocotools.mask.decode` reads;
        "area", px; "bbox", (column, row, width, height), px; "iscrowd".
    """
    values = (columns & bit).astype(bool)
    flat = values.ravel()
    edges = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    runs = np.diff(np.concatenate([[0] * (1 + int(flat[0])), edges, [flat.size]]))
    rest = runs.copy()
    rest[3:] -= runs[1:-2]
    left = rest[:, None] >> _SHIFTS
    more = left[:, 1:] != -(left[:, :-1] >> 4 & 1)
    codes = (left[:, :-1] & 31) + 32 * more + 48
    there = np.ones_like(more)
    there[:, 1:] = more[:, :-1]
    box, area = [0] * 4, int(runs[1::2].sum())
    if area:
        across, down = (np.flatnonzero(values.any(axis=axis)) for axis in (1, 0))
        box = [across[0], down[0], np.ptp(across) + 1, np.ptp(down) + 1]
    return {
        "segmentation": {
            "size": list(columns.shape[::-1]),
            "counts": codes[there].astype(np.uint8).tobytes().decode(),
        },
        "area": area,
        "bbox": [int(each) for each in box],
        "iscrowd": 0,
    }


def labels(path: Path, number: int, pictures: bool = False) -> dict[str, list[Any]]:
    """Returns the images and annotations of one file of sequences.

    What an image does not show, an empty mask, has no annotation.

    Args:
        path: Path of the HDF5 file, see `recording.sequences`.
        number: Number of the file in its split; it makes the ids unique.
        pictures: Whether to write the images as PNG, into a folder beside the file.

    Raises:
        ValueError: the file is damaged.
    """
    extras.require("gym", "h5py")
    import h5py
    from PIL import Image

    images, annotations = [], []
    text = f"{path} is damaged; remove it and give the command again, which writes it"
    with files.refused(ValueError, text, OSError):
        file = h5py.File(path)
    with file:
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
                image, shape = first + row, described(mask, bit)
                if not shape["area"]:  # training code refuses empty boxes
                    continue
                annotations.append({  # COCOeval takes an id of 0 for no match
                    "id": 2 * image + kind + 1,
                    "image_id": image, "category_id": kind + 1,
                    **shape, "keypoints": flat[row],
                    "num_keypoints": known[row],
                })  # fmt: skip
        if pictures and not (folder := path.with_suffix("")).exists():
            # Another process of this dataset may have written the same ones meanwhile.
            with (
                contextlib.suppress(FileExistsError),
                files.atomic_directory(folder) as temporary,
            ):
                for row, image in enumerate(file["image"]):
                    picture = Image.fromarray(image)
                    picture.save(temporary / f"{row:06d}.png", compress_level=1)
    return {"images": images, "annotations": annotations}
