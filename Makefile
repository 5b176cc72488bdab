# Two commands: `make demo` runs the main job, `make test` passes the tests. Both set up .venv by themselves:
# 360 MB for the demonstrations, 650 MB for the tests (810 with those of the page), 900 with the tools of `make check`.

PYTHON ?= python3
BIN := .venv/bin
DEMO := .venv/.demo
TEST := .venv/.test
DEV := .venv/.dev

.PHONY: demo demo-drift dev test test-times test-programs test-packages test-all test-slow test-power-cut test-apart test-lowest mutants test-samples test-matrix test-nion coverage test-ui test-gateway test-translators test-clients test-octave test-windows test-hosts
.PHONY: bill messages real-data real-data-record test-nexus test-tiled check bench bench-compare bench-drift bench-guests soak chaos crowd scanner-nights simulate replay-nights power-cut acts as-reported docs release-check test-plug-ins changelog clean
.DEFAULT_GOAL := demo

SOURCES := pyproject.toml $(wildcard packages/*/pyproject.toml) uv.lock hatch_build.py tools/bootstrap.py $(wildcard proto/*.proto)

# a stamp that is there is only out of date: bringing .venv up to date takes seconds, however large it is
SETTING_UP = $(if $(wildcard $@),Updating,Setting up)

$(DEMO): $(SOURCES)
	@echo "$(SETTING_UP) .venv: 360 MB …"
	@$(PYTHON) tools/bootstrap.py demo
	@touch $@

$(TEST): $(SOURCES)
	@echo "$(SETTING_UP) .venv for the tests: 650 MB, with a chromium 810 MB …"
	@$(PYTHON) tools/bootstrap.py test
	@touch $(DEMO) $@

$(DEV): $(SOURCES)
	@echo "$(SETTING_UP) .venv with all tools: 900 MB …"
	@$(PYTHON) tools/bootstrap.py all
	@touch $(DEMO) $(TEST) $@

NEXT = echo "Next: source .venv/bin/activate (it gives this shell the command afspm), and open $$(ls -t runs/*/report.html | head -1)"

## the paper's control transfer: a night of scans, a tip that changes, and its repair
demo: $(DEMO)
	@$(BIN)/afspm demo
	@$(NEXT)

## the paper's drift correction: a night on a sample that drifts, two hours without correction and sixteen with it
demo-drift: $(DEMO)
	@$(BIN)/afspm demo --drift
	@$(NEXT)

## the tests of every change, in nine minutes on two idle cores: units, decisions in simulated nights, protocols, and the
## processes that everything else stands on. More at a time than there are cores, since many of them wait; each process
## of pytest takes 14 s on the reference computer to import and collect all tests
TESTS_AT_A_TIME ?= 4
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/pytest
COLLECTED := .venv/.tests-collected
POWER_CUT := tests/system/record/test_power_cut.py
QUICK := tests/unit tests/simulation tests/plugins tests/docs $(addprefix tests/system/,scheduler supervisor process)
# Its processor time is printed at the end: make test MOST_TIME=1.5 fails above 1.5 times the limit in tools/processor_time.py
MOST_TIME ?=
TIMED = PYTHONDONTWRITEBYTECODE= $(BIN)/python tools/processor_time.py $(addprefix --fail-above=,$(MOST_TIME)) $(BIN)/pytest
test: $(COLLECTED)
	@$(TIMED) -n $(TESTS_AT_A_TIME) --dist worksteal -m "not slow and not program" $(TABLE) $(QUICK)

## the same, with the processor time of each folder and the most expensive tests
test-times: TABLE := --processor-times
test-times: test

## what is compared with a program or library that `make test` does not install: Gwyddion, GXSM, QCoDeS, sidpy; says which
## of them this computer lacks
test-programs: $(COLLECTED)
	@$(PYTEST) -m program tests/unit tests/plugins

## the packages of packages/ with tests of their own: agents, replays and studies of nights, and bridges to the published
## implementation
test-packages: $(COLLECTED)
	@$(PYTHON) tools/bootstrap.py packages
	@$(PYTEST) -n $(TESTS_AT_A_TIME) --dist worksteal --in-turn $(addprefix packages/afspm-,$(addsuffix /tests,agents lab published))

## the rest: whole experiments, samples, snippets of the docs, faults of controllers, mutants; of the largest sets a part,
## another at each commit (tests/support/rotation.py), and all with AFSPM_CASES=all. What is APART, or needs more (root,
## compilers, an hour), has a target of its own, below
# Fewer at a time than of the quick ones: each starts some ten processes, and more wait longer for each other than they gain
SLOW_AT_A_TIME ?= 5
test-all: test-slow test-power-cut

