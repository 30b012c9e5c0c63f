"""An episode as a moving picture for slides and pages, without OpenGL."""

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tqdm import tqdm

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.files import as_path, atomic_path, require_file
from cathsim_dmc.pictures import figure as drawing
from cathsim_dmc.pictures.anatomies import Picture
from cathsim_dmc.pictures.films import MP4, check_film, write_mp4
from cathsim_dmc.pictures.moment import Moment, on_screen
from cathsim_dmc.pictures.translucent import ParallelProjection, glass
from cathsim_dmc.recording.episode import Episode

FRAMES = 90
_SHORTEST, _LONGEST = 2.0, 12.0  # s of a film, without its last pause
# Time that the last frame stays before the film begins again, ms.
_HOLD_MS = 1500
_TICK_MS = 20  # browsers do not show frames that are shorter
_DPI, _NARROWEST = 100, 64  # px
# Largest width of the scene per height: beside a wider one, as of a scan that lies, the
# X-ray image would be too small to see.
_WIDEST = 1.6
_MARGIN = 8e-3  # around the vessel, m
_LONG_S = 2.0  # after which the progress is shown
_FORCE_COLOUR = "#b3202c"
# A film shows the noise of fluoroscopy, at a multiple of the usual dose.
_NOISE = {"noise": True, "kerma": 4e-7}


def animate(
    episode: Episode,
    surface: Any,
    path: str | os.PathLike[str],
    *,
    frames: int = FRAMES,
    width: int = 860,
    quality: int = 80,
) -> Path:
    """Write an episode as an animated GIF or WebP or an MP4, whole or not at all.

    On the left the translucent vessel with device, goal and contact forces, on the
    right the X-ray image above the force on the wall.

    Args:
        surface: Lumen surface, `anatomy.surface`.
        path: File to write, `.gif`, `.webp` or, with the extra `video`, `.mp4`.
        frames: Number of pictures at most; an episode has one state every 40 ms.
        width: Width of the film, pixels.
        quality: Quality of a WebP, 0 to 100.

    Returns:
        The path.

    Raises:
        ValueError: on another suffix, or an episode without a goal.
        FileNotFoundError: if the folder does not exist.
        ImportError: if `path` is an MP4 and cannot be encoded.
    """
    bounds.instance("episode", episode, Episode)
    bounds.whole("frames", frames, 1, bounds.MOST_STEPS)
    bounds.whole("width", width, _NARROWEST, bounds.MOST_PIXELS)
    bounds.whole("quality", quality, 0, 100)
    bounds.instance("surface", surface, Surface)
    path = as_path("path", path)
    check_film(path)
    require_file(path)
    seconds = np.clip(episode.time[-1] - episode.time[0], _SHORTEST, _LONGEST)
    count = min(frames, episode.steps + 1)
    chosen = np.unique(np.linspace(0, episode.steps, count).round().astype(int))
    made = list(_frames(episode, surface, width, chosen))
    tick = max(round(1000 * seconds / max(len(made) - 1, 1)), _TICK_MS)
    if path.suffix == MP4:
        return write_mp4(path, made, tick, _HOLD_MS)
    pictures = [Image.fromarray(picture) for picture in made]
    times = [tick] * (len(pictures) - 1) + [_HOLD_MS]
    options: dict[str, Any] = {"quality": quality, "method": 4}
    if path.suffix == ".gif":
        pictures, options = _one_palette(pictures), {"optimize": False}
        times[:-1] = _whole_ticks(tick, len(times) - 1)
    options |= {"append_images": pictures[1:], "duration": times, "loop": 0}
    with atomic_path(path, path.suffix) as temporary:
        kind = path.suffix[1:].upper()
        pictures[0].save(temporary, format=kind, save_all=True, **options)
    return path


def _whole_ticks(tick: int, count: int) -> list[int]:
    """Returns times, ms, in steps of a GIF's 10 ms, whose sum is that of `tick`."""
    ends = tick * np.arange(count + 1) / 10
    return (10 * np.diff(ends.round().astype(int))).tolist()


def _one_palette(pictures: list[Image.Image]) -> list[Image.Image]:
    """Reduces pictures to 256 colours that all of them share."""
    both = pictures[len(pictures) // 2], pictures[-1]
    sample = np.hstack([np.asarray(picture) for picture in both])
    palette = Image.fromarray(sample).quantize(256, Image.Quantize.MEDIANCUT)
    none = Image.Dither.NONE
    return [picture.quantize(palette=palette, dither=none) for picture in pictures]


def _frames(
    episode: Episode, surface: Any, width: int, steps: np.ndarray
) -> Iterator[np.ndarray]:
    """Yields RGB pictures (rows, columns, 3) uint8 of some states of an episode."""
    rough = ParallelProjection.of(surface.vertices, margin=_MARGIN).no_wider(_WIDEST)
    left = rough.shape[1] / rough.shape[0]  # width of the scene per height
    height = width / (left + 0.66)
    # One pixel of the glass for each of the film.
    pixels = rough.pixels * round(height) / rough.shape[0]
    projection = dataclasses.replace(rough, pixels=pixels)
    rest = glass(surface, projection)
    size, share = (width / _DPI, height / _DPI), left / (left + 0.66)
    figure = Picture(figsize=size, dpi=_DPI, facecolor="white")
    scene = figure.add_axes((0, 0, share, 1))
    beside = figure.add_axes((share + 0.01, 0.34, 0.98 - share, 0.64))
    below = figure.add_axes((share + 0.09, 0.1, 0.89 - share, 0.19))
    cursor, window = _draw_force(below, episode), None
    shown = {"unit": " pictures", "delay": _LONG_S, "disable": None}  # on a terminal
    for step in tqdm(steps.tolist(), "film", **shown):
        moment = Moment.of_episode(episode, surface, step)
        scene.clear()
        scene.axis("off")
        pane, now = rest, moment.surface
        if now is not surface:
            pane = glass(now, projection)
        drawing.draw_scene(scene, moment, projection, pane)
        time = float(episode.time[step] - episode.time[0])
        text = f"{episode.task}   {time:4.1f} s"
        if step == episode.steps:
            text += f"   {episode.termination.replace('_', ' ')}"
        scene.text(
            0.02, 0.985, text, transform=scene.transAxes, va="top", color="0.2",
            # In a small film the label must not run under the X-ray image.
            fontsize=np.clip(width / 65, 6.5, 10), fontweight="bold", zorder=10,
        )  # fmt: skip
        beside.clear()
        options = on_screen(moment.x_ray.options, **_NOISE)
        window = drawing.draw_fluoroscopy(beside, moment, options, step, window)
        beside.set_title("")
        cursor.set_xdata([time, time])
        figure.agg.draw()
        yield np.asarray(figure.agg.buffer_rgba())[..., :3].copy()


def _draw_force(axes: Any, episode: Episode) -> Any:
    """Draws the largest contact over time; returns the cursor."""
    force = episode.meta.get("wall_force_mean_max") or episode.wall_force_max
    time = episode.time[1:] - episode.time[0]
    force = 1e3 * np.asarray(force, dtype=np.float64)
    axes.fill_between(time, force, color=_FORCE_COLOUR, alpha=0.18, lw=0)
    axes.plot(time, force, color=_FORCE_COLOUR, lw=1.1)
    axes.set_xlim(0, time.max(initial=1e-3))
    axes.set_ylim(0, max(1.15 * force.max(initial=0.0), 1.0))
    axes.set_xlabel("s", fontsize=8, labelpad=0)
    axes.set_ylabel("contact, mN", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)
    return axes.axvline(0.0, color="0.2", lw=1.0)
