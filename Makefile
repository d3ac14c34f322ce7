# The two commands of the README: `make demo` runs a dam break, `make test` passes the project's checks.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
MPI_VENV ?= .venv-mpi

OUT ?= out/dam-break

.PHONY: demo test test-distributed slow fuzz docs wheel-check clean

demo: $(VENV)/.run
	$(BIN)/warp-lcp run dam-break --out $(OUT) --force $(DEMO_ARGS)

test: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m pytest $(PYTEST_ARGS)

# The tests on several ranks, in an environment of the system's Python with Debian's MPI and PETSc (installed by apt-get if this is root).
test-distributed:
	@if why=$$(.ci/mpi-environment $(MPI_VENV)); then \
		$(MPI_VENV)/bin/python -m pytest tests/distributed $(PYTEST_ARGS); \
	else \
		echo "no tests on several ranks: $$why"; \
	fi

slow: $(VENV)/.dev
	$(BIN)/python -m pytest -m slow $(PYTEST_ARGS)

# Files and arguments that are wrong in ways nobody thought of, FUZZ_EXAMPLES of each kind, other ones every time.
fuzz: $(VENV)/.dev
	$(BIN)/python -m pytest tests/fuzz --hypothesis-profile=fuzz --hypothesis-show-statistics $(PYTEST_ARGS)

# The documentation's site, in build/site; a link or an anchor that leads nowhere ends it.
docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# A wheel holds everything a run needs: install it alone and run a built-in scene away from the source tree.
wheel-check: $(VENV)/.run
	rm -rf build/wheel-check
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir build/wheel-check .
	$(PYTHON) -m venv build/wheel-check/venv
	build/wheel-check/venv/bin/python -m pip install --quiet build/wheel-check/*.whl
	cd build/wheel-check && venv/bin/warp-lcp run ceiling-drop --out run --set time.duration=0.05

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.run: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

$(VENV)/.dev: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable '.[dev,render]'
	touch $@ $(VENV)/.run

$(VENV)/.docs: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable '.[docs]'
	touch $@ $(VENV)/.run

clean:
	rm -rf $(VENV) $(MPI_VENV) build dist *.egg-info
