"""Who may import whom, what is heavy, and what an import may not do."""

import ast
import functools
import graphlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import cathsim_dmc

PACKAGE = Path(cathsim_dmc.__file__).parent
NAME = "cathsim_dmc"

BELOW = {
    "files",
    "file_maps",
    "locks",
    "bounds",
    "json_options",
    "style",
    "extras",
    "compiled",
    "compiled_ahead",
    "compiled_cache",
    "compiled_parts",
    "cluster",
    "rows",
}
_TASK = {"anatomy", "laws", "collision", "imaging", "entities", "physics", "tasks"}
_FACE = _TASK | {"suite", "simulation"}
# Part of the package -> parts that it may import. Arrows point one way: what stands
# further up knows what stands further down, never the other way round.
ALLOWED = {
    "__init__": set(),
    # Below everything: how files are written, what values may be, how figures look,
    # how loops are compiled and kept, how work is spread over machines and cores.
    "files": set(),
    "file_maps": set(),
    "locks": set(),
    "bounds": set(),
    "json_options": set(),
    "style": set(),
    "extras": set(),
    "compiled": {"compiled_cache", "compiled_parts"},
    "compiled_ahead": set(),
    "compiled_cache": {"compiled_ahead"},
    "compiled_parts": set(),
    "cluster": set(),
    "rows": set(),
    # Laws know no engine and no task.
    "laws": set(),
    "anatomy": {"laws"},
    "imaging": {"anatomy", "laws"},
    "collision": {"anatomy", "laws"},
    "entities": {"anatomy", "collision", "imaging", "laws"},
    "physics": {"anatomy", "collision", "laws", "entities"},
    "tasks": {"anatomy", "collision", "imaging", "laws", "entities", "physics"},
    "suite": _TASK,
    "first_load": {"collision", "physics", "suite"},
    "simulation": _TASK | {"suite"},
    "policies": _FACE,
    "recording": _FACE,
    "analysis": _FACE | {"recording", "validation", "policies"},
    "validation": _FACE | {"recording", "policies"},
    "pictures": _FACE | {"recording", "policies"},
    "agents": _FACE | {"recording", "analysis", "policies"},
    # The faces to the outside: everything but each other.
    "gym": _FACE,
    "play": _FACE | {"recording", "policies"},
    "bridge": _FACE,
    "cli": _FACE
    | {"recording", "analysis", "validation", "policies", "agents"}
    | {"play", "pictures", "bridge"},
}
_TORCHRL_FACE = ("simulation/torchrl.py", "simulation/environments.py")
# Package -> files that may import it, wherever in the file the import stands.
CONFINED = {
    "torch": {*_TORCHRL_FACE, "agents/"},
    "torchrl": {*_TORCHRL_FACE, "agents/"},
    "tensordict": {*_TORCHRL_FACE, "agents/"},
    "safetensors": {"agents/pretrained.py"},
    "huggingface_hub": {"agents/hub.py"},
    "onnx": {"agents/onnx_export.py"},
    "onnxruntime": {"agents/onnx_selftest.py"},
    "pygame": {"play/hands.py"},
    "pyspacemouse": {"play/hands.py"},
    "ray": {"cluster.py", "agents/ray_source.py"},
    "rerun": {"recording/"},
    "igl": {"anatomy/"},
    "llvmlite": {"collision/"},
    "fast_simplification": {"anatomy/scan/topology.py"},
    "numba": {
        *("compiled.py", "compiled_cache.py", "compiled_parts.py"),
        *("collision/", "simulation/warp/"),
    },
    "gymnasium": {"simulation/gymnasium.py", "gym.py"},
    "tyro": {"cli/"},
}
# Slow to import: only within functions, unless a module is itself loaded late.
LATE = ("trimesh", "skimage", "matplotlib", "rerun", "torch", "torchrl", "numba", "igl")
LATE += ("ray",)


def modules():
    return sorted(PACKAGE.rglob("*.py"))


@functools.cache
def imported(path):
    """Names of the modules that a file imports, wherever in it the import stands."""
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: relative import; write it in full"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names


def part_of(module):
    """Part of the package that a dotted name lies in, or None for other packages."""
    names = module.split(".")
    if names[0] != NAME:
        return None
    return names[1] if len(names) > 1 else "__init__"


