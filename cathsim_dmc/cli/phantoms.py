"""`cathsim phantom import`, `build`, `generate`, `check` and `export`."""

import shlex
import sys
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal

from tyro import conf
from tyro.extras import SubcommandApp

from cathsim_dmc import bounds, files, style
from cathsim_dmc.anatomy import phantoms as shipped
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.arch import arch, sampler
from cathsim_dmc.anatomy.scan.importer import import_scan
from cathsim_dmc.anatomy.scan.mesh import stem
from cathsim_dmc.anatomy.scan.places import describe
from cathsim_dmc.anatomy.tree_file import read_tree
from cathsim_dmc.cli.options import (
    Json,
    print_json,
    require_png,
    say,
    show,
    told_of_replaced,
)
from cathsim_dmc.entities import devices
from cathsim_dmc.pictures.anatomies import anatomy_figure

phantoms = SubcommandApp()
# Values of an option that takes several, and may be given again.
_Paths = Annotated[tuple[tuple[Path, ...], ...], conf.UseAppendAction]
_Numbers = Annotated[tuple[tuple[int, ...], ...], conf.UseAppendAction]
_Words = Annotated[tuple[tuple[str, ...], ...], conf.UseAppendAction]
_FIRST = ("lcca", "bca")  # goals that are tried first
_FILE, _PICTURE = "anatomy.npz", "check.png"  # an anatomy, and its three views


@phantoms.command(name="import")
def import_phantom(
    mesh: Annotated[Path, conf.Positional],
    /,
    out: Path | None = None,
    centreline: _Paths = (),
    name: str | None = None,
    units: Literal["mm", "cm", "m", "um", "inch"] | None = None,
    frame: Literal["LPS", "RAS"] | None = None,
    axes: str | None = None,
    label: _Numbers = (),
    inlet: tuple[float, float, float] | None = None,
    heart: tuple[float, float, float] | None = None,
    rename: _Words = (),
    device: str | None = None,
) -> int:
    """Turn the surface of a lumen into an anatomy.

    The output ends with the commands to run next.

    Args:
        mesh: Surface of the lumen: OBJ, STL, PLY, VTP or VTK; ends open or capped. Or a
            label map: NIfTI, NRRD or MHA, whose unit and frame are its own.
        out: Directory of the anatomy; by default the file's name without its ending.
        centreline: 3D Slicer curves (.mrk.json) or CSV files, one per branch, or VMTK's
            centrelines (.vtp); without any they are computed from the surface.
        name: Name of the anatomy.
        units: Unit of a surface, and of CSV centrelines, inlet and heart; guessed if
            not given. Of a label map only where its header is wrong or names none.
        frame: Frame of a surface, and of CSV centrelines, inlet and heart; by default
            the one that the file names (as 3D Slicer writes it), else LPS.
        axes: Of a scan that does not stand upright: where +x, +y and +z of that frame
            point in the patient, three of L, R, A, P, S, I, such as ILA; or nine
            numbers, the patient's left, back and head as directions in that frame.
        label: Values of a label map that are the lumen.
        inlet: Where the device enters, x y z in unit and frame of the surface: a free
            end, or a point at which the lumen is cut.
        heart: Point near the end of the aorta at the heart, like `inlet`; found if not
            given.
        rename: Names of computed vessels, each as computed=wanted.
        device: Device of the library (`cathsim list --devices`) that must fit through
            the vessels; by default a 5 Fr catheter, or the thinnest device if that does
            not fit.
    """
    bore = None if device is None else devices.get(device, "--device")
    if out is None:
        out = Path(stem(mesh))
        # The import itself reports a missing file.
        if mesh.is_file() and out.exists() and not (out / _FILE).is_file():
            raise ValueError(
                f"{out} exists and is no anatomy; give a directory (--out)"
            )
    wishes = tuple(chain.from_iterable(rename))
    changes = [text.partition("=") for text in wishes]
    for old, _, new in changes:
        if not (old and new):
            raise ValueError(
                f"rename is {wishes}; give computed=wanted, e.g. branch_1=lra"
            )
    _require_place(out)  # checked first: the import would be lost
    notes: list[str] = []
    anatomy = import_scan(
        mesh, tuple(chain.from_iterable(centreline)), units=units, mesh_frame=frame,
        axes=axes, labels=tuple(chain.from_iterable(label)),
        name=name or out.name, inlet=inlet, heart=heart, progress=say, notes=notes,
        rename={old: new for old, _, new in changes}, device=bore,
    )  # fmt: skip
    _save(anatomy, out)
    style.save(anatomy_figure(anatomy), out / _PICTURE)
    commands = _next_commands(anatomy, out, device)
    where = {"directory": str(out), "picture": str(out / _PICTURE), "notes": notes}
    radius = () if bore is None else (bore.outer_radius,)
    print_json({**where, **describe(anatomy, *radius), "next": commands})
    say("\n  ".join(("next:", *commands)))
    return 0


