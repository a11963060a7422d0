# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0

PYTHON ?= python3
LOGS ?= ../shared/data/rotation_logs
FRAMES ?= frames
PY := .venv/bin/python
EVALUATE := $(PY) -m sph_stab_ros.evaluate --flows farneback,dis

# The virtual environments bring their own ROS 2; one that the shell has sourced must not mix in.
unexport PYTHONPATH LD_LIBRARY_PATH COLCON_PREFIX_PATH RMW_IMPLEMENTATION
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
export AMENT_PREFIX_PATH = $(CURDIR)/.venv

.PHONY: help setup demo test test-oldest benchmark bags constraints clean

help:  ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-14s%s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: .venv/complete  ## Build .venv: the package, ROS 2, colcon and the test tools

demo: setup  ## Play bags/drone through the node; leaves a video and a plot in results/demo
	$(PY) -m sph_stab_ros.demo bags/drone results/demo

test: setup  ## Run all tests
	$(PY) -m pytest

# Pioneer's motion does not tell how the markers sit on its camera; this is how they do.
evaluation: setup  ## Compare all estimators on the recordings, within half an hour
	mkdir -p results/evaluation
	$(EVALUATE) bags/drone --json results/evaluation/drone.json --plots results/evaluation/drone
	$(EVALUATE) bags/pioneer --json results/evaluation/pioneer.json \
	    --plots results/evaluation/pioneer --mount=-7.182,-3.661,-2.975
	$(EVALUATE) bags/handheld --json results/evaluation/handheld.json \
	    --plots results/evaluation/handheld

test-oldest: AMENT_PREFIX_PATH = $(CURDIR)/.venv-oldest
test-oldest: .venv-oldest/complete  ## Run all tests with the oldest supported NumPy, OpenCV, ...
	.venv-oldest/bin/python -m pytest

benchmark: setup  ## Time all stages and pipelines; leaves the figures in results/benchmark
	mkdir -p results/benchmark
	$(PY) -m sph_stab_ros.benchmark --json results/benchmark/benchmark.json

bags: setup  ## Write the recordings in bags anew from pictures by tools/photoreal in FRAMES
	$(PY) -m sph_stab_ros.simulation drone bags/drone --force \
	    --logs '$(LOGS)' --frames '$(FRAMES)/drone'
	$(PY) -m sph_stab_ros.simulation pioneer bags/pioneer --force --frames-limit 300 \
	    --logs '$(LOGS)' --frames '$(FRAMES)/pioneer'
	$(PY) -m sph_stab_ros.simulation handheld bags/handheld --force --frames-limit 300 \
	    --logs '$(LOGS)' --frames '$(FRAMES)/handheld'

constraints:  ## Pin the newest and the oldest versions anew (needs uv)
	uv pip compile --universal --python-version 3.10 --all-extras --no-annotate --upgrade \
	    --custom-compile-command 'make constraints' setup.py -o constraints.txt
	uv pip compile --universal --python-version 3.10 --all-extras --no-annotate --upgrade \
	    --custom-compile-command 'make constraints' --resolution lowest-direct \
	    setup.py -o constraints-oldest.txt

clean:  ## Remove the virtual environments and all results
	rm -rf .venv .venv-oldest results

.venv/complete: constraints.txt setup.py tools/setup_venv.sh
	tools/setup_venv.sh .venv constraints.txt '$(PYTHON)'

.venv-oldest/complete: constraints-oldest.txt setup.py tools/setup_venv.sh
	tools/setup_venv.sh .venv-oldest constraints-oldest.txt '$(PYTHON)'
