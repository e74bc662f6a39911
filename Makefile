# `make run` kits; `make test` tests. Both first make .venv/, once. `make docs` builds the site, in .venv-docs/.

# The newest comes first. Drake for Python 3.11 is an older one, with which episodes take longer.
SUPPORTED := import ensurepip, sys, venv; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))
PYTHON ?= $(shell for python in python3.14 python3.13 python3.12 python3 python3.11; do \
  $$python -c '$(SUPPORTED)' 2>/dev/null && echo $$python && break; done)
# What pip installs PyTorch from. On Linux that is a build for CUDA, of 4.6 GB with all that it needs. Where
# there is no such GPU, PyTorch's build for CPUs does with 0.7 GB: make TORCH='torch==2.13.0 --index-url URL',
# with the URL that pytorch.org/get-started/locally shows for CPU.
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
	$(BIN)/python -m pytest -n 2

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

# An environment that is there is kept, with its PyTorch; `make clean` removes it. The .pth file makes the
# checkout importable from anywhere.
$(READY): requirements.txt
	@if ! { $(PIP) --version && $(BIN)/python -c '$(SUPPORTED)'; } >/dev/null 2>&1; then \
	  if test -z "$(PYTHON)" || ! $(PYTHON) -c '$(SUPPORTED)' 2>/dev/null; then \
	    echo "error: Python 3.11 to 3.14 is needed, with its venv module (Debian and Ubuntu: apt-get install python3-venv): say 'make PYTHON=/path/to/python3.13'" >&2; exit 2; \
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