def _require_place(out: Path) -> None:
    """Raises an error if a folder cannot be written or has the name of a phantom."""
    if str(out) in shipped.PHANTOMS:
        raise ValueError(
            f"the directory would be called {str(out)!r}, as a phantom is, which tasks "
            f"would take instead; give another one (--out), such as patients/{out}"
        )
    files.require_file(out / _FILE, later=True)


def _save(anatomy: Anatomy, out: Path) -> None:
    with told_of_replaced([out / _FILE]):
        files.write_result(out, anatomy.save, f"the anatomy {anatomy.name}")
        (out / _PICTURE).unlink(missing_ok=True)  # of what was there before


def _next_commands(anatomy: Anatomy, out: Path, device: str | None) -> list[str]:
    """Returns the commands after an import: an evaluation, and one for the picture.

    The policy is the navigator for the device that it steers, and push for others.
    """
    picture = shlex.join([sys.executable, "-m", "webbrowser", str(out / _PICTURE)])
    if not anatomy.goals:
        return [picture]
    goal = next((name for name in _FIRST if name in anatomy.goals), None)
    goal = goal or next(iter(anatomy.goals))
    narrow = float(anatomy.route(goal).radii.min())
    if device is None and narrow < devices.STEERABLE_5F.outer_radius:
        device = "wire_014_micro"  # the device that the import checks in this case
    own = device in (None, devices.STEERABLE_5F.name)
    policy = "pretrained:navigator" if own else "push"
    command = ["cathsim", "eval", policy, "--anatomy", str(out), "--goal", goal]
    command += ["--episodes", "10"]
    if device is not None and not own:
        command += ["--device", device]
    return [shlex.join([*command, "--no-baseline"]), picture]


@phantoms.command
def build(
    tree: Annotated[Path, conf.Positional], /, out: Path, access: str | None = None
) -> int:
    """Build an anatomy around centrelines.

    Args:
        tree: Vessel tree in JSON: centrelines, radii, parents, inlets, goals
            (docs/anatomy_files.md has the format).
        out: Directory of the anatomy.
        access: Inlet in the file at which the device enters; by default the first.
    """
    _require_place(out)
    anatomy = read_tree(tree).build(access)
    _save(anatomy, out)
    print(f"{anatomy.name}: goals {', '.join(anatomy.goals)}: {out}")
    return 0