test-slow: $(COLLECTED)
	@$(PYTEST) -n $(SLOW_AT_A_TIME) --dist worksteal -m slow --in-turn $(addprefix --ignore ,$(APART) tests/system/hosts tests/system/octave $(POWER_CUT))

# A power cut is tried alone: the scheduler publishes what a disk has not taken within 0.2 s, which may be lost
test-power-cut: $(COLLECTED)
	@$(PYTEST) $(POWER_CUT)

## the page, the gateway, clients in other languages, the installed wheel, and each row of the benchmark once
UI := tests/ui
UI_TESTS = $(PYTEST) -n 2 --dist loadfile $(UI)
APART := $(UI) $(addprefix tests/system/,gateway clients install benchmarks)
test-apart: $(COLLECTED)
	@$(PYTEST) -n 4 --dist worksteal $(filter-out $(UI),$(APART))
	@$(UI_TESTS)

# asserts are rewritten once, not by each of the processes that run tests; what can't be collected fails there
$(COLLECTED): $(TEST) $(shell find tests -name '*.py')
	@ls -d tests/*/ | grep -v real_data | PYTHONDONTWRITEBYTECODE= xargs -P 2 -n 1 $(BIN)/pytest --collect-only -qq > /dev/null 2>&1; touch $@

## decisions broken on purpose, each of which the simulated nights have to find; prints how many they found
mutants: $(TEST)
	@AFSPM_CASES=all $(PYTEST) -n 2 $(addprefix tests/simulation/,test_mutants.py test_grant_mutants.py) packages/afspm-lab/tests/test_what_if.py

## the tests of units and plug-ins with the lowest versions of all dependencies, in build/lowest-env: needs Python 3.11
LOWEST ?= tests/unit tests/plugins
test-lowest:
	@$(PYTHON) tools/lowest_versions.py -n $(TESTS_AT_A_TIME) --dist worksteal -m "not slow" $(LOWEST)

## each component on the simulator, on five emulated controllers and on Nion's simulated microscope, and the table of docs/reference/instruments.md
test-matrix: $(COLLECTED)
	@rm -rf build/matrix
	@$(PYTHON) tools/bootstrap.py afspm-nion
	@AFSPM_MATRIX=$(CURDIR)/build/matrix $(PYTEST) -n 3 --dist worksteal tests/system/matrix -k recorded_outcome || \
	  AFSPM_MATRIX=$(CURDIR)/build/matrix $(PYTEST) --last-failed --last-failed-no-failures none tests/system/matrix -k recorded_outcome
	@AFSPM_MATRIX=$(CURDIR)/build/matrix $(NION)/.venv/bin/pytest -n 3 tests/system/matrix -k "recorded_outcome and nion"
	@$(BIN)/python tools/matrix.py build/matrix
	@$(BIN)/python tools/docs.py

## the driver of Nion's microscope, in an environment of its own: its tests, and its column of the matrix
NION := packages/afspm-nion
test-nion:
	@$(PYTHON) tools/bootstrap.py afspm-nion
	@PYTHONDONTWRITEBYTECODE= $(NION)/.venv/bin/pytest -n 2 --dist worksteal $(NION)/tests
	@AFSPM_CASES=all PYTHONDONTWRITEBYTECODE= $(NION)/.venv/bin/pytest -n 2 --dist worksteal tests/system/matrix -k nion

## every sample in experiments/, shortened, to its end
test-samples: $(TEST)
	@$(PYTEST) -n 4 tests/system/experiment/test_samples_run.py

## which lines of the package the tests of every change run: build/coverage/index.html
coverage: $(TEST)
	@$(PYTHON) tools/bootstrap.py coverage
	@$(PYTEST) -n 2 --dist worksteal -m "not slow" --cov=afspm --cov=afspm_bench --cov-report=html:build/coverage --cov-report=term:skip-covered \
	  tests/unit tests/simulation tests/plugins

## the dashboard in a real browser (Debian's chromium, or another: AFSPM_CHROMIUM=/path); screenshots in build/screenshots.
## Where all pass, tests/ui/last_green.txt says so to .ci/run, which then runs them only after a change (tools/page_sources.py)
test-ui: $(TEST)
	@$(PYTHON) tools/bootstrap.py browser
	@$(UI_TESTS) --must-run
	@$(BIN)/python tools/page_sources.py --green

## the gateway: against its own OpenAPI description (schemathesis, 25 MB), in several languages, with twenty clients
test-gateway: $(TEST)
	@$(PYTHON) tools/bootstrap.py gateway
	@AFSPM_SCHEMATHESIS_S=240 $(BIN)/pytest --must-run tests/system/gateway

## each base operation of every translator: the simulated microscope's, the image's, and those of emulated controllers
TRANSLATORS ?= $(wildcard experiments/every_microscope/[is]*.toml src/afspm/plugins/*/emulated.toml)
test-translators: $(TEST)
	@printf '%s\n' $(TRANSLATORS) | xargs -P 4 -I FILE $(BIN)/afspm test-translator FILE \
	  --frame "500 nm" --runs build/translators

## build the clients in other languages, and judge each by `afspm test-client`: CLIENTS=rust. Clients whose compilers are
# missing are skipped with the packages to install; if all are, it fails
CLIENTS ?=
test-clients: $(TEST)
	@$(BIN)/python tools/test_clients.py $(CLIENTS)

## the client in Java as MATLAB uses it, in GNU Octave: a component, and a script that joins. Says what this computer lacks
test-octave: $(TEST)
	@$(BIN)/pytest --must-run tests/system/octave

## tests with a Windows Python under Wine, on Debian, two folders at a time (an hour and more): make test-windows TESTS="tests/unit/wire"
# (those of whole experiments take longest: they come first; tip_repair is in components, the Nanonis sample in microscopes)
TESTS ?= $(wildcard tests/system/experiment/test_*.py) \
	$(addprefix tests/system/,supervisor microscopes components process record emulators) \
	$(filter-out %__/,$(wildcard tests/unit/*/)) $(wildcard tests/unit/test_*.py)
test-windows: $(TEST)
	@$(PYTHON) tools/windows/python.py
	@$(PYTHON) tools/windows/run_tests.py $(TESTS)

## an experiment on four hosts (network namespaces: on Linux, as root) over links that are slow, lossy, cut and gone
test-hosts: $(TEST)
	@$(BIN)/pytest --must-run -n 2 tests/system/hosts

## files of real microscopes, which are not in the repository, beside the record of what is in them: AFSPM_DATA=/path/to/data
# (default: shared/data beside this folder)
real-data: $(TEST)
	@$(BIN)/pytest -n 2 --dist worksteal tests/real_data

## that record, written again after an intended change
real-data-record: $(TEST)
	@$(BIN)/python tests/real_data/record.py

## the files of runs, with the validator of NeXus
test-nexus: $(TEST)
	@$(PYTHON) tools/validate_nexus.py

## the folder of a run, as Tiled serves it
test-tiled: test-nexus
	@$(PYTHON) tools/serve_with_tiled.py

## everything for those who change afspm: the environment, and the hooks that check each commit
dev: $(DEV)
	@$(BIN)/pre-commit install

## the message classes of src/afspm/wire/generated, compiled after a change in proto/
messages: $(TEST)
	@echo "The message classes are up to date: src/afspm/wire/generated"

## style, spelling, types, which package imports which, the workflows, the answers of drivers to the
## quality scale, and the claims behind their marks (! ID)
check: $(DEV)
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/codespell
	@$(BIN)/mypy
	@$(BIN)/lint-imports
	@$(BIN)/zizmor --quiet --no-progress --offline --strict-collection --persona pedantic .github
	@$(BIN)/python tools/quality.py
	@$(BIN)/python tools/claims.py
	@$(BIN)/python tools/doors.py

## lines of code by capability, and how much each has grown since the last landing (tools/last_landing.txt)
bill: $(TEST)
	@$(BIN)/python tools/bill.py $(addprefix --base=,$(BASE))

## speed, beside bare pyzmq and beside the last landed run: a table, and build/bench.json. LAND=1 lands this run's ratios
bench: $(TEST)
	@$(BIN)/python -m benchmarks $(if $(LAND),--land)

## two commits, measured in turn on this computer: make bench-compare BEFORE=main~5 AFTER=HEAD NAMES="control_round_trip"
AFTER ?= HEAD
bench-compare: $(TEST)
	@$(BIN)/python -m benchmarks.compare $(BEFORE) --after $(AFTER) $(NAMES)

## drift: errors of the estimates beside the theoretical bound, and build/bench-drift.json, in 90 minutes of processor.
## EIGHTH=1 runs an eighth of the pairs, in four minutes, and judges the targets that allow no pair. LAND=1 lands this run
bench-drift: $(TEST)
	@$(BIN)/python -m benchmarks.drift $(if $(EIGHTH),--quick) $(if $(LAND),--land)

## line watch, learning repair and adaptive maps, on surfaces, answers and maps that no setting was tried on: hours.
## The last one misses its target, hum without retrace, and so ends with an error
bench-guests: $(TEST)
	@$(BIN)/python -m benchmarks.line_watch --rooms 40
	@$(BIN)/python -m benchmarks.tip_learning --full
	@$(BIN)/python -m benchmarks.adaptive
	@$(BIN)/python -m benchmarks.line_watch --rooms 40 --without-retrace

## malformed requests and packets, and random calls of every emulated controller: make soak MESSAGES=20000 CALLS=5000
MESSAGES ?= 1000000
CALLS ?= 50000
soak: $(TEST)
	@$(BIN)/python -m benchmarks.soak $(MESSAGES)
	@$(BIN)/python -m benchmarks.fuzz $(CALLS)

## nights with tip repair in which processes are killed and frozen: make chaos NIGHTS=100 CHAOS_SEED=1
NIGHTS ?= 20
CHAOS_SEED ?= $(shell date +%s)
chaos: $(TEST)
	@$(BIN)/python -m benchmarks.chaos --nights $(NIGHTS) --seed $(CHAOS_SEED)

## the nights of demo and demo-drift with the default scanner and with a real one's statistics, side by side: half an hour
scanner-nights: $(TEST)
	@$(BIN)/python -m benchmarks.scanner_nights

## acts of a person at five emulated panels, between and in the requests of a run, and the same runs without one: a table
## by maker and kind of act. make acts CASES=3 tries 3 of each maker. Fails if a wrong result was published as complete
CASES ?= 84
acts: $(TEST)
	@$(BIN)/python -m tests.plugins.acts_at_wire_moments --cases $(CASES)

## plain subscribers that join and leave in crowds, on a run without keys: make crowd SCANS=40
SCANS ?= 40
crowd: $(TEST)
	@$(BIN)/python -m benchmarks.crowd --scans $(SCANS)

## what others report of real instruments, one report after the other, at the emulated Nanonis: which are noticed before the
## tip is at the sample, and which in two scans. Fails if a report is neither noticed nor harmless
REPORTS ?=
as-reported: $(TEST)
	@$(BIN)/python -m tests.plugins.nanonis.as_reported $(REPORTS)

## a long deterministic simulation, held z with kills at any step, and nights with a coarse motor:
## make simulate HOURS=100000 SEED=1 HOLDS=200 MOVES=200
HOURS ?= 20000
SEED ?= 1
HOLDS ?= 200
MOVES ?= 200
SHARED ?= 200
simulate: $(TEST)
	@$(BIN)/python -m tests.simulation.held_z_kills $(HOLDS)
	@$(BIN)/python -m tests.simulation.mover_nights $(MOVES)
	@$(BIN)/python -m tests.simulation.shared_nights $(SHARED)
	@$(BIN)/python -m tests.simulation.long_run --hours $(HOURS) --seed $(SEED)

## nights with kills, replayed by what-if without a change: NIGHTS=200 SEED=0
replay-nights: $(TEST)
	@PYTHONPATH=tests/support:packages/afspm-lab/tests $(BIN)/python -m replayed_nights --nights $(NIGHTS) --seed $(SEED)
replay-nights: NIGHTS = 200

## a recorded run that loses its power, with all that was not synced, and is resumed, again and again: CUTS=100 SEED=1
CUTS ?= 100
power-cut: $(TEST)
	@$(BIN)/python tests/system/record/power_cut.py --cuts $(CUTS) --seed $(SEED)

## all that can be tried before a release, without publishing anything: distributions, metadata, contents, installations
release-check: $(TEST)
	@$(PYTHON) tools/bootstrap.py release
	@$(BIN)/python tools/release_check.py

## packages from outside the tree beside the wheel: a maker, a component, the templates of `afspm new`
test-plug-ins:
	@$(PYTHON) tools/release_check.py build plug-ins

## the documentation as a site with search: build/site/index.html. A broken link fails
docs:
	@$(PYTHON) tools/build_docs.py

## the news fragments of changes/, moved into CHANGELOG.md under the version of pyproject.toml
changelog: $(TEST)
	@$(BIN)/python tools/changelog.py

clean:
	rm -rf .venv build runs
