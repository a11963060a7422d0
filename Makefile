# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0

PYTHON ?= python3
LOGS ?= ../shared/data/rotation_logs
FRAMES ?= frames
REAL ?= ../shared/data
BPY ?= bpyenv/bin/python
PY := .venv/bin/python
EVALUATE := $(PY) -m sph_stab_ros.evaluate --flows farneback,dis
SIMULATE := $(PY) -m sph_stab_ros.simulation
RENDER := $(BPY) tools/photoreal/render.py
RESULTS := results/evaluation
DOCS_TABLES := $(PY) -m sph_stab_ros.evaluation.docs_tables
FILL_IN_TABLES := $(DOCS_TABLES) $(RESULTS) docs/evaluation.md

# The virtual environments bring their own ROS 2; one that the shell has sourced must not mix in.
unexport PYTHONPATH LD_LIBRARY_PATH COLCON_PREFIX_PATH RMW_IMPLEMENTATION
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
export AMENT_PREFIX_PATH = $(CURDIR)/.venv

.PHONY: help setup demo test test-fast test-slow test-oldest fuzz coverage ledger evaluation
.PHONY: evaluation-real evaluation-offline evaluation-hard evaluation-rolling company evaluation-company benchmark
.PHONY: ablation benchmark-batch benchmark-before benchmark-company benchmark-ros soak stated-tables docs frames bags hard-frames hard constraints packages clean

help:  ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-19s%s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: .venv/complete  ## Build .venv: the package, ROS 2, colcon and the test tools

demo: setup  ## Look around in bags/drone by browser; leaves a video and a plot in results/demo
	$(PY) -m sph_stab_ros.demo bags/drone results/demo

# Three processes of tests, since many wait: for the node, for the page and for other programs, each
# of which are in one of them.
# After a crash nothing waits for what that process was to do.
PYTEST := -m pytest -n 3 --dist loadgroup --max-worker-restart 0
FAST := not slow and not thorough and not ros and not browser

test-fast: setup  ## Run the tests that need no ROS, no browser and little time, in two minutes
	$(PY) $(PYTEST) -m '$(FAST)'

test: setup  ## Run all tests but the slow ones, in nine minutes
	$(PY) $(PYTEST) -m 'not slow'

test-slow: setup  ## Run the slow tests
	$(PY) $(PYTEST) -m slow

FUZZ_SECONDS ?= 600
FUZZ_JOBS ?= $(shell nproc)

fuzz: setup  ## Damage inputs in new ways for FUZZ_SECONDS; what fails stays in results/fuzz
	OMP_NUM_THREADS=1 $(PY) test/support/run_fuzz.py --seconds $(FUZZ_SECONDS) --jobs $(FUZZ_JOBS)

# Processes that tests start are measured too; their files stay out of the way of the sources.
coverage: export COVERAGE_FILE = $(CURDIR)/results/coverage/data
coverage: setup  ## Run what needs no ROS, and tell in docs/tests.md what that covers
	mkdir -p results/coverage
	$(PY) $(PYTEST) -m 'not slow and not ros and not browser' --cov --cov-report=html:results/coverage/html \
	    --cov-report=json:results/coverage/coverage.json
	$(DOCS_TABLES) results/coverage docs/tests.md

ledger: setup  ## Write test/ledger.json, the accuracy measured; ONLY='drone anchored' for a part
	$(PY) test/support/tracking_accuracy.py $(ONLY)

# How the markers sit on the camera, where the motion does not tell or is too short to.
MOUNT := --mount=-7.182,-3.661,-2.975

evaluation: setup  ## Compare all estimators on the recordings, within half an hour
	mkdir -p $(RESULTS)
	$(EVALUATE) bags/drone --json $(RESULTS)/drone.json --plots $(RESULTS)/drone
	$(EVALUATE) bags/pioneer --json $(RESULTS)/pioneer.json --plots $(RESULTS)/pioneer $(MOUNT)
	$(EVALUATE) bags/handheld --json $(RESULTS)/handheld.json --plots $(RESULTS)/handheld
	for seed in 0 1 2; do \
	    $(SIMULATE) synthetic $(RESULTS)/textured_$$seed --seed $$seed --force && \
	    $(EVALUATE) $(RESULTS)/textured_$$seed --json $(RESULTS)/textured_$$seed.json $(MOUNT) \
	    || exit 1; done
	cp $(RESULTS)/drone/orientation.png docs/orientation.png
	$(FILL_IN_TABLES)

