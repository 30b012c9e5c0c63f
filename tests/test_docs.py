"""What the documentation says runs, and its pages fit together."""

import ast
import builtins
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
NOTEBOOKS = sorted((DOCS / "tutorials").glob("*.ipynb"))
FORMULAS = sorted(page.name for page in DOCS.glob("*.md") if "$`" in page.read_text()
                  or "```math" in page.read_text())  # fmt: skip
_BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
# Pages whose Python blocks run one after the other in one interpreter.
SNIPPETS = [
    "README.md",
    *(
        f"docs/{name}.md"
        for name in (
            "index",
            "concepts",
            "how-to",
            "own_tasks",
            "own_training",
            "gymnasium",
            "forces",
        )
    ),
]


def run(arguments, folder):
    done = subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        cwd=folder,
        env={
            **os.environ,
            "MUJOCO_GL": "disable",
            "PYTHONPATH": os.pathsep.join(map(str, [ROOT, *sys.path])),
        },
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("page", SNIPPETS)
def test_snippets_run_as_printed(page, tmp_path):
    blocks = _BLOCK.findall((ROOT / page).read_text())
    assert blocks, f"{page} has no Python block any more: take it off the list"
    code = "\n".join(blocks)
    if page != "README.md":  # which draws the same film
        code = code.replace(".webp", ".npz").replace(".gif", ".npz")
    run(["-c", code], tmp_path)


# Pages whose blocks are parts of the files that the text before them names.
PARTS = "CONTRIBUTING.md"


@pytest.mark.parametrize(
    "page", sorted(str(path.relative_to(ROOT)) for path in DOCS.glob("*.md"))
)
def test_every_block_has_its_imports(page):
    for code in _BLOCK.findall((ROOT / page).read_text()):
        assert not undefined(code), f"{page}: {code}"


def test_blocks_that_stand_by_themselves_have_their_imports():
    text = (ROOT / PARTS).read_text()
    for section in re.split(r"^### ", text, flags=re.MULTILINE)[1:]:
        if section.splitlines()[0].endswith("your own"):
            for code in _BLOCK.findall(section):
                assert not undefined(code), section


def undefined(code):
    """Names that a block uses and does not define, by its own functions and classes."""
    compile(code, "block", "exec")
    used, known = set(), set(dir(builtins))
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Name):
            (used if isinstance(node.ctx, ast.Load) else known).add(node.id)
        elif isinstance(node, ast.alias):
            known.add((node.asname or node.name).partition(".")[0])
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            known.add(node.name)
        elif isinstance(node, ast.arg):
            known.add(node.arg)
    return used - known


@pytest.mark.slow
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_tutorials_run(notebook):
    spec = importlib.util.spec_from_file_location(
        "notebooks", DOCS / "scripts" / "notebooks.py"
    )
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    fresh = script.executed(notebook)
    code = [cell for cell in fresh.cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in code)


def test_notebooks_hold_nothing_of_the_machine_they_ran_on():
    for path in NOTEBOOKS:
        text = path.read_text()
        assert len(text) < 1_500_000, f"{path.name} is too large"
        for word in (str(ROOT), str(Path.home()) + "/", "Traceback"):
            assert word not in text, f"{path.name} holds {word!r}"


def test_pages_link_to_files_that_exist():
    pages = [*DOCS.rglob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
    wrong = []
    for page in pages:
        for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
            if "://" not in target and not (page.parent / target).exists():
                wrong.append(f"{page.relative_to(ROOT)}: {target}")
    assert not wrong


@pytest.mark.parametrize("page", FORMULAS)
def test_formulas_are_drawn_without_a_script(page, monkeypatch):
    for module in ("latex2mathml", "mkdocs", "nbconvert"):
        pytest.importorskip(module, reason="needs the extra docs")
    monkeypatch.syspath_prepend(str(DOCS / "scripts"))
    hooks = importlib.import_module("site_hooks")
    text = (DOCS / page).read_text()
    written = hooks._formulas(text)
    drawn = re.findall(r"<math.*?</math>", written, re.DOTALL)
    assert len(drawn) == text.count("```math") + text.count("$`")
    for formula in drawn:
        # What is not known to the converter stays as TeX.
        assert "\\" not in formula, formula
        ElementTree.fromstring(formula)
    assert "```math" not in written and "$`" not in written


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    pytest.importorskip("mkdocs", reason="needs the extra docs")
    pytest.importorskip("nbconvert", reason="needs the extra docs")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(tmp_path)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    for page in ("index", "concepts", "examples", "reference/suite", "CONTRIBUTING"):
        assert (tmp_path / f"{page}.html").is_file()
    assert list((tmp_path / "tutorials").glob("4_forces*.png"))
    assert "<math" in (tmp_path / "validation.html").read_text()
    text = re.sub("<[^>]*>", "", (tmp_path / "reference/suite.html").read_text())
    assert "load_anatomy" in text and "Raises" in text


@pytest.mark.slow
def test_the_example_of_ppo_learns_what_it_prints(tmp_path):
    script = ROOT / "examples" / "train_ppo.py"
    assert len(script.read_text().splitlines()) <= 200
    options = "--total-frames 512 --num-envs 4 --max-steps 60 --evaluation-episodes 2"
    out = run([str(script), *options.split(), "--evaluation-steps", "50"], tmp_path)
    assert "512 frames" in out and "success: " in out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options", "printed"),
    [
        (
            "identify_device",
            "--candidates 24 --rounds 2 --steps 40",
            r"true: 1\.200, 0\.0800; found: 1\.[12]\d\d, 0\.[01]",
        ),
        (
            "random_shooting",
            "--sequences 4 --horizon 5 --steps 10",
            r"10 steps, [\d.]+ mm",
        ),
    ],
)
def test_examples_print_what_they_find(tmp_path, name, options, printed):
    script = str(ROOT / "examples" / f"{name}.py")
    assert re.search(printed, run([script, *options.split()], tmp_path))


def test_examples_push_coaxial_devices_forward(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "examples")
    import identify_device
    import random_shooting

    rows = identify_device.Bench("simple1_bca_wire", 1).push(np.array([[1.0, 0.05]]), 5)
    points = rows[0, :, :-1].reshape(5, -1, 3) * identify_device.POINT
    assert np.linalg.norm(points[-1, -1] - points[0, -1]) > 5e-3

    zeros = SimpleNamespace(outcome=SimpleNamespace(reward=np.zeros(9)))
    zeros.terminated = zeros.truncated = np.zeros(9, bool)
    pair = SimpleNamespace(catheter=SimpleNamespace(translations=(0, 2)))
    planner = SimpleNamespace(num_simulations=9, num_actions=4, played=[])
    planner.task, planner.restore = SimpleNamespace(scene=pair), lambda snapshot: None
    planner.step = lambda actions: planner.played.append(actions) or zeros
    snapshot = SimpleNamespace(repeat=lambda count: None)
    random_shooting.best_actions(planner, snapshot, 10, np.random.default_rng(0))
    played = np.array(planner.played)
    assert (played[..., [0, 2]] >= 0).all() and (played[..., [1, 3]] < 0).any()
