# `make` alone lists the targets. Everything runs in .venv, which the first target that needs it makes from the lock.
SHELL := /bin/sh
.DEFAULT_GOAL := help
# Hundreds of processes start several times faster from modules that were compiled once.
unexport PYTHONDONTWRITEBYTECODE
.DELETE_ON_ERROR:

PACKAGES := pendulum_msgs_py pendulum_sim pendulum_lqr pendulum_hw_bridge bags/pendulum_rosbag bags/pendulum_bags bags/pendulum_console bags/pendulum_learning bags/pendulum_course tests/pendulum_testing
VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip --disable-pip-version-check --no-input --quiet --quiet

# The lock in layers, so that each target installs what it needs: requirements/LAYER.in says what that is. A layer holds
# nothing that `run` has, and one version of each package stands in all of them.
LAYERS := run extras build checks docs test
INSTALLED := $(LAYERS:%=$(VENV)/.%)

# Everything that decides what an editable install looks like; the modules themselves are read in place.
LINKED := $(foreach p,$(PACKAGES),$(wildcard $(p)/setup.py $(p)/setup.cfg $(p)/package.xml $(p)/*/executables.py))

.PHONY: help venv extras experiment course test bench readers lint format types imports build faults mutants lock audit docs clean

help: # Print the targets, one line each
	@awk -F ':[^#]*# ' '/^[a-z]+:[^#=]*# / {printf "make %-11s %s\n", $$1, $$2}' Makefile

venv: $(VENV)/.linked $(INSTALLED) # Make or renew .venv with all layers of the lock (PYTHON=... chooses the interpreter)

extras: $(VENV)/.linked $(VENV)/.extras # Install what every program needs: console, studies, MuJoCo, HEBI, ...

# One stamp for each step, so that an interrupted one is done again and a finished one is not. The system's own Python
# goes before another of its version: ROS runs on it, and it is built with profile-guided optimisation, which pyenv's are
# not unless somebody asks: programs then take 1.3 times as long.
$(VENV)/.made:
	@for python in $(PYTHON) $(foreach version,3.12 3.11 3.10 3.13 3.14,/usr/bin/python$(version) python$(version)) python3 none; do \
	  if $$python -c 'import ensurepip, sys; sys.exit(sys.implementation.name != "cpython" or not (3, 10) <= sys.version_info[:2] <= (3, 14))' 2>/dev/null; \
	  then break; fi; \
	done; \
	if [ $$python = none ]; then echo "error: found no CPython 3.10 to 3.14 that can make a virtual environment; install one (Debian and Ubuntu: with python3-venv), or name it with make PYTHON=/path/to/python3" >&2; exit 1; fi; \
	echo "making $(VENV) with $$($$python --version) ($$(command -v $$python))" && $$python -m venv $(VENV)
	@touch $@

# The lock is complete, so pip has nothing to resolve: faster, and the same on every version of pip. Modules are compiled
# when they are first imported, which most never are.
$(INSTALLED): $(VENV)/.%: requirements/%.txt | $(VENV)/.made
	@echo "installing $$(sed -n 's/==.*//p' $< | sort -u | wc -l) locked packages into $(VENV) (layer $*; some minutes the first time)"
	@$(PIP) install --prefer-binary --no-deps --no-compile --require-hashes -r $< || { \
	  echo "error: the locked packages could not be installed; pip says why above. The first time needs the network (or a mirror that pip is" \
	  "told of, PIP_INDEX_URL) and some GB of disk. What pip has fetched it keeps: make the same target again." >&2; exit 1; }
	@touch $@

# Compatible mode writes plain path entries. Those alone win over the folders of the repository that bear the packages'
# names, which Python would otherwise take for namespace packages when it starts in this folder.
$(VENV)/.linked: $(VENV)/.run $(LINKED)
	@echo "linking $(PACKAGES) into $(VENV)"
	@$(PIP) install --no-deps --no-build-isolation --config-settings editable_mode=compat $(addprefix --editable ./,$(PACKAGES))
	@echo "compiling the loops of plant, controller and noise (some ten seconds)"
	@$(PY) -m pendulum_msgs_py.loops.compile_loop
	@touch $@

experiment: $(VENV)/.linked # Run the thesis's experiment on simulator and emulated hardware, and compare them (OUT=DIR ARGS=...)
	@$(PY) -m pendulum_bags experiment thesis $(if $(OUT),--out "$(OUT)") $(ARGS)

course: $(VENV)/.linked $(VENV)/.extras # Make six exercises with a hidden plant from a seed (SEED=2027 OUT=build/course)
	@$(PY) -m pendulum_course course make $(if $(SEED),--seed "$(SEED)") $(if $(OUT),--out "$(OUT)")

test: venv # Run every test (ARGS="-k name" chooses)
	@$(PY) -m tests.suite $(ARGS)

bench: venv $(VENV)/.peers # Measure beside the peers, print a table, write build/bench.json (ONLY=area ARGS=...)
	@PYTHONPATH="$(CURDIR)/$(VENV)/peers$${PYTHONPATH:+:$$PYTHONPATH}" $(PY) -m tests.benchmarks.run $(if $(ONLY),--only "$(ONLY)") $(ARGS)

# A peer that cannot be had here is reported in its rows; it must not keep the others from being measured.
$(VENV)/.peers: requirements/bench.txt | $(VENV)/.run
	@echo "installing $$(grep -c == requirements/bench.txt) peers into $(VENV)/peers"
	@rm -rf $(VENV)/peers
	@if $(PIP) install --prefer-binary --no-deps --require-hashes --target $(VENV)/peers -r requirements/bench.txt; then touch $@; \
	else echo "note: some peers could not be installed; their rows will say so" >&2; fi

readers: $(VENV)/.readers # Fetch Rerun's program (170 MB), with which tests open bags; they do so themselves where they can

# Its program alone is used, so nothing that its wheel names is installed; no path of ours leads into this folder.
$(VENV)/.readers: requirements/readers.txt | $(VENV)/.made
	@rm -rf $(VENV)/readers
	@$(PIP) install --prefer-binary --no-deps --no-compile --require-hashes --target $(VENV)/readers -r $<
	@touch $@

lint: $(VENV)/.checks # Check style and format with ruff
	@$(PY) -m ruff check $(ARGS)
	@$(PY) -m ruff format --check || { echo "make format does it" >&2; exit 1; }

format: $(VENV)/.checks # Format every file with ruff
	@$(PY) -m ruff format

types: $(VENV)/.linked $(VENV)/.extras $(VENV)/.checks $(VENV)/.test # Check types with mypy
	@$(PY) -m mypy $(ARGS)

imports: $(VENV)/.linked $(VENV)/.checks # Check which package and which module may import what
	@$(VENV)/bin/lint-imports --no-logo $(ARGS)

# Anew each time: colcon leaves a module that was moved or deleted where it has installed it, and it would run.
build: $(VENV)/.run $(VENV)/.build # Build the packages with colcon into install/, as for ros2 run
	@rm -rf $(foreach p,$(notdir $(PACKAGES)),build/$(p) install/$(p))
	@$(VENV)/bin/colcon build --base-paths $(PACKAGES) $(ARGS)

faults: venv # Attack the running system, count what it stood, print a table (tests/tools/faults; tests/faults has the short form)
	@$(PY) -m tests.tools.faults.run $(ARGS)

mutants: venv # Break the safety rules in every small way; fail if no test notices one (build/mutants.md)
	@$(PY) -m tests.mutants.run $(ARGS)

# The lock covers CPython 3.10 to 3.14 on every system at once; ROS and colcon in it are for Linux on x86_64, where rclpy has
# wheels. All layers are compiled together first, for one version of each package; then each by itself on those versions,
# less what `run` has. The peers of the benchmarks come last, less what all have, and before them a reader of others,
# without what it names.
LOCK := $(VENV)/.uv/bin/uv --config-file requirements/uv.toml pip compile --quiet --universal --python-version 3.10 --generate-hashes --no-header --no-annotate --no-emit-index-url
# What a lock has wherever another may need it: without a marker, with ROS's, or with several that share the versions of
# Python among them.
without = $$(awk -F== '/^[A-Za-z0-9]/ {n[$$1] += /;/ && !/x86_64/ ? 1 : 2} END {for (p in n) if (n[p] > 1) print "--no-emit-package " p}' $(1))

lock: $(VENV)/.made # Compile requirements/*.in into requirements/*.txt with hashes (ARGS=--upgrade renews the versions)
	@test -x $(VENV)/.uv/bin/uv || { $(PY) -m venv $(VENV)/.uv && $(VENV)/.uv/bin/pip --quiet --quiet --disable-pip-version-check install uv; }
	@mkdir -p build && cat $(LAYERS:%=requirements/%.txt) > build/lock.txt
	@$(LOCK) $(ARGS) $(LAYERS:%=requirements/%.in) --output-file build/lock.txt
	@for layer in $(LAYERS); do \
	  if [ $$layer = run ]; then set --; else set -- $(call without,requirements/run.txt); fi; \
	  $(LOCK) requirements/$$layer.in --constraint build/lock.txt --output-file requirements/$$layer.txt "$$@" || exit 1; \
	done
	@$(LOCK) $(ARGS) --no-deps requirements/readers.in --output-file requirements/readers.txt
	@$(LOCK) $(ARGS) requirements/bench.in --constraint build/lock.txt --output-file requirements/bench.txt \
	  $$(sed -n 's/^\([A-Za-z0-9._-]*\)==.*/--no-emit-package \1/p' build/lock.txt)

audit: $(VENV)/.linked # Look the locked versions up for known vulnerabilities (ARGS="--advisories all.zip" without a network)
	@test -x $(VENV)/.audit/bin/pip-audit || { $(PY) -m venv $(VENV)/.audit && $(VENV)/.audit/bin/pip --quiet --quiet --disable-pip-version-check install pip-audit; }
	@$(PY) -m tests.audit $(ARGS)

docs: $(VENV)/.linked $(VENV)/.extras $(VENV)/.docs # Build the documentation site into build/site
	@$(PY) .docs/build.py

clean: # Remove what was built; .venv and bags/runs stay
	@rm -rf build install log .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis $(foreach p,$(PACKAGES),$(p)/*.egg-info $(p)/build)
	@find $(PACKAGES) tests -name __pycache__ -type d -prune -exec rm -rf {} +
