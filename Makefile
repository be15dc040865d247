# SPDX-License-Identifier: GPL-3.0-or-later
# Every target does its own set-up. `make help` lists them.
.DEFAULT_GOAL := help
SHELL := /bin/sh
PY := .venv/bin/python
BAKE_FLAGS ?=
PLATFORM ?=
PYTEST_FLAGS ?=
export PYTHONHASHSEED := 0
.PHONY: help setup demo scenes test test-4.2 test-4.5 test-5.2 test-all lint bench wheels zip zip-all clean

help: ## this list
	@sed -n 's/^\([a-z][a-z0-9. -]*\):.*## \(.*\)/\1|\2/p' $(MAKEFILE_LIST) | while IFS='|' read -r name text; do printf '  make %-18s %s\n' "$$name" "$$text"; done

setup: ## make .venv with pinned versions: Blender 5.0 on Python 3.11, else 5.2 on 3.13
	@sh tools/setup.sh .venv

demo: setup ## bake every scene of demo_blend/ into out/demo/ (BAKE_FLAGS="...")
	@set -e; for scene in demo_blend/*.blend; do name=$$(basename "$$scene" .blend); \
	  case $$name in interior) size=1024 ;; *) size=256 ;; esac; echo "$$name" >&2; \
	  $(PY) -m rtgi_addon bake "$$scene" --out "out/demo/$$name" $(or $(BAKE_FLAGS),--resolution $$size) </dev/null; done

scenes: ## build demo_blend/*.blend again, with the oldest Blender supported, so that all can open them
	@sh tools/setup.sh .venv-4.2 4.2
	@set -e; for script in demo_blend/build_*.py; do .venv-4.2/bin/python "$$script" </dev/null; done

test: setup wheels ## all tests (PYTEST_FLAGS="-k atlas")
	@$(PY) -m pytest $(PYTEST_FLAGS) </dev/null

test-4.2 test-4.5: test-%: ## the tests that run inside Blender, in that version
	@sh tools/setup.sh .venv-$* $*
	@.venv-$*/bin/python tools/build_zip.py --only-wheels
	@.venv-$*/bin/python -m pytest tests/blender tests/install $(PYTEST_FLAGS) </dev/null

test-5.2: ## all tests in Blender 5.2 (Python 3.13)
	@sh tools/setup.sh .venv-5.2 5.2
	@.venv-5.2/bin/python tools/build_zip.py --only-wheels
	@.venv-5.2/bin/python -m pytest $(PYTEST_FLAGS) </dev/null

test-all: lint test-4.2 test-4.5 test-5.2 test ## lint and every version

lint: setup ## ruff, and mypy --strict on the backend
	@$(PY) -m ruff check . && $(PY) -m ruff format --check . && $(PY) -m mypy

bench: setup ## speed against error beside Cycles, frames, scaling; writes docs/benchmarks.md
	@$(PY) -m bench </dev/null

wheels: setup
	@$(PY) tools/build_zip.py --only-wheels

zip: setup ## the extension for this machine's platform, in dist/ (PLATFORM=windows-x64)
	@$(PY) tools/build_zip.py $(if $(PLATFORM),--platform $(PLATFORM))

zip-all: setup ## the extension for every platform of the manifest
	@$(PY) tools/build_zip.py --platform all

clean: ## remove what make made
	rm -rf .venv .venv-* out dist wheels/*.whl .pytest_cache .mypy_cache .ruff_cache .hypothesis
