# Needs Python 3.11 or newer with venv and pip; everything else is installed into .venv.
PYTHON ?= $(shell python3.11 -c '' 2>/dev/null && echo python3.11 || echo python3)
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
INSTALLED := .venv/.installed

.DEFAULT_GOAL := help
.PHONY: help demo test slow bench docs lock clean

help:
	@echo "make demo   install, then close the loop on a simulated drive and write a report"
	@echo "make test   the whole gate: ruff, pyright, import contracts, pytest"
	@echo "make slow   the tests that take minutes, with shapes checked at every call"
	@echo "make bench  the benchmarks, side by side with their peers"
	@echo "make docs   renew the pages made from the code, and build the site into build/site"
	@echo "make lock   resolve requirements.lock afresh"
	@echo "make clean  remove what runs leave behind (.venv stays)"

# Renewed only when the lock or the project's metadata changed.
$(INSTALLED): requirements.lock pyproject.toml
	@echo "Installing into .venv (the first time takes a minute or two)"
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@$(BIN)/python -c 'import sys; sys.exit(sys.version_info < (3, 11) and "hdjax needs Python 3.11 or newer, but .venv has " + sys.version.split()[0] + "; remove .venv and run make PYTHON=python3.11 again")'
	@$(PIP) install --quiet -r requirements.lock
	@$(PIP) install --quiet --no-deps -e .
	@touch $@

demo: $(INSTALLED)
	@$(BIN)/hdjax demo --out hdjax-demo

test: $(INSTALLED)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(BIN)/pyright
	$(BIN)/lint-imports
	$(BIN)/python -m pytest

slow: $(INSTALLED)
	HDJAX_CHECKS=inf $(BIN)/python -m pytest -m slow

bench: $(INSTALLED)
	@set -e; for file in benchmarks/bench_*.py; do echo "== $$file"; $(BIN)/python "$$file" $(ARGS); done

docs: $(INSTALLED)
	$(BIN)/python docs/generate.py
	$(BIN)/zensical build --clean --strict
	@echo "build/site/index.html opens in a browser; for its search: $(BIN)/python -m http.server -d build/site"

# Resolved in an environment of its own, so that nothing installed by hand slips in.
lock:
	@set -e; room=$$(mktemp -d); trap 'rm -rf "$$room"' EXIT; \
	$(PYTHON) -m venv "$$room"; \
	"$$room/bin/python" -m pip --disable-pip-version-check install --quiet '.[test,benchmark]'; \
	{ sed -n '/^#/p' requirements.lock; \
	  "$$room/bin/python" -m pip --disable-pip-version-check freeze --exclude hdjax; } > "$$room/requirements.lock"; \
	if grep -n '://\|@' "$$room/requirements.lock"; then echo "a path or an address slipped in"; exit 1; fi; \
	cp "$$room/requirements.lock" requirements.lock

clean:
	rm -rf hdjax-demo build dist *.egg-info .cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find . -path ./.venv -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +
