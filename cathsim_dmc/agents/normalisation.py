"""Running statistics of observations, which only training updates."""

import torch
from torch import nn

# Below this share of its mean a float32 entry's spread is rounding noise
# (resolution 6e-8), so the entry counts as constant.
RELATIVE_FLOOR = 1e-6
# Spread below which an entry counts as constant whatever its mean. Inertias of the
# links are about 1e-9 kg m^2 and must stay above it.
ABSOLUTE_FLOOR = 1e-13
# Grey levels that correspond to 1 after subtraction: about the shadow of a device.
SHADOW = 32.0


class ObservationNormaliser(nn.Module):
    """Shift and scale each entry to zero mean and unit spread, then clip.

    Entries mix metres with inertias of 1e-9 kg m^2, so no common epsilon fits: an entry
    whose spread cannot be distinguished from rounding gives exactly zero instead of
    amplified noise. Statistics change only in `update`, never in `forward`, and are
    buffers, so they are saved with the weights.

    Args:
        clip: largest magnitude of a normalised entry.
    """

    count: torch.Tensor
    mean: torch.Tensor
    squares: torch.Tensor
    shift: torch.Tensor
    scale: torch.Tensor

    def __init__(self, size: int, clip: float):
        super().__init__()
        self.clip = clip
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("squares", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("shift", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Normalise (..., size) float32; before the first `update` it only clips."""
        centred = (observation - self.shift) * self.scale
        return centred.clamp(-self.clip, self.clip)

    @torch.no_grad()
    def update(self, observation: torch.Tensor) -> None:
        """Merge a batch (..., size) (Chan et al. 1983); ValueError if not finite."""
        rows = observation.reshape(-1, self.mean.numel()).double()
        if not bool(torch.isfinite(rows).all()):
            bad = (~torch.isfinite(rows)).any(0).nonzero().flatten().tolist()
            raise ValueError(
                f"observation entries {bad[:10]} are not finite; the simulation has "
                f"diverged or an observable is broken. Statistics were not changed."
            )
        count = float(rows.shape[0])
        mean = rows.mean(0)
        squares = (rows - mean).square().sum(0)
        total = self.count + count
        delta = mean - self.mean
        self.squares += squares + delta.square() * (self.count * count / total)
        self.mean += delta * (count / total)
        self.count.copy_(total)
        spread = (self.squares / self.count).sqrt()
        floor = (RELATIVE_FLOOR * self.mean.abs()).clamp_min(ABSOLUTE_FLOOR)
        self.shift.copy_(self.mean)
        self.scale.copy_(torch.where(spread > floor, 1.0 / spread, 0.0))


class ImageNormaliser(nn.Module):
    """Images as networks read them: brightness, or difference from the mean image.

    In a fluoroscopic image only the few pixels at the device change, by about 30 of 255
    levels; from the brightness a network learns hardly anything (docs/training.md).
    Subtracting the mean of all images leaves only these pixels, as digital subtraction
    angiography does with a mask image. The mean changes only in `update`.

    Args:
        shape: channels, height and width of the images.
        subtract: whether to subtract the mean image.
    """

    count: torch.Tensor
    mean: torch.Tensor

    def __init__(self, shape: tuple[int, int, int], subtract: bool):
        super().__init__()
        self.subtract = subtract
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(shape))

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """Turn bytes (..., c, h, w) into float32."""
        if self.subtract:
            return (pixels.float() - self.mean) / SHADOW
        return pixels.float() / 255.0

    @torch.no_grad()
    def update(self, pixels: torch.Tensor) -> None:
        """Merge images (..., c, h, w) into the mean."""
        if not self.subtract:
            return
        images = pixels.reshape((-1, *self.mean.shape))
        self.count += len(images)
        difference = images.float().mean(0) - self.mean
        self.mean += difference * float(len(images) / self.count)