CAR = $(EVALUATE) $(REAL)/car_overpass/car_overpass.mp4 --inject 1 --max-frames 60
THETA = $(EVALUATE) $(REAL)/handheld_theta/handheld_theta.mp4 --max-frames 300
CAR_BODY := lat:-90,-12

evaluation-real: setup  ## The same on real footage in REAL, by rotations injected into it
	mkdir -p $(RESULTS)
	$(CAR) --json $(RESULTS)/car_turned.json
	$(CAR) --body $(CAR_BODY) --json $(RESULTS)/car_body.json
	$(CAR) --mask $(CAR_BODY) --json $(RESULTS)/car_mask.json
	$(THETA) --inject 1 --json $(RESULTS)/theta_1.json
	$(THETA) --inject 2 --estimators anchored --json $(RESULTS)/theta_2.json
	$(THETA) --inject 3 --estimators anchored --json $(RESULTS)/theta_3.json
	$(FILL_IN_TABLES)

OFFLINE = $(PY) -m sph_stab_ros.evaluate --estimators anchored --offline

evaluation-offline: setup  ## The live tracker beside the offline one, also on REAL and its company
	mkdir -p $(RESULTS)
	for one in drone handheld; do \
	    $(OFFLINE) bags/$$one --json $(RESULTS)/offline_$$one.json || exit 1; done
	$(OFFLINE) bags/pioneer --json $(RESULTS)/offline_pioneer.json $(MOUNT)
	for one in $(COMPANY); do \
	    $(OFFLINE) $$one --json $(RESULTS)/offline_$$(basename $$one).json || exit 1; done
	for seed in 1 2 3; do \
	    $(OFFLINE) $(REAL)/handheld_theta/handheld_theta.mp4 --max-frames 300 --inject $$seed \
	    --json $(RESULTS)/offline_theta_$$seed.json || exit 1; done
	$(FILL_IN_TABLES)

ROLLED = $(PY) -m sph_stab_ros.evaluate results/rolling/$(1) $(MOUNT) --estimators anchored

evaluation-rolling: setup  ## With a rolling shutter, not told of and told, on two simulated flights
	mkdir -p results/rolling $(RESULTS)
	$(SIMULATE) shake results/rolling/shake --force --frames-limit 60 --width 960 --hard rolling
	$(SIMULATE) drone results/rolling/drone --force --frames-limit 120 --width 960 --hard rolling \
	    --logs '$(LOGS)' --every 2
	for one in shake drone; do \
	    $(call ROLLED,$$one) --json $(RESULTS)/rolling_$$one.json && \
	    $(call ROLLED,$$one) -p rolling_shutter_s:=0.02 --json $(RESULTS)/rolling_$${one}_told.json \
	    || exit 1; done
	$(DOCS_TABLES) $(RESULTS) docs/cameras.md

evaluation-hard: setup  ## The same on what make hard has written
	mkdir -p $(RESULTS)
	for one in drone_15fps drone_bare shake; do \
	    $(EVALUATE) results/hard/$$one $(MOUNT) --json $(RESULTS)/$$one.json || exit 1; done
	$(EVALUATE) results/hard/hover $(MOUNT) --every 60 --estimators anchored \
	    --json $(RESULTS)/hover.json
	$(FILL_IN_TABLES)

test-oldest: AMENT_PREFIX_PATH = $(CURDIR)/.venv-oldest
test-oldest: .venv-oldest/complete  ## Run all tests with the oldest supported NumPy, OpenCV, ...
	.venv-oldest/bin/python $(PYTEST)

benchmark: setup  ## Time stages, pipelines, long recordings, others' methods; half an hour
	mkdir -p results/benchmark
	$(PY) -m sph_stab_ros.benchmark --json results/benchmark/benchmark.json
	$(DOCS_TABLES) results/benchmark docs/evaluation.md docs/benchmark.md docs/cameras.md

ROS_JSON := results/benchmark-ros/benchmark_ros.json
NODE := $(PY) -m sph_stab_ros.benchmark.node --profile config/fastdds_large_images.xml
OTHERS := '--output view/image' '--width 3840' '--width 3840 --output view/image'
# Browser, server and node on the same two cores, before other work where that may be asked for.
FIRST := $(shell chrt -r 10 true 2> /dev/null && echo chrt -r 10)
LATENCY := $(FIRST) $(PY) tools/operator_latency.py --add-to $(ROS_JSON)
LOSSY := --link 6 0.04 0.01

