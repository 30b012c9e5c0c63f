"""`cathsim phantom import`, `generate` and `check`."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Literal

from tyro import conf
from tyro.extras import SubcommandApp

from cathsim_dmc.cli.options import print_json, show

phantoms = SubcommandApp()


@phantoms.command(name="import")
def import_phantom(
    mesh: Annotated[Path, conf.Positional],
    /,
    out: Path,
    centreline: tuple[Path, ...] = (),
    name: str | None = None,
    units: Literal["mm", "cm", "m"] | None = None,
    frame: Literal["LPS", "RAS"] = "LPS",
    axes: str | None = None,
    inlet: tuple[float, float, float] | None = None,
    rename: tuple[str, ...] = (),
    wall: Literal["prisms", "coacd"] = "prisms",
    threshold_mm: float | None = None,
    cache: bool = True,
) -> int:
    """Turn the surface of a lumen into an anatomy.

    Args:
        mesh: Surface of the lumen: OBJ, STL, PLY or VTP; ends open or capped.
        out: Directory of the anatomy.
        centreline: 3D Slicer curves (.mrk.json) or CSV files, one per branch; without
            any they are computed from the surface.
        name: Name of the anatomy.
        units: Unit of mesh, CSV centrelines and inlet; guessed if not given.
        frame: Frame of mesh, CSV centrelines and inlet.
        axes: Where +x, +y and +z of that frame point in the patient, for a scan that
            does not stand upright: three of L, R, A, P, S, I, such as ILA.
        inlet: Where the device enters: a free end, or a place to cut the lumen at.
        rename: Names of computed branches, each as computed=wanted.
        wall: Pieces near the surface, or CoACD's coarse ones (needs the extra coacd).
        threshold_mm: CoACD's concavity of a piece; 3.5 by default.
        cache: Whether to use what was imported from the same files before.
    """
    from cathsim_dmc.anatomy.scan import report
    from cathsim_dmc.anatomy.scan.cache import cached_import
    from cathsim_dmc.anatomy.scan.importer import import_scan

    changes = dict(_change(text) for text in rename)
    notes: list[str] = []
    with _progress() as progress:
        anatomy = (cached_import if cache else import_scan)(
            mesh,
            centreline,
            units=units,
            mesh_frame=frame,
            axes=axes,
            name=name or out.name,
            inlet=inlet,
            rename=changes,
            wall=wall,
            threshold=None if threshold_mm is None else threshold_mm * 1e-3,
            progress=progress,
            notes=notes,
        )
        progress("wall: measuring it")
        figures = report.describe(anatomy)
    anatomy.save(out)
    print_json({"directory": str(out), "notes": notes, **figures})
    return 0


def _change(text: str) -> tuple[str, str]:
    old, equals, new = text.partition("=")
    if not equals or not old or not new:
        raise ValueError(f"rename is {text!r}; give computed=wanted, e.g. branch_1=lra")
    return old, new


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[str], None]]:
    """Lines of an import as a bar on standard error; notes stay above it."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from cathsim_dmc.anatomy.scan.importer import SHARES

    console = Console(stderr=True, soft_wrap=True)
    columns = (BarColumn(30), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("mesh: reading", total=1.0)

        def show(text: str) -> None:
            step, _, rest = text.partition(": ")
            if step == "note" or not console.is_terminal:
                console.print(text, markup=False, highlight=False)
            if step in SHARES:
                bar.update(task, completed=SHARES[step], description=text[:60])

        yield show


@phantoms.command
def generate(
    kind: Annotated[str, conf.Positional],
    /,
    out: Path,
    seed: int | None = None,
) -> int:
    """Generate an arch.

    Args:
        kind: A named arch such as type1, type2, type3, bovine; with a seed, one drawn
            from the anatomical distributions of that type.
        out: Directory of the anatomy.
        seed: Draw the arch at random.
    """
    import numpy as np

    from cathsim_dmc.anatomy.arch import arch

    if kind not in arch.ARCHES:
        raise ValueError(f"no arch {kind!r}; there are {', '.join(arch.ARCHES)}")
    if seed is None:
        anatomy = arch.load(kind)
    else:
        drawn = {"type1": "I", "type2": "II", "type3": "III"}.get(kind)
        parameters = arch.sample(
            np.random.RandomState(seed), drawn, bovine=kind == "bovine"
        )
        anatomy = arch.build_arch(parameters, name=f"{kind}-{seed}")
    anatomy.save(out)
    print(f"{len(anatomy.wall)} wall pieces, goals {', '.join(anatomy.goals)}: {out}")
    return 0


@phantoms.command
def check(phantom: Annotated[str, conf.Positional], /, json: bool = False) -> int:
    """Check an anatomy: intrusion and coverage of its wall, patency of its vessels.

    Args:
        phantom: Directory of an anatomy, or the name of an arch.
        json: Print one JSON object and nothing else.
    """
    from cathsim_dmc import suite, validation

    anatomy = suite.load_anatomy(phantom)
    return show(validation.validate_anatomy({anatomy.name: anatomy}), json)
