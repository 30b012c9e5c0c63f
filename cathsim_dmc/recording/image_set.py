"""A dataset of labelled fluoroscopy: a folder with a split by anatomy.

    OUT/README.md                      data card
    OUT/dataset.json                   options, and the anatomies of each split
    OUT/{train,val,test}/NAME.h5       sequences in one anatomy, see `sequences`
    OUT/annotations/{…}.json           labels in the format of COCO

The file of an anatomy is complete or missing; an interrupted run continues with the
missing ones. The same options give the same files, byte by byte.
"""

import _thread
import concurrent.futures
import contextlib
import dataclasses
import json
import multiprocessing
import os
import signal
import tempfile
import threading
import time
import types
from collections.abc import Callable, Generator, Sequence
from multiprocessing import connection
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import __version__, bounds, cluster, extras, files
from cathsim_dmc.anatomy import Anatomy, phantoms
from cathsim_dmc.anatomy.builder import ACCESSES
from cathsim_dmc.recording import coco, sequences
from cathsim_dmc.recording.sequences import KEYPOINTS, KITS, ImageSetOptions
from cathsim_dmc.tasks.anatomies import load_anatomy

SPLITS = {"train": "train", "val": "train", "test": "test"}  # split: set of arches
_TRIES = 8  # candidates that are tried in turn until a device fits
_FORMAT = "cathsim-image-set"
_TICK = 0.01  # s, resolution of `os.times`
_LAST = 1.0  # s that a process has to remove unfinished files
Labels = dict[str, list[Any]]  # as `coco.labels` returns them


@dataclasses.dataclass(frozen=True)
class _Shard:
    """One anatomy of a dataset."""

    folder: Path
    split: str
    number: int
    candidates: tuple[int, ...]
    options: ImageSetOptions
    anatomy: str | None = None  # given in place of the candidates, random arches

    @property
    def path(self) -> Path:
        return self.folder / self.split / f"{self.split}_{self.number:03d}.h5"

    @property
    def seed(self) -> list[int]:
        return [self.options.seed, list(SPLITS).index(self.split), self.number]


def write(
    out: str | os.PathLike[str],
    options: ImageSetOptions | None = None,
    *,
    processes: int | None = None,
    say: Callable[[str], None] = lambda text: None,
    on_cluster: bool = False,
) -> dict[str, Any]:
    """Writes a dataset, or the missing part of an interrupted one.

    Args:
        out: folder, which must not exist unless a run with these options has begun it.
        processes: number of processes, None for one per core; with more than one, a
            script must guard its main part (`if __name__ == "__main__"`).
        say: receives a line for each anatomy.
        on_cluster: whether the machines of a Ray cluster simulate, a processor for each
            anatomy; the files are copied to `out`. They are the same, byte by byte, on
            processors of one kind.

    Returns:
        "path" of the dataset; "frames", number of images of each split, with those of
        earlier runs; of this run "new", number of images, "seconds", wall time, and
        "processor", time of all processes of this machine, s; "frames_per_second" and
        "frames_per_processor_second", new images per second of either time.

    Raises:
        ValueError: if an option is wrong, an anatomy does not exist or is given twice,
            or the folder is that of other options.
        OSError: if the directory around `out` does not exist, or `out` is read-only.
        ModuleNotFoundError: if h5py is not installed.
    """
    extras.require("gym", "h5py")  # before hours of simulation

    out, options = files.as_path("out", out), options or ImageSetOptions()
    count = os.cpu_count() or 1
    if processes is not None:
        count = bounds.whole("processes", processes, 1, bounds.MOST_THREADS)
    if on_cluster:
        cluster.connect()
    _begin(out, options)
    start, used = time.monotonic(), sum(os.times()[:4])
    shards, labels, new = _shards(out, options), [], 0
    if on_cluster:
        new += _simulate_on_cluster(shards, say)
    with contextlib.closing(_over(_write_shard, shards, count)) as written:
        for rows, line, own in written:
            labels.append(own)
            new += rows
            if line:
                say(line)
    frames = _label(out, shards, labels)
    files.write_text(out / "README.md", _card(options, frames))
    took, spent = time.monotonic() - start, sum(os.times()[:4]) - used
    return {
        "path": str(out), "frames": frames, "new": new, "seconds": took,
        "processor": spent, "frames_per_second": new / took,
        "frames_per_processor_second": new / max(spent, _TICK),
    }  # fmt: skip


def _others(begun: str, asked: str) -> str:
    """Returns the values of a dataset.json that differ from another, in brackets."""
    with contextlib.suppress(ValueError, TypeError, LookupError):  # edited by hand
        there, here = ({**v, **v["options"]} for v in map(json.loads, (begun, asked)))
        names = [n for n in here if n != "options" and there[n] != here[n]]
        return f" ({', '.join(f'{name} {there[name]}' for name in names)})"
    return ""


