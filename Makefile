# make demo   sets up .venv once, then plans and executes an episode of each task with the shipped checkpoint
# make test   sets up what the tests need once, then runs the checks and the tests
# make soak   runs what takes longer, for a nightly run: slow tests, and property tests with new examples
# make versions   tries the lowest and the newest versions of what we depend on, in environments of their own
# make docs   builds the documentation as a site, site/index.html, and checks every link in it
# make clean  removes .venv and what tools leave behind
#
# PYTHON is the interpreter that .venv is made with: make test PYTHON=/path/to/python3.12
PYTHON ?= $(shell for python in python3.11 python3.12 python3.13; do \
	"$$python" -c 'import ensurepip, venv' >/dev/null 2>&1 && { command -v "$$python"; break; }; done)

# For the tests pip compiles nothing in advance, which takes a minute: a module is compiled when it is first imported, and
# kept, which this variable would forbid.
unexport PYTHONDONTWRITEBYTECODE
# Another environment that is active in the user's shell, of which IPython would warn.
unexport VIRTUAL_ENV

bin := .venv/bin
install := $(bin)/python -m pip install --disable-pip-version-check --no-input --constraint constraints.txt
# Each marker is written when its installation has succeeded and removed before the next one begins, so that
# what a broken installation left behind is thrown away, never used.
installed := .venv/installed
installed_for_tests := .venv/installed-for-tests
# Installing by hand without --editable puts a copy of the package in this link's place: then both are made again.
link := $(if $(wildcard .venv/lib/*/site-packages/cavin_pyro),,$(wildcard .venv/lib/*/site-packages/__editable__.cavin_pyro*))
with_extras := '.[test,docs]'
checks := lint format types imports docs

.PHONY: demo test soak versions clean again $(checks)

demo: $(installed)
	$(bin)/python -m cavin_pyro.plan -m task=clearing,insertion,crossing seed=1 output=runs/demo

test: $(installed_for_tests)
	$(MAKE) --no-print-directory --jobs 2 --output-sync $(checks)
	OMP_NUM_THREADS=1 $(bin)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 1

soak: $(installed_for_tests)
	OMP_NUM_THREADS=1 $(bin)/python -m pytest -n 2 --dist worksteal -m soak
	HYPOTHESIS_PROFILE=soak OMP_NUM_THREADS=1 $(bin)/python -m pytest -n 2 --dist worksteal $$(grep -rl --include='test_*.py' hypothesis tests)

versions:
	bash .ci/versions "$(PYTHON)"

lint: $(installed_for_tests)
	$(bin)/ruff check .

format: $(installed_for_tests)
	$(bin)/ruff format --check .

types: $(installed_for_tests)
	$(bin)/mypy

imports: $(installed_for_tests)
	$(bin)/lint-imports

# The variable switches off a notice about what comes after Material for MkDocs: docs/reference/dependencies.md.
docs: $(installed_for_tests)
	NO_MKDOCS_2_WARNING=1 $(bin)/mkdocs build --strict

# Installs into .venv, which is made anew unless what lies there is whole.
define set_up
	$(if $(PYTHON),,$(error Python 3.11, 3.12 or 3.13 with its venv module is needed and none was found; install it, or say where it is: make PYTHON=/path/to/python3.11))
	@"$(PYTHON)" -c 'import sys; (3, 11) <= sys.version_info[:2] <= (3, 13) or sys.exit("$(PYTHON) is Python %d.%d; 3.11 to 3.13 is needed: make PYTHON=/path/to/python3.11" % sys.version_info[:2])'
	@echo "Setting up .venv with $(PYTHON): this once, for two or three minutes; it takes 2.6 GB of disk, with torch for CUDA some 5 GB more"
	"$(PYTHON)" -m venv $(if $(wildcard $(installed)),,--clear) .venv
	@rm -f $(installed) $(installed_for_tests)
	$(install) pip setuptools
	$(install) --no-build-isolation $(1)
endef

$(installed): pyproject.toml constraints.txt $(if $(link),,again)
	$(call set_up,--editable .)
	@touch $@

$(installed_for_tests): pyproject.toml constraints.txt $(if $(link),,again)
	$(call set_up,--no-compile --editable $(with_extras))
	@touch $(installed) $@

clean:
	rm -rf .venv build dist site *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