benchmark-ros: setup  ## Measure the node end to end, through the middleware, and the page
	mkdir -p results/benchmark-ros
	$(NODE) --json $(ROS_JSON)
	for one in $(OTHERS) '--output orientation'; do \
	    $(NODE) --transports compressed $$one --add-to $(ROS_JSON) || exit 1; done
	$(PY) -m sph_stab_ros.benchmark.source --add-to $(ROS_JSON)
	$(PY) -m sph_stab_ros.benchmark.source --view --add-to $(ROS_JSON)
	$(PY) -m sph_stab_ros.benchmark.source --width 3840 --view --add-to $(ROS_JSON)
	@if command -v chromium > /dev/null; then \
	  $(LATENCY) && $(LATENCY) --video jpeg --key jpeg && \
	  $(LATENCY) --rate 6 --frames 80 --video jpeg --key slow && \
	  $(LATENCY) --rate 6 --frames 80 --video jpeg --pictures stabilizer --key slow_derotated && \
	  if [ "$$(id -u)" = 0 ]; then \
	    $(LATENCY) $(LOSSY) && $(LATENCY) $(LOSSY) --video jpeg --key link_jpeg && \
	    $(LATENCY) --link 6 0.04 0 --key link_whole; \
	  else echo "without root the page is not measured over a bad link"; fi; \
	else echo "without chromium the operator's page is not measured"; fi
	$(DOCS_TABLES) results/benchmark-ros docs/node.md docs/benchmark.md docs/operator.md

BEFORE ?= HEAD~1

benchmark-before: setup  ## Stages, pipelines and node at the commit BEFORE and now, one after the other
	rm -rf results/before
	git worktree prune
	git worktree add --detach results/before $(BEFORE)
	cd results/before && $(CURDIR)/$(PY) setup.py -q build_ext --inplace
	for tree in $(CURDIR)/results/before $(CURDIR); do echo "$$tree:"; cd $$tree || exit 1; \
	  export PYTHONPATH=$$tree; \
	  $(CURDIR)/$(PY) -m sph_stab_ros.benchmark --parts times --widths 960,1920 || exit 1; \
	  $(CURDIR)/$(NODE) || exit 1; \
	  for one in $(OTHERS); do \
	    $(CURDIR)/$(NODE) --transports compressed $$one || exit 1; done; \
	done
	git worktree remove --force results/before

benchmark-batch: setup  ## What an hour of footage costs batch, and what segments do; minutes
	mkdir -p results/benchmark-batch
	$(PY) -m sph_stab_ros.benchmark.batch --json results/benchmark-batch/batch.json
	$(DOCS_TABLES) results/benchmark-batch docs/scale.md

soak: setup  ## Let the node run for ten minutes while everything around it changes
	mkdir -p results/soak
	$(PY) -m sph_stab_ros.benchmark.soak --json results/soak/soak.json
	$(DOCS_TABLES) results/soak docs/node.md

stated-tables: setup  ## Fill in the tables of docs/measured, which no target measures
	$(DOCS_TABLES) docs/measured README.md

frames:  ## Render the pictures of the recordings into FRAMES by tools/photoreal; resumes
	$(RENDER) drone '$(FRAMES)/drone' --logs '$(LOGS)' --frames 500
	$(RENDER) pioneer '$(FRAMES)/pioneer' --logs '$(LOGS)' --frames 300 --samples 4
	$(RENDER) handheld '$(FRAMES)/handheld' --logs '$(LOGS)' --frames 300 --samples 4

bags: setup  ## Write the recordings in bags anew from pictures in FRAMES
	$(SIMULATE) drone bags/drone --force --logs '$(LOGS)' --frames '$(FRAMES)/drone'
	$(SIMULATE) pioneer bags/pioneer --force --frames-limit 300 \
	    --logs '$(LOGS)' --frames '$(FRAMES)/pioneer'
	$(SIMULATE) handheld bags/handheld --force --frames-limit 300 \
	    --logs '$(LOGS)' --frames '$(FRAMES)/handheld'

HARD_DRONE := --logs '$(LOGS)' --every 2
HARD_PHOTOREAL := --samples 4 --exposure-s 0.03 --rolling-shutter-s 0.02 --stitch-deg 0.5 \
    --exposure-steps-ev 0.6 --people 2
HARD_QUICK := --hard blur --hard rolling --hard stitch --hard exposure
hard_pictures = $(if $(wildcard $(FRAMES)/$(1)),--frames '$(FRAMES)/$(1)',$(HARD_QUICK) $(2))