def home(path):
    relative = path.relative_to(PACKAGE)
    return relative.parts[0].removesuffix(".py")


def test_every_part_is_in_the_contract():
    assert {home(path) for path in modules()} <= set(ALLOWED)


def test_the_page_names_files_that_exist():
    page = (PACKAGE.parent / "docs" / "architecture.md").read_text()
    named = set(re.findall(r"`(?:[a-z_]+/)*([a-z_]+\.py)`", page))
    root = PACKAGE.parent
    there = {path.name for top in (PACKAGE, root / "tests") for path in top.rglob("*")}
    assert len(named) > 50 and named <= there, named - there


def test_the_contract_has_no_circles():
    order = []
    left = {part: set(allowed) for part, allowed in ALLOWED.items()}
    while left:
        free = [part for part, allowed in left.items() if not allowed - set(order)]
        assert free, f"circle among {sorted(left)}"
        order += free
        left = {part: allowed for part, allowed in left.items() if part not in free}


def test_no_modules_import_each_other():
    paths = {}
    for path in modules():
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        paths[".".join((NAME, *parts)).removesuffix(".__init__")] = path
    graph = {}
    for name, path in paths.items():
        found = {n if n in paths else n.rpartition(".")[0] for n in imported(path)}
        above = {n for n in found if f"{name}.".startswith(f"{n}.")}
        graph[name] = found & set(paths) - above
    graphlib.TopologicalSorter(graph).prepare()


@pytest.mark.parametrize("part", ALLOWED)
def test_imports_point_one_way(part):
    wrong = []
    for path in modules():
        if home(path) != part:
            continue
        for module in imported(path):
            target = part_of(module)
            if target in (None, part) or target not in ALLOWED:
                continue  # another package, itself, or a name such as __version__
            if target not in ALLOWED[part] | BELOW:
                wrong.append(f"{path.relative_to(PACKAGE)} imports {module}")
    assert not wrong, f"{part} may import {sorted(ALLOWED[part])} only: {wrong}"


@pytest.mark.parametrize("package", CONFINED)
def test_heavy_packages_stay_where_they_belong(package):
    homes = CONFINED[package]
    wrong, right = [], []
    for path in modules():
        relative = path.relative_to(PACKAGE).as_posix()
        if any(module.split(".")[0] == package for module in imported(path)):
            fits = any(
                relative == home_
                or (home_.endswith("/") and relative.startswith(home_))
                for home_ in homes
            )
            (right if fits else wrong).append(relative)
    assert not wrong, f"{package} belongs into {sorted(homes)}"
    assert right, f"nothing imports {package} any more: drop the rule"


def test_no_file_sets_environment_variables_at_import():
    wrong = []
    for path in modules():
        for node in ast.parse(path.read_text()).body:
            # Within functions it would be a user's call.
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                continue
            text = ast.unparse(node)
            if "os.environ[" in text.split("=")[0] or any(
                call in text
                for call in ("environ.setdefault", "environ.update", "putenv")
            ):
                wrong.append(f"{path.relative_to(PACKAGE)}: {text}")
    assert not wrong


@pytest.mark.parametrize("word", ["os.replace", "os.rename", "mkstemp", "fsync"])
def test_files_are_replaced_in_one_place(word):
    found = {
        path.relative_to(PACKAGE).as_posix()
        for path in modules()
        if word in path.read_text()
    }
    assert found <= {"files.py"}


def run(code, **environment):
    """Runs Python code in a fresh interpreter."""
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, **environment},
    )


def loaded_by(statement):
    done = run(f"import sys\n{statement}\nprint(*sys.modules)")
    assert done.returncode == 0, done.stderr
    return {name.split(".")[0] for name in done.stdout.split()}


