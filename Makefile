# Three commands matter: `make run`, `make test-quick`, `make test`. They make .venv from the hash-pinned lock first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PRESET ?= plain
# Images for containers set it. Then each program that a test starts would compile its sources again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run fleet pictures test test-quick test-thorough test-all nightly lint bench faults faults-short soak lock deb container site clean

$(VENV)/runtime: requirements.lock requirements-build.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "fieldcal needs Python 3.11 or later, this is " + sys.version)'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock -r requirements-build.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps --editable .
	touch $@

$(VENV)/development: requirements-dev.lock $(VENV)/runtime
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-dev.lock
	touch $@

run: $(VENV)/runtime  ## the agent on the virtual bench, with a router beside it; PRESET=faulty or guided for others
	$(BIN)/fieldcal run --preset $(PRESET) --rate-hz auto --with-router --signing-key keys/virtual.bench.signing.key

# A shell ignores SIGINT in what it runs in the background, so the monitor is ended with SIGTERM.
fleet: $(VENV)/development  ## router, fleet page and a simulated fleet of 40 sensors, of a year in six minutes; until Ctrl-C
	@directory=$$(mktemp -d); touch $$directory/known.keys; \
	$(BIN)/fieldcal monitor --router --data-dir $$directory --keys $$directory/known.keys & monitor=$$!; \
	trap 'kill $$monitor 2>/dev/null; wait $$monitor; rm -r $$directory' EXIT; trap : INT TERM; \
	$(BIN)/fieldcal simulate --fleet 10 --sensors 4 --every 4 --age 365 --speed 86400 --keys $$directory/known.keys

pictures: $(VENV)/development  ## the pictures of README and docs that show running programs: terminal, pages of fleet and bench, report
	$(BIN)/python -m docs.images.run_svg
	$(BIN)/python -m tests.scenarios.fleet_page
	$(BIN)/python -m tests.scenarios.bench_page
	$(BIN)/python -m tests.scenarios.report_pictures
	$(BIN)/python -m docs.images.inputs

# Tests of running programs against the clock can fail where other work delays them. What failed runs once more, alone.
once_more = { test $$? = 1 && $(BIN)/python -m pytest --last-failed --last-failed-no-failures none $(1); }

# Five for two processors: two of them take scenarios, which mostly wait for programs that they start, and three the other
# tests, of which some wait too (tests/conftest.py). With two and two a sixth of the processors' time was not used.
PROCESSES = $$((5 * $$(nproc) / 2))

# $(1): processes; $(2): which tests
tested = $(BIN)/python -m pytest -n $(1) --dist loadscope --no-loadscope-reorder $(2)

# The drivers' contract reads so many samples, and where a device counts them in 16 bits more than these hold;
# `pytest tests/contract` reads a million.
test: export FIELDCAL_CONTRACT_SAMPLES = 2000
test-all test-thorough nightly: export FIELDCAL_CONTRACT_SAMPLES = 5000
test: $(VENV)/development  ## before a merge: what decides whether results, uncertainties, recordings and the program are right
	$(call tested,$(PROCESSES),-m "not faults and not thorough") || $(call once_more,-m "not faults and not thorough")

# The drivers' contract reads 1,000 samples here.
test-quick: export FIELDCAL_CONTRACT_SAMPLES = 1000
test-quick: $(VENV)/development  ## before a commit: modules, properties and drivers, in under two minutes
	$(call tested,$$((2 * $$(nproc))),-m "not faults and not thorough and not slow" tests/unit tests/properties tests/contract)

test-thorough: $(VENV)/development  ## what `make test` leaves out: worlds of months, other adapters, more seeds
	$(call tested,$(PROCESSES),-m "thorough and not nightly") || $(call once_more,-m "thorough and not nightly")

# In one run: what waits for programs in one part leaves the processors to the other.
test-all: $(VENV)/development  ## the tests that need neither root nor hardware, but for those of each night
	$(call tested,$(PROCESSES),-m "not faults and not nightly") || $(call once_more,-m "not faults and not nightly")

nightly: $(VENV)/development  ## what `make test-all` leaves out; the twins under Debian's kernel in QEMU, which needs qemu-system-x86, busybox-static and Debian's apt
	$(call tested,$(PROCESSES),-m nightly) || $(call once_more,-m nightly)
	$(BIN)/python -m tests.nightly

lint: $(VENV)/development
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(VENV)/development  ## figures, each a ratio against a named alternative; writes docs/performance.md
	$(BIN)/python -m benchmarks

faults: $(VENV)/development  ## breaks the agent on purpose, for an hour; needs root and tools; writes docs/reliability.md
	$(BIN)/python -m tests.faults

# The slow disk is tested alone, because a busy machine makes a disk look slower than it is. What failed runs once more.
faults-short: $(VENV)/development  ## the same in a few minutes; skips what this machine cannot do
	$(BIN)/python -m pytest -n auto --dist worksteal -m faults tests/faults -k "not slow" || \
		$(call once_more,-m faults tests/faults)
	$(BIN)/python -m pytest -m faults tests/faults -k slow || \
		$(call once_more,-m faults tests/faults)

soak: $(VENV)/development  ## 24 h in 72 min, then an hour in real time; writes docs/reliability.md
	$(BIN)/python -m benchmarks.soak --part soak-day
	$(BIN)/python -m benchmarks.soak --hours 1 --speed 1 --rate-hz 1000 --part soak-hour

deb: $(VENV)/runtime  ## the Debian package, into dist/; ARCH=arm64 for that architecture
	deploy/debian/build.sh $(if $(ARCH),--arch $(ARCH))

container: $(VENV)/runtime  ## the container image, as an OCI archive in dist/; BASE=IMAGE builds on that image; needs root and buildah
	deploy/container/build.sh $(if $(BASE),--base $(BASE))

$(VENV)-docs/done: requirements-docs.lock
	test -x $(VENV)-docs/bin/python || $(PYTHON) -m venv $(VENV)-docs
	$(VENV)-docs/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-docs.lock
	touch $@

site: $(VENV)-docs/done  ## the documentation as a site, into dist/site; a warning is an error
	NO_MKDOCS_2_WARNING=1 $(VENV)-docs/bin/mkdocs build --strict

COMPILE = UV_CUSTOM_COMPILE_COMMAND="make lock" uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate
EXTRAS = $(shell sed -n '/^\[project.optional-dependencies\]/,/^\[project.scripts\]/s/^\([a-z0-9]*\) = .*/\1/p' pyproject.toml)

lock:  ## make the lock files anew (needs uv): of a gateway, of the tools, of the build backend, of each optional part, of the site
	$(COMPILE) pyproject.toml -o requirements.lock
	$(COMPILE) -c requirements.lock --group build --group dev --group bench pyproject.toml -o requirements-dev.lock
	$(COMPILE) -c requirements-dev.lock --group build -o requirements-build.lock
	for extra in $(EXTRAS); do \
		$(COMPILE) -c requirements.lock -c requirements-dev.lock --extra $$extra pyproject.toml \
			$$(sed -n 's/^\([a-z0-9-]*\)==.*/--no-emit-package \1/p' requirements.lock) -o agent/setup/locks/$$extra.lock || exit 1; \
	done
	echo 'mkdocs-material>=9.7,<10' | $(COMPILE) - -o requirements-docs.lock

clean:
	rm -rf $(VENV) $(VENV)-docs .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
