# The two commands of the README: `make demo` runs a dam break, `make test` passes the project's checks.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
MPI_VENV ?= .venv-mpi

OUT ?= out/dam-break
# Processes that run the tests.
WORKERS ?= 2

.PHONY: demo films test check test-distributed emulated-cuda slow fuzz mutants docs docs-version wheel-check dist-check clean

demo: $(VENV)/.run
	$(BIN)/warp-lcp run dam-break --out $(OUT) --force $(DEMO_ARGS)

test: check
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal $(PYTEST_ARGS)

check: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run --Werror $$(git ls-files '*.h')
	$(BIN)/mypy
	$(BIN)/lint-imports

# The tests on several ranks, in an environment of the system's Python with Debian's MPI and PETSc (installed by apt-get if this is root).
test-distributed:
	@if why=$$(.ci/mpi-environment $(MPI_VENV)); then \
		$(MPI_VENV)/bin/python -m pytest tests/distributed $(PYTEST_ARGS); \
	else \
		echo "no tests on several ranks: $$why"; \
	fi

# What is done on CUDA, on the CPU (see benchmarks/emulated_cuda.py): all solvers, levels and
# transfers, steps of scenes that have all that there is in scenes, with threads in an unusual order;
# PYTEST_ARGS="-m ''" for all scenes and all precisions, EMULATED=tests for all there is, COMPARE=1
# to launch every kernel in three orders.
EMULATED ?= tests/solvers/test_table.py tests/multigrid/test_fused_levels.py tests/grid/test_transfer.py \
	tests/solvers/test_device_iteration.py tests/grid/test_window_reduction.py tests/kernels/test_joined_graphs.py tests/granular/test_stress_device_iteration.py tests/granular/test_runout.py \
	tests/kernels/test_quads.py tests/grid/test_particles.py tests/multigrid/test_rebuild.py tests/test_as_on_cuda.py
emulated-cuda: $(VENV)/.dev
	PYTHONPATH=tests:. $(BIN)/python -m pytest -p emulated_cuda -n $(WORKERS) --dist worksteal $(EMULATED) $(PYTEST_ARGS)

# What is left out by default: longer studies, and cases that repeat values of arguments (tests/default_run.py).
slow: $(VENV)/.dev
	$(BIN)/python -m pytest -m slow $(PYTEST_ARGS)

# Files and arguments that are wrong in ways nobody thought of, FUZZ_EXAMPLES of each kind, other ones every time.
fuzz: $(VENV)/.dev
	$(BIN)/python -m pytest tests/fuzz -m '' --hypothesis-profile=fuzz --hypothesis-show-statistics $(PYTEST_ARGS)

# Change the code in 50 places, one at a time, and see whether the tests notice; MUTANTS_ARGS="--count 200 --seed 5 --jobs 8" for more.
mutants: $(VENV)/.dev
	$(BIN)/python -m pip install --quiet --editable '.[mutation]'
	$(BIN)/python -m warp_lcp.benchmarks.mutants $(MUTANTS_ARGS)

# The documentation's site, in build/site; a link or an anchor that leads nowhere ends it.
# A photographed film of ten seconds from each simulator, into out/films: hours on two cores. Repeat the command after an interruption.
FILM ?= --size 960x540 --samples 32
SECONDS_OF_FILM ?= 10
define film
	$(BIN)/warp-lcp run $(1) --set time.duration=$(SECONDS_OF_FILM) $(2) --out out/films/$(1) $$(test -f out/films/$(1)/run.json && echo --resume)
	$(BIN)/warp-lcp render out/films/$(1) --look photo $(FILM) --film out/films/$(1).mp4
endef

films: $(VENV)/.dev
	$(call film,floating-bodies,--set output.surface=true)
	$(call film,pouring-pile)
	$(call film,leaning-wall)

docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# The site as one of several versions, by mike: a commit on the local branch gh-pages, nothing is pushed.
docs-version: $(VENV)/.docs
	version=$$($(BIN)/python -c "import tomllib; print(tomllib.load(open('pyproject.toml', 'rb'))['project']['version'])"); \
		DOCS_VERSIONS=mike NO_MKDOCS_2_WARNING=1 $(BIN)/mike deploy --update-aliases "$${version%.*}" latest
	$(BIN)/mike set-default latest

# A wheel holds everything a run needs, and nothing beside `warp_lcp`: install it alone, with the oldest versions that pyproject.toml allows
# (those of the oldest Python), and away from the source tree run a built-in scene of each simulator, and let mypy see its types.
wheel-check: $(VENV)/.dev
	rm -rf build/wheel-check
	mkdir -p build/wheel-check
	$(BIN)/python -m pip install --quiet --target build/wheel-check/tools 'setuptools>=77'
	PYTHONPATH=$(CURDIR)/build/wheel-check/tools $(BIN)/python .ci/wheel_contents.py build/wheel-check
	$(BIN)/python -c "import sys, tomllib; floors = tomllib.load(open('pyproject.toml', 'rb'))['project']['dependencies']; \
		print(*(floor.replace('>=', '==') for floor in floors if sys.version_info[:2] == (3, 11)), sep='\n')" > build/wheel-check/floors.txt
	$(PYTHON) -m venv build/wheel-check/venv
	build/wheel-check/venv/bin/python -m pip install --quiet --constraint build/wheel-check/floors.txt build/wheel-check/wheel-checkout/*.whl
	cd build/wheel-check && venv/bin/warp-lcp run ceiling-drop --out run --set time.duration=0.05
	cd build/wheel-check && venv/bin/warp-lcp run hourglass-2d --out sand --set time.duration=0.01 --set domain.resolution=24
	cp .ci/typed.py build/wheel-check
	cd build/wheel-check && $(abspath $(BIN))/mypy --config-file= --python-executable venv/bin/python --strict --ignore-missing-imports typed.py

# What a release uploads, in build/dist: sdist and wheel, whose description and names the package index must take.
dist-check: $(VENV)/.dev
	rm -rf build/dist
	$(BIN)/python -m pip install --quiet --editable '.[publish]'
	$(BIN)/python -m build --outdir build/dist
	$(BIN)/twine check --strict build/dist/*

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.run: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

$(VENV)/.dev: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable '.[dev,render]'
	$(BIN)/python -m pip install --quiet --editable '.[photo]' || echo "the extra photo cannot be installed here: tests of photographs are skipped"
	touch $@ $(VENV)/.run

$(VENV)/.docs: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable '.[docs]'
	touch $@ $(VENV)/.run

clean:
	rm -rf $(VENV) $(MPI_VENV) build dist *.egg-info
