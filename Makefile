# make demo   sets up .venv once, then plans and executes an episode of each task with the shipped checkpoint
# make test   sets up what the tests need once, then runs the checks and the tests
# make soak   runs the tests that make test leaves out: whole families, of which it runs a representative; then 2,000
#             faults of the disk and 100,000 plans, each of which goes on after its log in runs/soak
# make docs   builds the documentation as a site, site/index.html, and checks every link in it
# make clean  removes .venv and what tools leave behind
#
# PYTHON is the interpreter that .venv is made with: make test PYTHON=/path/to/python3.10
PYTHON ?= $(shell for python in python3.11 python3.10; do \
	"$$python" -c 'import ensurepip, venv' >/dev/null 2>&1 && { command -v "$$python"; break; }; done)

bin := .venv/bin
install := $(bin)/python -m pip install --disable-pip-version-check --no-input --constraint constraints.txt
# Each marker is written when its installation has succeeded and removed before the next one begins, so that
# what a broken installation left behind is thrown away, never used.
installed := .venv/installed
installed_for_tests := .venv/installed-for-tests
# The variable switches off a notice about what comes after Material for MkDocs: docs/reference/dependencies.md.
build_docs := NO_MKDOCS_2_WARNING=1 $(bin)/mkdocs build --strict

.PHONY: demo test soak docs clean

demo: $(installed)
	$(bin)/python -m cavin_pyro.demo

test: $(installed_for_tests)
	$(bin)/ruff check .
	$(bin)/ruff format --check .
	$(bin)/mypy
	$(bin)/lint-imports
	$(build_docs)
	OMP_NUM_THREADS=1 $(bin)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

soak: $(installed_for_tests)
	OMP_NUM_THREADS=1 $(bin)/python -m pytest -n 2 --dist worksteal -m soak
	HYPOTHESIS_PROFILE=soak OMP_NUM_THREADS=1 $(bin)/python -m pytest -n 2 --dist worksteal $$(grep -rl --include='test_*.py' hypothesis tests)
	OMP_NUM_THREADS=1 $(bin)/python -m tests.cavin_pyro.faults --count 2000 --log runs/soak/faults.jsonl
	OMP_NUM_THREADS=1 $(bin)/python benchmarks/long_runs.py --turns 100000 --log runs/soak/long_runs.jsonl

docs: $(installed_for_tests)
	$(build_docs)

$(installed): pyproject.toml constraints.txt
	$(if $(PYTHON),,$(error Python 3.11 or 3.10 with its venv module is needed and neither was found; install it, or say where it is: make PYTHON=/path/to/python3.11))
	@"$(PYTHON)" -c 'import sys; (3, 10) <= sys.version_info[:2] <= (3, 11) or sys.exit("$(PYTHON) is Python %d.%d; 3.11 or 3.10 is needed: make PYTHON=/path/to/python3.11" % sys.version_info[:2])'
	@echo "Setting up .venv with $(PYTHON): this once, for a few minutes"
	"$(PYTHON)" -m venv $(if $(wildcard $@),,--clear) .venv
	@rm -f $(installed) $(installed_for_tests)
	$(install) pip setuptools
	$(install) --no-build-isolation --editable .
	@touch $@

$(installed_for_tests): $(installed)
	@rm -f $(installed) $(installed_for_tests)
	$(install) --no-build-isolation --editable '.[test,docs]'
	@touch $(installed) $@

clean:
	rm -rf .venv build dist site *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