def _begin(out: Path, options: ImageSetOptions) -> None:
    """Makes the folders; ValueError if `out` has other content or other options."""
    chosen = {name: one for name, one in vars(options).items() if name != "anatomy"}
    about = {"format": _FORMAT, "version": __version__, "options": chosen}
    if options.anatomy:  # a folder may be another anatomy when the run goes on
        chosen["anatomy"] = list(options.anatomy)
        about["lumens"] = _lumens(options.anatomy)
    text = json.dumps(about, indent=2) + "\n"
    files.require_folder(out if out.exists() else out.parent)
    described = out / "dataset.json"
    if out.exists() and not described.is_file() and any(out.iterdir()):
        raise ValueError(f"{out} is not empty and no dataset; choose another folder")
    if described.is_file() and (begun := files.read_text(described)) != text:
        raise ValueError(
            f"{described} says that {out} was begun with other options or another "
            f"version{_others(begun, text)}; give those, or another folder"
        )
    files.require_folder(out, make=True)
    # Written first: an interrupted run can only continue in a folder with this file.
    files.write_text(described, text)
    for name in ("annotations", *SPLITS):
        files.require_folder(out / name, make=True)


def _lumens(given: Sequence[str]) -> list[list[str]]:
    """Returns the digests of anatomies, one for each way into a phantom.

    Raises:
        ValueError: there is no such anatomy, it has no branch to go to, or two are one,
            which would be in two splits.
    """
    found: dict[str, str] = {}
    lumens = []
    for name in given:
        ways = ACCESSES if name in phantoms.PHANTOMS else (None,)
        entered = [load_anatomy(name, way) for way in ways]
        if not entered[0].goals:
            raise ValueError(f"the anatomy {name} has no goal; import it with branches")
        own = [one.digest for one in entered]
        for digest in own:
            if digest in found:
                raise ValueError(
                    f"the anatomies {found[digest]} and {name} are one lumen, which "
                    "would be in two splits or twice in one; leave one of them out"
                )
        found |= dict.fromkeys(own, name)
        lumens.append(own)
    return lumens


def _shards(out: Path, options: ImageSetOptions) -> list[_Shard]:
    from cathsim_dmc.anatomy.arch import arch

    if options.anatomy:
        places = [
            (split, number)
            for split, count in zip(SPLITS, options.anatomies, strict=True)
            for number in range(count)
        ]
        return [
            _Shard(out, split, number, (), options, _absolute(name))
            for (split, number), name in zip(places, options.anatomy, strict=True)
        ]
    shards, taken = [], dict.fromkeys(SPLITS.values(), 0)
    for (split, name), count in zip(SPLITS.items(), options.anatomies, strict=True):
        random, size = np.random.RandomState(options.seed), len(arch.arch_set(name))
        order = random.permutation(size)
        # In a large set, candidates lie far apart, so that anatomies share none.
        ahead = np.arange(_TRIES) * (100 if size >= 100 * _TRIES else 0)
        for number in range(count):
            chosen = tuple(order[(taken[name] + ahead) % size].tolist())
            shards.append(_Shard(out, split, number, chosen, options))
            taken[name] += 1
    return shards


def _absolute(name: str) -> str:
    """Returns the name of a phantom, or a path that holds in all processes."""
    return name if name in phantoms.PHANTOMS else str(Path(name).absolute())


def _write_shard(shard: _Shard) -> tuple[int, str, Labels]:
    """Writes one anatomy if missing; returns new frames, a line of text, labels."""
    rows, line = (0, "") if shard.path.exists() else _simulate_shard(shard)
    return rows, line, coco.labels(shard.path, shard.number, shard.options.pictures)


def _simulate_shard(shard: _Shard) -> tuple[int, str]:
    random, faults = np.random.RandomState(shard.seed), []
    # Of a given anatomy, which has no candidates, only kit, access and goal differ.
    for place in shard.candidates or range(_TRIES):
        kit = list(KITS)[random.randint(len(KITS))]
        access = ACCESSES[random.randint(len(ACCESSES))]
        anatomy, access = _entered(shard, place, access)
        branches = [goal for goal in anatomy.goals if goal != "descending"]
        branches = branches or list(anatomy.goals)
        goal = branches[random.randint(len(branches))]
        drawn = [*shard.seed, random.randint(2**31)]
        try:
            states = sequences.simulate(anatomy, goal, kit, shard.options, drawn)
        except ValueError as error:  # the device does not fit
            faults.append(str(error))
            continue
        rows = sequences.write(
            shard.path, anatomy, states, shard.options, [*drawn, 1], name=anatomy.name,
            split=shard.split, access=access, goal=goal, devices=kit,
        )  # fmt: skip
        about = f"{anatomy.name}, {access}, {kit}, {rows} frames"
        return rows, f"{shard.path.name}: {about}"
    raise RuntimeError(f"{shard.path.name}: no device fits; the last: {faults[-1]}")


def _entered(shard: _Shard, place: int, access: str) -> tuple[Anatomy, str]:
    """Returns the anatomy of a file and its access, "own" for the inlet of a scan."""
    from cathsim_dmc.anatomy.arch import arch

    if shard.anatomy is None:
        seeds = arch.arch_set(SPLITS[shard.split])
        return arch.build_seed(seeds[place], access=access), access
    if shard.anatomy in phantoms.PHANTOMS:
        return load_anatomy(shard.anatomy, access), access
    return load_anatomy(shard.anatomy), "own"


def _over(
    work: Callable[[Any], Any], jobs: list[Any], processes: int
) -> Generator[Any, None, None]:
    """Yields results in order; processes end with the generator and with this one."""
    if processes == 1 or len(jobs) < 2:
        yield from map(work, jobs)
        return
    context = multiprocessing.get_context("spawn")
    workers, (end, held) = min(processes, len(jobs)), context.Pipe(duplex=False)
    with (
        end,
        held,
        concurrent.futures.ProcessPoolExecutor(
            workers, context, _end_with, initargs=(end,)
        ) as pool,
    ):
        try:
            yield from pool.map(work, jobs)
        except (KeyboardInterrupt, GeneratorExit):
            held.close()  # the executor would wait for all that its processes have
            raise


def _end_with(end: Any) -> None:
    """Ends this process when the other end of a pipe closes, as with its process.

    Ctrl-C, which all processes of a terminal get, is left to that process.
    """
    closed = threading.Event()

    def interrupt(_number: int, _frame: types.FrameType | None) -> None:
        if closed.is_set():
            raise KeyboardInterrupt

    def watch() -> None:
        connection.wait([end])
        closed.set()
        _thread.interrupt_main()  # removes unfinished files
        time.sleep(_LAST)
        os._exit(1)

    signal.signal(signal.SIGINT, interrupt)
    threading.Thread(target=watch, daemon=True).start()


def _simulate_on_cluster(shards: list[_Shard], say: Callable[[str], None]) -> int:
    """Simulates the missing anatomies on a cluster; returns the count of new frames."""
    missing, new = [shard for shard in shards if not shard.path.exists()], 0
    for number, (rows, line, data) in cluster.over(_simulated, missing):
        files.write_bytes(missing[number].path, data)
        new += rows
        say(line)
    return new


def _simulated(shard: _Shard) -> tuple[int, str, bytes]:
    """Simulates one anatomy; returns frames, a line of text, the bytes of its file."""
    with tempfile.TemporaryDirectory() as folder:
        own = dataclasses.replace(shard, folder=Path(folder))
        own.path.parent.mkdir()
        rows, line = _simulate_shard(own)
        return rows, line, own.path.read_bytes()


def _label(out: Path, shards: list[_Shard], labels: list[Labels]) -> dict[str, int]:
    """Writes the labels of each split; returns the numbers of images by split."""
    frames = {}
    for split in SPLITS:
        joined: dict[str, Any] = {
            "info": {"description": f"cathsim_dmc {__version__}, {split}"},
            "categories": coco.CATEGORIES, "images": [], "annotations": [],
        }  # fmt: skip
        for shard, part in zip(shards, labels, strict=True):
            if shard.split == split:
                for name, rows in part.items():
                    joined[name] += rows
        files.write_text(out / "annotations" / f"{split}.json", json.dumps(joined))
        frames[split] = len(joined["images"])
    return frames


def _card(options: ImageSetOptions, frames: dict[str, int]) -> str:
    counts = zip(frames.items(), options.anatomies, strict=True)
    rows = [f"| {name} | {some} | {n} |" for (name, n), some in counts]
    held = """Train and val hold random aortic arches of all types, test
normal arches of the types I and II of a set that nothing is trained on."""
    if options.anatomy:
        named = {split: "" for split in SPLITS}
        for shard in _shards(Path(), options):
            named[shard.split] += f", {Path(shard.anatomy or '').name}"
        parts = (f"{split}: {names[2:] or 'none'}" for split, names in named.items())
        held = f"The anatomies: {'; '.join(parts)}."
    return f"""# Simulated fluoroscopy of endovascular devices

Written by `cathsim dataset` of cathsim_dmc {__version__}; the options are in
`dataset.json`. Its page docs/dataset.md says what is drawn and what the arrays are.
Licence: that of cathsim_dmc, Apache-2.0.

| split | anatomies | images |
|---|---|---|
{chr(10).join(rows)}

No anatomy is in two splits. {held}

- Images: {options.size} x {options.size}, 8 bits, dark is opaque, quantum noise.
- Keypoints: {", ".join(KEYPOINTS)}. Those outside the image are absent (0), ostia
  without contrast labelled but not visible (1).
- Frame: patient, LPS, m. `camera_matrix` takes (x, y, z, 1) to (column w, row w, w);
  whole numbers are the centres of pixels.

For: detection, segmentation, tracking and reconstruction of devices, before real
images. Not for: clinical use, or claims of performance without real images. There are
no bones, no other organs, no scatter and no motion of the table; vessels are smooth
tubes.
"""