hard-frames:  ## Render the pictures of the hard recordings into FRAMES; resumes
	$(RENDER) drone '$(FRAMES)/drone_15fps' $(HARD_DRONE) --frames 240 $(HARD_PHOTOREAL)
	$(RENDER) drone '$(FRAMES)/drone_bare' $(HARD_DRONE) --frames 240 --bare $(HARD_PHOTOREAL)
	$(RENDER) shake '$(FRAMES)/shake' --frames 60 $(HARD_PHOTOREAL)

hard: setup  ## Write the hard recordings from pictures in FRAMES, else quickly rendered
	mkdir -p results/hard
	$(SIMULATE) drone results/hard/drone_15fps --force --frames-limit 120 $(HARD_DRONE) \
	    $(call hard_pictures,drone_15fps)
	$(SIMULATE) drone results/hard/drone_bare --force --frames-limit 120 $(HARD_DRONE) \
	    $(call hard_pictures,drone_bare,--hard plain)
	$(SIMULATE) shake results/hard/shake --force --frames-limit 60 $(call hard_pictures,shake)
	$(SIMULATE) hover results/hard/hover --force --hard exposure --width 320 --every 3

# Any others will do: nothing may be tuned to these alone.
SEEDS ?= 0 1 2 3

company: setup  ## Write simulated flights in company, of SEEDS="0 1 ..."; minutes each
	mkdir -p results/company
	for seed in $(SEEDS); do for kind in pioneer handheld; do \
	    $(SIMULATE) company_$$kind results/company/$${kind}_$$seed --seed $$seed --width 960 \
	    --force || exit 1; done; done

COMPANY = $(dir $(wildcard results/company/*/metadata.yaml $(REAL)/company/*/metadata.yaml))

evaluation-company: setup  ## Evaluate on what make company has written, and REAL/company
	mkdir -p $(RESULTS)/company
	for one in $(COMPANY); do \
	    $(PY) -m sph_stab_ros.evaluate $$one --estimators anchored --every 1 \
	    --json $(RESULTS)/company/$$(basename $$one).json || exit 1; done

benchmark-company: setup  ## How exact others' methods are on the same; minutes each
	mkdir -p results/benchmark/company
	for one in $(COMPANY); do \
	    $(PY) -m sph_stab_ros.benchmark $$one --parts references \
	    --json results/benchmark/company/$$(basename $$one).json || exit 1; done
	$(DOCS_TABLES) results/benchmark docs/benchmark.md

ablation: setup  ## What each part of anchored is worth, on bags and what make company has written
	mkdir -p $(RESULTS)
	$(PY) tools/ablation.py bags/drone bags/pioneer bags/handheld \
	    $(dir $(wildcard results/company/*/metadata.yaml)) --json $(RESULTS)/ablation.json
	$(FILL_IN_TABLES)

docs: .venv-docs/complete  ## Build the documentation's site into results/docs
	PACKAGE_PYTHON='$(CURDIR)/$(PY)' .venv-docs/bin/python -m sphinx -W --keep-going -E -b html docs results/docs

constraints:  ## Pin the newest and the oldest versions anew (needs uv)
	uv pip compile --universal --python-version 3.10 --all-extras --no-annotate --upgrade \
	    --custom-compile-command 'make constraints' setup.py -o constraints.txt
	uv pip compile --universal --python-version 3.10 --all-extras --no-annotate --upgrade \
	    --custom-compile-command 'make constraints' --resolution lowest-direct \
	    setup.py -o constraints-oldest.txt

packages:  ## Build sdist and wheel into dist/, and try them in bare environments (needs python3-build)
	tools/check_packages.sh '$(PYTHON)'

clean:  ## Remove the virtual environments and all results
	rm -rf .venv .venv-docs .venv-oldest results

# What is compiled must be that of these sources.
BUILT_FROM := setup.py sph_stab_ros/kernels/kernels.c tools/setup_venv.sh

.venv/complete: constraints.txt $(BUILT_FROM)
	tools/setup_venv.sh .venv constraints.txt '$(PYTHON)'

.venv-oldest/complete: constraints-oldest.txt $(BUILT_FROM)
	tools/setup_venv.sh .venv-oldest constraints-oldest.txt '$(PYTHON)'

# Sphinx and the test tools want different docutils; the package itself is that of .venv.
.venv-docs/complete: .venv/complete docs/requirements.txt
	rm -rf .venv-docs
	'$(PYTHON)' -m venv .venv-docs
	.venv-docs/bin/pip install --quiet -r docs/requirements.txt
	echo "import site; site.addsitedir('$$($(PY) -c 'import sysconfig; print(sysconfig.get_path("purelib"))')')" \
	    > "$$(.venv-docs/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/package.pth"
	touch .venv-docs/complete
