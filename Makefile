# `make run` runs a scenario, `make test` the tests. Both create .venv/ if it is missing. `make docs` builds the site,
# in .venv-docs/.

# Python 3.11 comes last: its newest Drake is older, and episodes take longer.
SUPPORTED := import ensurepip, sys, venv; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))
PYTHON ?= $(shell for python in python3.14 python3.13 python3.12 python3 python3.11; do \
  $$python -c '$(SUPPORTED)' 2>/dev/null && echo $$python && break; done)
# Arguments of pip for PyTorch. On Linux the default is the CUDA build, which takes 4.6 GB with its dependencies.
# The build for CPUs takes 0.7 GB: make TORCH='torch==2.13.0 --index-url URL', with the URL that
# pytorch.org/get-started/locally shows for CPU.
TORCH ?= torch==2.13.0
VENV := .venv
DOCS := .venv-docs
BIN := $(VENV)/bin
READY := $(VENV)/ready
SCENARIO ?= scenarios/kitting_seen.yaml

.PHONY: run test test-slow lint docs clean

run: $(READY)
	$(BIN)/python -m kitting_drake.run $(SCENARIO)

test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist loadscope

test-slow: $(READY)
	$(BIN)/python -m pytest -n 2 -m slow

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(DOCS)/ready
	NO_MKDOCS_2_WARNING=1 $(DOCS)/bin/python -m mkdocs build --strict
	@echo "open site/index.html"

clean:
	rm -rf $(VENV) $(DOCS) site

PIP := $(BIN)/python -m pip --quiet --disable-pip-version-check

# Keeps an existing environment and its PyTorch; `make clean` removes it. The .pth file makes the checkout
# importable from any folder.
$(READY): requirements.txt
	@if ! { $(PIP) --version && $(BIN)/python -c '$(SUPPORTED)'; } >/dev/null 2>&1; then \
	  if test -z "$(PYTHON)" || ! $(PYTHON) -c '$(SUPPORTED)' 2>/dev/null; then \
	    echo "error: no Python 3.11 to 3.14 with the venv module found (Debian and Ubuntu: apt-get install python3-venv): run 'make PYTHON=/path/to/python3.13'" >&2; exit 2; \
	  fi; \
	  echo "$(PYTHON) -m venv --clear $(VENV)"; $(PYTHON) -m venv --clear $(VENV); \
	fi
	$(PIP) install --no-deps -r requirements.txt
	$(PIP) install --no-warn-conflicts $(TORCH)
	@$(BIN)/python -c 'import pathlib, sysconfig; pathlib.Path(sysconfig.get_path("purelib"), "kitting_drake.pth").write_text(str(pathlib.Path.cwd()) + "\n")'
	@touch $@

$(DOCS)/ready: requirements-docs.txt
	@if test -z "$(PYTHON)"; then \
	  echo "error: Python 3.11 to 3.14 is needed, with its venv module: say 'make docs PYTHON=/path/to/python3.13'" >&2; exit 2; \
	fi
	$(PYTHON) -m venv --clear $(DOCS)
	$(DOCS)/bin/python -m pip --quiet --disable-pip-version-check install --no-deps -r requirements-docs.txt
	@touch $@
