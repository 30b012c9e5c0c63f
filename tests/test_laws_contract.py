"""What a law is: no engine, no allocation, few parameters, and the same on a GPU."""

import ast
import importlib
import importlib.util
import pkgutil
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core import types

import cathsim_dmc
from cathsim_dmc import laws, suite
from cathsim_dmc.compiled import _Compiled, for_cuda, interpreted, law
from cathsim_dmc.laws import (
    bore,
    coaxial,
    coaxial_forces,
    compliance,
    contact,
    device,
    drive,
    field,
    hinges,
    motion,
    moving_contact,
    places,
    planes,
    sheath,
    springs,
    torsion,
    vectors,
    wall,
)
from cathsim_dmc.laws.blood import Blood, drag
from cathsim_dmc.simulation.warp import contact_kernels, moving_kernels, reduction
from cathsim_dmc.simulation.warp.contact_kernels import SCRATCH
from cathsim_dmc.simulation.warp.devices import NONE
from cathsim_dmc.simulation.warp.simulation import WarpSimulation
from cathsim_dmc.simulation.warp.worlds import Worlds

PACKAGE = Path(cathsim_dmc.__file__).parent
LAWS = sorted((PACKAGE / "laws").glob("*.py"))
MOST_PARAMETERS = 8
# Laws of several devices in each other run on the host, once in a control step.
ON_THE_HOST = ("sliding.",)
# Starred arguments in calls of the package. Lower it with what goes.
STARRED = 65
ALLOCATING = {"empty", "zeros", "ones", "full", "array", "copy", "concatenate"}
PLAIN = {"__future__", "cathsim_dmc", "collections", "math", "numpy", "typing"}
REAL, BITS = types.float64, types.int64


def functions(*folders):
    for folder in folders:
        for path in sorted((PACKAGE / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.FunctionDef):
                    yield path, node


def calls(node):
    return (each for each in ast.walk(node) if isinstance(each, ast.Call))


def test_laws_and_their_adapters_have_few_parameters():
    wrong = []
    for path, node in functions("laws", "collision"):
        given = node.args
        count = len(given.posonlyargs) + len(given.args) + len(given.kwonlyargs)
        # Compiled code calls an intrinsic without its first argument.
        count -= bool(given.args) and given.args[0].arg in ("self", "cls", "_")
        if count > MOST_PARAMETERS:
            wrong.append(f"{path.name}: {node.name} has {count}")
    assert not wrong


def test_laws_allocate_nothing():
    wrong = []
    for path, node in functions("laws"):
        decorators = {ast.unparse(each) for each in node.decorator_list}
        if not decorators & {"law", "inlined", "compiled"}:
            continue
        wrong += [
            f"{path.name}: {node.name} calls {ast.unparse(each.func)}"
            for each in calls(node)
            if ast.unparse(each.func).split(".")[-1] in ALLOCATING
        ]
    assert not wrong


def test_a_law_that_allocates_is_not_compiled():
    def allocating(count):
        return np.empty(count)

    with pytest.raises(Exception, match="returning of array|NRT"):
        law(allocating)(3)


def test_calls_of_the_package_name_what_they_pass():
    found = 0
    for path in PACKAGE.rglob("*.py"):
        for call in calls(ast.parse(path.read_text())):
            found += sum(isinstance(each, ast.Starred) for each in call.args)
    assert found <= STARRED


def test_laws_know_no_engine():
    for path in LAWS:
        names = {
            alias.name.split(".")[0]
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Import)
            for alias in node.names
        } | {
            (node.module or "").split(".")[0]
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.ImportFrom)
        }
        assert names <= PLAIN


@pytest.mark.parametrize("module", [path.stem for path in LAWS])
def test_a_law_may_have_the_name_of_an_attribute_that_it_reads(module):
    """As `sliding.settle`: a function is not replaced by itself without end."""
    for each in vars(importlib.import_module(f"cathsim_dmc.laws.{module}")).values():
        if isinstance(each, _Compiled):
            assert callable(interpreted(each))


def tube(radius=5e-3):
    """A straight bore of 60 mm along z, as the wall of a lumen would be."""
    line = np.array([2.0, 0, 0, 0, radius, 0, 0, 60e-3, radius])
    whole = np.zeros(0, np.int16)
    empty = field.FieldArrays(np.zeros(9), whole, np.zeros(0, np.int32), whole)
    return wall.Wall(True, empty, line)


