r"""A detector of device tips, trained on `cathsim dataset` and tested on other arches.

    cathsim dataset arches --anatomies 10 1 3 --sequences 24 --frames 6 --stride 4 \
        --size 128
    python examples/train_tip_detector.py arches

A small convolutional network outputs a probability map of the tip; the detection is the
mean of this map. Its error is compared with that of the mean position of the training
set.
"""

import dataclasses
import time
from pathlib import Path

import h5py
import numpy as np
import torch
import tyro
from torch import nn

CELL = 4  # pixels along a side of a cell of the map


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a run; every one is an option of the command line."""

    data: tyro.conf.Positional[Path]  # a folder of `cathsim dataset`
    epochs: int = 6
    batch: int = 32
    width: int = 8  # channels of the first layer
    learning_rate: float = 4e-3
    seed: int = 0
    out: Path | None = None  # a picture of detections on the test set


def load(data: Path, split: str):
    """Images (n, 1, H, W), tips (n, 2) in pixels, and size of a pixel (n,) in mm."""
    images, tips, scales = [], [], []
    for path in sorted((data / split).glob("*.h5")):
        with h5py.File(path) as file:
            seen = file["keypoints"][:, 0, 2] > 0  # the tip is in the image
            images.append(file["image"][:][seen])
            tips.append(file["keypoints"][:][seen, 0, :2])
            camera = file["camera_matrix"][:][seen]
            place = file["keypoints_3d"][:][seen, 0]
            depth = np.einsum("ni,ni->n", camera[:, 2, :3], place) + camera[:, 2, 3]
            # The norm of the centred first row of the matrix is the focal length.
            across = (
                camera[:, 0, :3] - 0.5 * (images[-1].shape[2] - 1) * camera[:, 2, :3]
            )
            scales.append(1e3 * depth / np.linalg.norm(across, axis=1))
    if not images:
        raise SystemExit(
            f"{data / split} holds no .h5 file; give a folder of `cathsim dataset`"
        )
    picture = torch.from_numpy(np.concatenate(images)[:, None])
    return picture, torch.from_numpy(np.concatenate(tips)), np.concatenate(scales)


class Detector(nn.Module):
    """U-Net of three levels from images to log-probability maps of the tip."""

    def __init__(self, width: int):
        super().__init__()
        sizes = [width, 2 * width, 4 * width]
        self.down = nn.ModuleList()
        self.up = nn.ModuleList()
        before = 1
        for size in sizes:
            self.down.append(self.block(before, size))
            before = size
        self.middle = nn.Sequential(*(self.block(before, before) for _ in range(2)))
        for size in reversed(sizes[1:]):
            self.up.append(self.block(before + size, size))
            before = size
        self.last = nn.Conv2d(before, 1, 1)

    @staticmethod
    def block(inputs: int, outputs: int) -> nn.Module:
        return nn.Sequential(
            nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(),
        )

    def forward(self, images):
        """Log-probabilities (n, H / CELL, W / CELL) of the cells."""
        signal = images.float() / 127.5 - 1.0
        signal = signal - signal.mean(dim=(2, 3), keepdim=True)
        signal = 4.0 * nn.functional.avg_pool2d(signal, 2)
        kept = []
        for block in self.down:
            signal = block(signal)
            kept.append(signal)
            signal = nn.functional.max_pool2d(signal, 2)
        signal = self.middle(signal)
        for block, beside in zip(self.up, reversed(kept[1:]), strict=True):
            signal = nn.functional.interpolate(signal, scale_factor=2)
            signal = block(torch.cat([signal, beside], dim=1))
        return (
            self.last(signal)[:, 0].flatten(1).log_softmax(1).view(signal[:, 0].shape)
        )


def targets(tips, shape):
    """Target maps (n, h, w): a Gaussian about each tip, normalised to 1."""
    rows, columns = (torch.arange(size, dtype=torch.float32) for size in shape)
    x, y = ((tips - (CELL - 1) / 2) / CELL).T  # integers are centres of cells
    square = (columns - x[:, None, None]) ** 2 + (rows[:, None] - y[:, None, None]) ** 2
    return (-square).flatten(1).softmax(1).view(len(tips), *shape)


@torch.no_grad()
def detect(model, images, batch: int):
    """Tips (n, 2) in pixels: the mean of each map around its maximum."""
    model.eval()
    found = []
    for part in images.split(batch):
        logits = model(part)
        height, width = logits.shape[1:]
        peak = logits.flatten(1).argmax(1)
        rows, columns = torch.meshgrid(
            torch.arange(height), torch.arange(width), indexing="ij"
        )
        far = (rows - (peak // width)[:, None, None]).abs()
        far = far.maximum((columns - (peak % width)[:, None, None]).abs())
        weight = logits.exp() * (far <= 2)
        weight /= weight.sum(dim=(1, 2), keepdim=True)
        cell = torch.stack([(weight * each).sum((1, 2)) for each in (columns, rows)], 1)
        found.append(CELL * cell + (CELL - 1) / 2)
    return torch.cat(found)


def report(name: str, found, tips, scale) -> None:
    """Prints median and 90 % quantile of the error in pixels and mm."""
    error = (found - tips).norm(dim=1).numpy()
    pixels, lengths = (np.percentile(e, [50, 90]) for e in (error, error * scale))
    print(
        f"{name}: median {pixels[0]:.2f} px ({lengths[0]:.2f} mm), 90 % below "
        f"{pixels[1]:.2f} px ({lengths[1]:.2f} mm), {len(error)} images"
    )


def picture(path: Path, images, tips, found) -> None:
    """Draws eight images with the true (ring) and the detected tip (cross)."""
    from matplotlib.figure import Figure

    figure = Figure((10, 5.2), layout="constrained")
    chosen = np.linspace(0, len(images) - 1, 8).astype(int)
    for axis, row in zip(figure.subplots(2, 4).flat, chosen, strict=True):
        axis.imshow(images[row, 0], cmap="gray")
        axis.plot(*tips[row], "o", mfc="none", color="lime", markersize=11)
        axis.plot(*found[row], "+", color="red", markersize=9)
        axis.set_axis_off()
    figure.savefig(path, dpi=80)


def train(settings: Settings) -> None:
    """Train and test."""
    torch.manual_seed(settings.seed)
    images, tips, _ = load(settings.data, "train")
    model = Detector(settings.width)
    steps = settings.epochs * -(-len(images) // settings.batch)
    optimiser = torch.optim.AdamW(model.parameters(), settings.learning_rate)
    rate = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, settings.learning_rate, total_steps=steps
    )
    start = time.monotonic()
    for epoch in range(settings.epochs):
        model.train()
        losses = []
        for rows in torch.randperm(len(images)).split(settings.batch):
            logits = model(images[rows])
            loss = -(targets(tips[rows], logits.shape[1:]) * logits).sum((1, 2)).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            rate.step()
            losses.append(loss.item())
        took = time.monotonic() - start
        print(f"epoch {epoch}: loss {np.mean(losses):.3f}, {took:.0f} s", flush=True)
    for split in ("val", "test"):
        if not any((settings.data / split).glob("*.h5")):
            continue
        others, truth, scale = load(settings.data, split)
        found = detect(model, others, settings.batch)
        report(f"{split}, detector", found, truth, scale)
        report(f"{split}, mean position", tips.mean(0), truth, scale)
        if settings.out is not None and split == "test":
            picture(settings.out, others, truth, found)


if __name__ == "__main__":
    train(tyro.cli(Settings))