def test_the_package_itself_is_light():
    loaded = loaded_by("import cathsim_dmc; cathsim_dmc.__version__")
    assert not loaded & {"dm_control", "mujoco", "scipy", *LATE}


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux")
def test_importing_the_suite_is_all_dm_control_needs_and_is_light():
    """A task is loaded below 300 MB, without torch and without the heavy ones.

    Python 3.13 itself takes 46 MB more.
    """
    code = (
        "import re, sys\n"
        "from dm_control import suite\n"
        "import cathsim_dmc.suite\n"
        "print(*sys.modules)\n"
        "env = suite.load('cathsim', 'type2_bca', task_kwargs={'random': 1})\n"
        "assert env.reset().observation['position'].shape\n"
        "print(*sys.modules)\n"
        # Not getrusage, whose peak counts that of the process that forked this one.
        "peak = re.search(r'VmHWM:\\s+(\\d+) kB', open('/proc/self/status').read())\n"
        "print(peak[1])"
    )
    most = 300_000 if sys.version_info < (3, 13) else 350_000
    for _ in range(2):  # the first run on a machine compiles loops, which takes more
        done = run(code)
        assert done.returncode == 0, done.stderr
        imported_, loaded, (peak,) = map(str.split, done.stdout.splitlines())
        if int(peak) < most:
            break
    assert 50_000 < int(peak) < most
    assert "dm_control" in imported_
    assert not {name.split(".")[0] for name in imported_} & set(LATE)
    # scikit-image draws the surface of an arch, numba runs its contact; the others
    # have no business here.
    assert not {name.split(".")[0] for name in loaded} & set(LATE) - {
        "skimage",
        "numba",
    }


@pytest.mark.slow
def test_imports_leave_the_environment_as_it_is():
    """`cathsim eval` and agents load torchrl before dm_control."""
    done = run(
        "import os, sys\n"
        "import cathsim_dmc.cli.agents\n"
        "loaded = list(sys.modules)\n"
        "assert loaded.index('torchrl') < loaded.index('dm_control')\n"
        "import rerun, tyro\n"
        "before = dict(os.environ)\n"
        "import cathsim_dmc.suite, cathsim_dmc.cli\n"
        "import cathsim_dmc.recording.viewer, cathsim_dmc.simulation.torchrl\n"
        "assert dict(os.environ) == before, set(os.environ) ^ set(before)\n",
        MUJOCO_GL="disable",
    )
    assert done.returncode == 0, done.stderr
    done = run(
        "import os\n"
        "import tensordict, torchrl.collectors\n"
        "before = dict(os.environ)\n"
        "import cathsim_dmc.agents\n"
        "assert dict(os.environ) == before, set(os.environ) ^ set(before)\n",
        MUJOCO_GL="disable",
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_agents_warn_of_nothing_after_the_suite():
    """dm_control has the deprecation warnings of all packages shown."""
    done = run(
        "from cathsim_dmc import suite\nfrom cathsim_dmc import agents",
        MUJOCO_GL="disable",
    )
    assert done.returncode == 0 and not done.stderr, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["egl", "osmesa"])
def test_agents_import_before_dm_control_with_opengl(backend):
    """The other order ends in a segmentation fault inside triton."""
    probe = run("import mujoco; mujoco.GLContext(8, 8).free()", MUJOCO_GL=backend)
    if probe.returncode != 0:
        pytest.skip(f"no {backend} on this machine")
    done = run(
        "from cathsim_dmc import agents, suite; print(len(suite.SUITE))",
        MUJOCO_GL=backend,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= 5


def test_the_order_that_crashes_is_refused(backend="egl"):
    """An error that says what to do, in place of the crash; it needs no OpenGL."""
    done = run(
        "import os, sys, types\n"
        # As if dm_control had been loaded with that back end.
        "sys.modules['dm_control.mujoco'] = types.ModuleType('dm_control.mujoco')\n"
        "import cathsim_dmc.agents",
        MUJOCO_GL=backend,
    )
    assert done.returncode == 1, "crashed or went on"
    assert "ImportError" in done.stderr
    for word in (backend, "torchrl", "first", "MUJOCO_GL=disable"):
        assert word in done.stderr


def test_nothing_that_is_read_is_unpickled():
    """NumPy refuses pickles unless it is told otherwise, torch if it is told so."""
    for path in modules():
        names = {name.split(".")[0] for name in imported(path)}
        assert not names & {"pickle", "cloudpickle", "dill", "joblib", "shelve"}, path
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            given = {one.arg: ast.unparse(one.value) for one in node.keywords}
            assert given.get("allow_pickle", "False") == "False", path
            called = ast.unparse(node.func)
            assert not called.endswith(".load_memmap"), path
            if called == "torch.load":
                assert given.get("weights_only") == "True", path
