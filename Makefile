# Two commands do everything from a fresh clone: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WORKERS ?= 2
# Not quiet: some of the packages are large, and minutes without a word look like a hang.
PIP := PIP_DISABLE_PIP_VERSION_CHECK=1 $(BIN)/python -m pip install --constraint constraints.txt
# dm-control asks for labmaze, which has no wheel for these Pythons and is not used here.
LABMAZE := './tools/labmaze ; python_version >= "3.13"'
# MuJoCo looks for OpenGL at import; tests that draw with it choose a back end themselves.
export MUJOCO_GL ?= disable

.PHONY: demo test test-slow nightly lint lock audit compatibility dist docs site clean

demo: $(VENV)/.installed
	$(BIN)/cathsim train type1_lcca --algo dagger --preset demo --frames 12288 --out runs/demo $$(test ! -e runs/demo/config.json || echo --resume)
	$(BIN)/cathsim eval runs/demo --out runs/demo
	$(BIN)/cathsim record runs/demo --out runs/demo/episode.rrd
	@echo "runs/demo: checkpoints/ (policy), metrics.csv, evaluation.json, heatmap.png, episode.rrd (open it: $(BIN)/cathsim replay runs/demo/episode.rrd)"

# One thread a worker: those of torch and numpy only wait for each other.
test test-slow: export OMP_NUM_THREADS ?= 1

test: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/python -m pytest -m "not slow" -n $(WORKERS) --dist worksteal -q

# Says at its end how long it took, and which tests took longest.
test-slow: $(VENV)/.installed-test
	$(BIN)/python -m pytest -m slow -n $(WORKERS) --dist worksteal --durations=15 -rA -q

# Everything that can be checked without a network, a night long.
nightly: lint test test-slow docs dist compatibility
	mkdir -p runs
	$(BIN)/python benchmarks/soak.py --out runs/soak
	$(BIN)/python benchmarks/long_load.py --steps 1000000 --out runs/long-load.json

# Known holes of the pinned versions; asks a public database, so it needs a network.
audit: $(VENV)/.installed
	$(PYTHON) -m venv build/audit
	PIP_DISABLE_PIP_VERSION_CHECK=1 build/audit/bin/python -m pip install --quiet pip-audit
	build/audit/bin/pip-audit --no-deps --disable-pip --requirement constraints.txt

# Pythons and versions of the main dependencies, each in a fresh environment.
compatibility:
	$(PYTHON) tools/compatibility.py

# requirements.lock, by uv, which it needs on the path.
lock:
	$(PYTHON) tools/lock.py

# The wheel, proved in an empty environment away from the checkout.
dist: $(VENV)/.installed
	rm -rf dist build/wheel build/empty
	$(PYTHON) -m venv build/empty
	PIP_DISABLE_PIP_VERSION_CHECK=1 $(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .
	PIP_DISABLE_PIP_VERSION_CHECK=1 build/empty/bin/python -m pip install --quiet --constraint constraints.txt $(LABMAZE) dist/*.whl
	cd build && empty/bin/python ../tools/smoke.py --installed

lint: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright --pythonpath $(BIN)/python

$(VENV)/.created:
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if v >= (3, 11) else f"cathsim needs Python 3.11 or newer, but $(PYTHON) is {v[0]}.{v[1]}; set PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.installed: pyproject.toml constraints.txt $(VENV)/.created
	@echo "Installing some 70 packages into $(VENV), once: one minute to ten"
	@$(PIP) $(LABMAZE) --editable .
	@touch $@

$(VENV)/.installed-test: $(VENV)/.installed
	@$(PIP) --editable '.[test]'
	@touch $@

docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "The site: build/site/index.html"

# The same with the pages in the browser; needs Node.js and npm.
site: docs
	$(BIN)/python docs/scripts/browser.py

$(VENV)/.installed-docs: $(VENV)/.installed
	@$(PIP) --editable '.[docs]'
	@touch $@

clean:
	rm -rf $(VENV) build *.egg-info