def test_the_contact_law_needs_no_engine():
    """A capsule that overlaps the wall of a straight bore, turned by a frame."""
    radius, half = 0.8e-3, 3e-3
    here = (5e-3 - radius + 0.02e-3, 0.0, 30e-3)
    capsule = places.Capsule(here, (0.0, 0.0, 1.0), half, (False, True))
    given = contact.contact_law(tube(), radius, 0.0, 0.02, 0.008)
    still = (0.0, 0.0, 0.0)
    sweep = contact.sweep_of(capsule, given, still, still)
    scratch = contact.Scratch(np.empty(65), np.empty((planes.PLANES, 4)))
    out = np.full((planes.MOST, contact.CONTACT), np.nan)
    # Compilation for one capsule would take 4 s.
    found = interpreted(contact.contacts)(tube(), capsule, given, sweep, scratch, out)
    assert found == 1
    np.testing.assert_allclose(
        out[0], [-1, 0, 0, radius - 0.02e-3, half, 0], atol=1e-12
    )
    frame = np.eye(3).ravel()
    world = contact.world_contact(out[0], given, here, capsule.axis, frame)
    distance, point, towards = world
    assert distance == pytest.approx(-0.02e-3)
    assert towards == pytest.approx((1, 0, 0))
    np.testing.assert_allclose(point, [5.01e-3, 0, 30e-3 + half], atol=1e-12)


def rows(kind, axes):
    return types.Array(kind, axes, "C")


def named(kind, *fields):
    return types.NamedTuple(fields, kind)


def signatures():
    """Laws that call all others, with the types of their arguments."""
    one, two = rows(REAL, 1), rows(REAL, 2)
    short, whole = rows(types.int16, 1), rows(types.int32, 1)
    point, flags = types.UniTuple(REAL, 3), types.UniTuple(types.boolean, 2)
    arrays = named(field.FieldArrays, one, short, whole, short)
    a_wall = named(wall.Wall, types.boolean, arrays, one)
    capsule = named(places.Capsule, point, point, REAL, flags)
    given = named(contact.Law, *[REAL] * 3, *[types.boolean] * 2, REAL)
    sweep = named(contact.Sweep, point, point, REAL)
    course = named(motion.Course, *[REAL] * 9)
    several = named(motion.MotionParameters, *[one] * 8)
    scratch = named(contact.Scratch, one, two)
    moving = named(moving_contact.MovingScratch, one, two, two, one)
    carried = types.Tuple((one, course))
    bent = rows(types.complex128, 1)
    bends = named(hinges.Bends, bent, one)
    index, indices = rows(types.int32, 1), rows(BITS, 1)
    a_device = named(
        device.Device,
        *(two, two, two, two, two, indices, index, index, two, one, one, one, one),
        *(indices, indices, indices),
    )
    blood = named(Blood, *[REAL] * 5, two, one, one, two)
    touching = named(device.Contact, one, one, one, one)
    material = named(compliance.Material, REAL, REAL, REAL)
    rule = named(compliance.Law, one, one, REAL)
    links = named(compliance.Links, indices, one, one)
    servos = named(drive.Servos, *[indices] * 3, *[one] * 6)
    state = named(drive.State, two, two, two)
    told = named(drive.Told, two, two)
    shape = named(springs.Springs, one, one)
    guided = named(sheath.Joints, *[rows(BITS, 2)] * 3, *[one] * 3)
    free, of_model = named(sheath.Hinges, *[two] * 3), named(sheath.Hinges, *[one] * 3)
    memory = named(springs.Scratch, one, bends, two)
    return {
        contact.contacts: (a_wall, capsule, given, sweep, scratch, two),
        contact.contact_law: (a_wall, *[REAL] * 4),
        contact.end_caps: (point, point, REAL, point),
        contact.sweep_of: (capsule, given, point, point),
        contact.swept: (whole, two, one, types.int32, one, one, REAL),
        contact.world_contact: (one, given, point, point, one),
        moving_contact.moving_contacts: (
            *(a_wall, capsule, given, sweep, carried, moving, two),
        ),
        motion.nth_course: (several, BITS, REAL),
        motion.wall_velocity: (one, point),
        motion.to_rest: (one, course, two, two, two),
        motion.to_space: (one, course, two, two, two, one),
        motion.first_past: (two, two),
        field.depths: (arrays, two, types.boolean, one),
        field.gradients: (arrays, two, REAL, two),
        bore.bore_clearance: (one, point),
        vectors.into: (one, point),
        drag: (blood, REAL, a_device),
        springs.shape_torques: (shape, a_device, memory),
        hinges.unloaded_hinges: (bent, two),
        hinges.steered: (two, two, bends, two),
        compliance.share: (touching,),
        compliance.write_contacts: (
            *(one, material, links, types.UniTuple(rule, 2), two, two),
        ),
        drive.slip: (servos, state, two),
        sheath.hold: (guided, one, REAL, free, of_model, one),
        drive.follow: (servos, state, two, two, told, two),
    }