@phantoms.command
def generate(
    kind: Annotated[str, conf.Positional],
    /,
    out: Path,
    seed: int | None = None,
    variant: str = "normal",
    neck: bool = False,
    index: int | None = None,
    access: str = "ascending",
) -> int:
    """Generate an anatomy: a named phantom, or a random arch.

    Args:
        kind: A named phantom such as type1, simple1, bovine; I, II or III for a random
            arch of that type; train, test, test_variants, neck or test_neck for an arch
            of that set.
        out: Directory of the anatomy.
        seed: Seed of a random arch of a type.
        variant: Variant of the branches of a random arch of a type: normal,
            bovine_trunk, bovine_branch or aberrant.
        neck: Whether a random arch of a type has the arteries of neck and arms.
        index: Index of an arch in its set.
        access: End of the aorta that the device enters, ascending or descending.
    """
    needs = dict.fromkeys(shipped.PHANTOMS) | dict.fromkeys(arch.SETS, "index")
    needs |= dict.fromkeys(sampler.DROP_RANGES, "seed")
    if kind not in needs:
        raise ValueError(f"no phantom, type or set {kind!r}; there are {[*needs]}")
    for option, value in {"seed": seed, "index": index}.items():
        if (value is not None) != (option == needs[kind]):
            wanted = f"--{needs[kind]}" if needs[kind] else "neither --seed nor --index"
            raise ValueError(f"{kind!r} takes {wanted}; --{option} is {value}")
    if needs[kind] != "seed" and (neck or variant != "normal"):
        wrong = "--neck is given" if neck else f"--variant is {variant!r}"
        raise ValueError(f"{wrong}, which only I, II and III take; leave it out")
    _require_place(out)
    if seed is not None:
        bounds.seed("seed", seed)
        anatomy = arch.build_seed(
            arch.ArchSeed(seed, kind, variant, neck), access=access
        )
    elif index is not None:
        arches = arch.arch_set(kind)
        bounds.whole("index", index, 0, len(arches) - 1)
        anatomy = arch.build_seed(arches[index], access=access)
    else:
        anatomy = shipped.load(kind, access=access)
    _save(anatomy, out)
    print(f"{anatomy.name}: goals {', '.join(anatomy.goals)}: {out}")
    return 0


@phantoms.command
def check(
    phantom: Annotated[str, conf.Positional],
    /,
    figure: Path | None = None,
    json: Json = False,
) -> int:
    """Check an anatomy and measure its shape.

    Checks surface, field of the lumen, passage of the device, goals; measures type of
    the arch, diameters, take-offs, curvature.

    Args:
        phantom: Directory of an anatomy, or the name of a phantom.
        figure: PNG of three views; by default check.png in the directory of the
            anatomy.
    """
    # Not at the top: an import of a scan needs none of the simulation.
    from cathsim_dmc.tasks.anatomies import load_anatomy
    from cathsim_dmc.validation.wall import validate_anatomy

    if figure is None and phantom not in shipped.PHANTOMS and Path(phantom).is_dir():
        figure = Path(phantom) / _PICTURE
    if figure is not None:
        require_png(figure, later=True)
    anatomy = load_anatomy(phantom)
    report = validate_anatomy(anatomy)
    code = show(report, json)
    if not json:
        print_json(report.findings[anatomy.name]["measures"])
    if figure is not None:
        style.save(anatomy_figure(anatomy), figure)
        say(f"three views: {figure}")
    return code


@phantoms.command
def export(
    phantom: Annotated[str, conf.Positional],
    /,
    out: Path,
    wall: Literal["merged", "prisms", "coacd"] = "merged",
) -> int:
    """Write an anatomy as MJCF with convex wall pieces, for other engines.

    Args:
        phantom: Directory of an anatomy, or the name of a phantom.
        out: File of the model, ending in .xml.
        wall: Pieces of the wall: prisms on the triangles of the surface, merged or as
            they are; or those of CoACD (extra `export`), which intrude farther.
    """
    # Not needed by an import.
    from cathsim_dmc.anatomy import export as exported
    from cathsim_dmc.tasks.anatomies import load_anatomy

    files.require_file(out)
    exported.check_wall(wall)
    with told_of_replaced([out]):
        found = exported.write_mjcf(load_anatomy(phantom), out, wall)
    print_json({"file": str(out), **found})
    return 0
