# Two commands do everything on a fresh machine with Python 3.11 or newer:
#   make demo   install, run the demonstration, say where the pictures are
#   make test   install with the test tools, run the suite
#   make long   the same with many more random cases: for a night
# A second run reinstalls nothing. PYTHON=python3.13 picks an interpreter.

NEW_ENOUGH = 'import sys; sys.exit(sys.version_info < (3, 11))'
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11 python3.14; do \
	$$p -c $(NEW_ENOUGH) 2>/dev/null && echo $$p && break; done)
VENV ?= .venv
RUN = $(VENV)/bin/python
JOBS ?= 2
# Each worker takes tests that stand together: what one of them compiles serves the next.
SPREAD = -n $(JOBS) --dist worksteal
# What the pass without 64-bit types runs beside the kernels.
FLOAT32 = tests/test_lookup.py tests/test_methods.py::test_float32_carries_deep_surfaces \
	tests/test_methods.py::test_float32_refuses_what_it_cannot_carry \
	tests/test_materials.py

.PHONY: demo test long lint docs clean

demo: $(VENV)/installed
	$(RUN) -m diffopt demo -o out/demo

test: $(VENV)/installed-test
	$(RUN) -m pytest $(SPREAD)
	DIFFOPT_TEST_X64=0 $(RUN) -m pytest $(SPREAD) -m "not slow" tests/kernels $(FLOAT32)

long: $(VENV)/installed-test
	$(RUN) -m pytest $(SPREAD) --long

lint: $(VENV)/installed-test
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) -m pyright

# The theme announces on every run that it will change; that is no warning about the pages.
docs: $(VENV)/installed-test
	NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --strict --quiet

$(VENV)/created:
	@test -n "$(PYTHON)" || { echo "make: Python 3.11 or newer not found; set PYTHON=/path/to/python3" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	touch $@

$(VENV)/installed: $(VENV)/created pyproject.toml constraints.txt
	$(RUN) -m pip install --disable-pip-version-check -q -c constraints.txt -e .
	touch $@

$(VENV)/installed-test: $(VENV)/created pyproject.toml constraints.txt
	$(RUN) -m pip install --disable-pip-version-check -q -c constraints.txt -e ".[test]"
	touch $(VENV)/installed $@

clean:
	rm -rf out site build dist *.egg-info .pytest_cache .ruff_cache