def coaxial_signatures():
    """The same of devices in each other, called by `sliding` on the host."""
    one, two, three = (rows(REAL, axes) for axes in (1, 2, 3))
    bent, bends = rows(types.complex128, 1), rows(types.complex128, 2)
    tables = named(coaxial.Tables, *[one] * 2, *[two] * 3)
    overlap = named(coaxial.Overlap, one, *[two] * 6)
    posture = named(coaxial.Posture, one, bent, two)
    sections = named(coaxial.Sections, one, one, two)
    links = named(coaxial.Links, *[one] * 4, two)
    memory = named(coaxial.Scratch, one, two, bent, bends)
    lumen = named(coaxial_forces.Lumen, one, one, REAL, REAL)
    rods = named(torsion.Rods, two, one)
    scratch = named(torsion.Scratch, *[one] * 8)
    return {
        coaxial.overlap: (one, tables, memory, overlap),
        coaxial.rest_angles: (two, two, bent),
        coaxial.links: (overlap, one, REAL, sections, links),
        coaxial_forces.restoring: (overlap, posture, memory, two, two),
        coaxial_forces.axial: (tables, overlap, posture, two, memory, two),
        coaxial_forces.pressure: (
            *(tables, overlap, posture, two, lumen, memory, two, one),
        ),
        coaxial_forces.wall_friction: (one, two, one, REAL, two),
        torsion.at_joints: (two, one, one, two),
        torsion.at_nodes: (three, one, one, three),
        torsion.turned: (two, one, rods, REAL, three, scratch, two),
    }


def laws_of_the_package():
    found = {}
    for module in pkgutil.iter_modules(laws.__path__):
        name = f"{laws.__name__}.{module.name}"
        for each in vars(importlib.import_module(name)).values():
            if isinstance(each, _Compiled) and each.__module__ == name:
                found[each] = f"{module.name}.{each.__name__}"
    return found


@pytest.fixture
def cuda(monkeypatch):
    """numba-cuda, as if there were a GPU of compute capability 9.0."""
    if importlib.util.find_spec("numba_cuda") is None:
        pytest.skip("needs numba-cuda, of the extra gpu")
    import numba.cuda
    from numba.cuda import compiler, dispatcher

    class Gpu:
        compute_capability = (9, 0)

    for module in (compiler, dispatcher):
        if hasattr(module, "get_current_device"):
            monkeypatch.setattr(module, "get_current_device", Gpu)
    return numba.cuda


@pytest.mark.slow
def test_every_law_compiles_for_a_gpu(cuda):
    """To PTX, which needs the compilers of the extra gpu and no GPU."""
    for root, arguments in (signatures() | coaxial_signatures()).items():
        made = for_cuda(root).py_func
        options = {"device": True, "cc": (9, 0), "abi": "numba"}
        ptx, _ = cuda.compile_ptx(made, arguments, **options)
        assert ".visible .func" in ptx and ".f64" in ptx, root.__name__
    names = laws_of_the_package().items()
    left = [name for each, name in names if "on_cuda" not in vars(each)]
    left = [name for name in left if not name.startswith(ON_THE_HOST)]
    assert not left, f"add signatures that call {left}"


@pytest.mark.slow
@pytest.mark.parametrize("vessel", ["rigid", "living"])
def test_threads_of_warp_compile_for_a_gpu(cuda, vessel):
    """What runs on Warp's arrays, with the arrays of a task."""
    pytest.importorskip("mujoco_warp")
    task = suite.make_task("type1_lcca", vessel=vessel)
    stepper = WarpSimulation(task, 2, device="cpu").stepper
    laws_ = stepper.contacts, stepper._passive
    world = Worlds(stepper._device, stepper._model, stepper._own, laws_, 1)
    wall_, added = stepper.contacts, world._reduction._added
    finding = [(contact_kernels.find, SCRATCH, wall_._scene)]
    if vessel == "living":
        shapes = moving_kernels.SCRATCH
        finding = [
            (moving_kernels.find_moving, shapes, wall_._moving),
            (moving_kernels.carry, shapes, wall_._carried),
        ]
    threads = [
        *finding,
        (contact_kernels.count, NONE, wall_._written),
        (contact_kernels.place, NONE, wall_._written),
        (reduction.add, NONE, added),
        *((each, NONE, given) for each, given in stepper._passive._calls),
    ]
    for thread, shapes, given in threads:
        own = types.Tuple([rows(REAL, len(shape)) for shape in shapes])
        arguments = BITS, own, numba.typeof(given)
        options = {"device": True, "cc": (9, 0), "abi": "numba"}
        ptx, _ = cuda.compile_ptx(for_cuda(thread).py_func, arguments, **options)
        assert ".visible .func" in ptx, thread.__name__
