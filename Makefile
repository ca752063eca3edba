# SPDX-License-Identifier: GPL-3.0-or-later
# `make demo` and `make test` do all their own set-up; `make setup` does it alone. Stamps make a second call start at once.
.PHONY: help setup demo test test-slow lint core-tests blender-tests extension test-blender docs-images clean
.DEFAULT_GOAL := help

KERNELS := $(wildcard core/render/kernels/* core/videorf/kernels/*) CMakeLists.txt __init__.py
PYTEST_MARK ?= not slow

help:
	@echo "make demo    the whole loop on a sample scene; ends in demo/report.html"
	@echo "make test    everything that continuous integration runs"
	@echo "make setup   only the environments: .venv, .venv-bpy45, .venv-bpy52"
	@echo "make extension                   dist/holoreel-VERSION.zip, to install in Blender"
	@echo "make test-blender BLENDER=PATH   that zip in a real Blender"
	@echo "make docs-images [BLENDER=PATH]  the pictures of docs/blender.md, from a finished demo"
	@echo "make lint    ruff and mypy        make test-slow  the slow tests too        make clean"

setup: .venv/.ready .venv/.kernels .venv-bpy45/.ready .venv-bpy52/.ready

build/.system: scripts/setup.sh
	@scripts/setup.sh system
	@mkdir -p build && touch $@

.venv/.ready: pyproject.toml scripts/setup.sh | build/.system
	@scripts/setup.sh core
	@touch $@

.venv/.kernels: $(KERNELS) pyproject.toml | .venv/.ready
	@scripts/setup.sh kernels
	@touch $@

.venv-bpy45/.ready: scripts/setup.sh | build/.system
	@scripts/setup.sh blender 4.5
	@touch $@

.venv-bpy52/.ready: scripts/setup.sh | build/.system
	@scripts/setup.sh blender 5.2
	@touch $@

demo: setup
	@.venv/bin/python -m holoreel.core demo --out demo --blender "$$(ls -r .venv-bpy*/bin/python 2>/dev/null | head -n 1)"

lint: .venv/.ready .venv/.kernels
	.venv/bin/ruff format --check .
	.venv/bin/ruff check .
	@mkdir -p build/package && ln -sfn ../.. build/package/holoreel
	MYPYPATH=build/package .venv/bin/mypy

core-tests: .venv/.ready .venv/.kernels .venv-bpy52/.ready .venv-bpy45/.ready
	.venv/bin/python -m pytest tests/core -m "$(PYTEST_MARK)"

blender-tests: .venv-bpy45/.ready .venv-bpy52/.ready
	@for folder in .venv-bpy45 .venv-bpy52; do \
	  if [ -x $$folder/bin/python ]; then echo "$$folder:"; $$folder/bin/python -m pytest tests/blender -m "$(PYTEST_MARK)" || exit 1; \
	  else echo "$$folder: no Python for it here, skipped"; fi; done

test: setup lint core-tests blender-tests

test-slow:
	$(MAKE) test PYTEST_MARK=""

# With BLENDER, that Blender's own builder; without it, the one that the wheels carry.
extension: $(if $(BLENDER),,.venv-bpy45/.ready .venv-bpy52/.ready)
	@scripts/extension.sh "$(BLENDER)"

test-blender: extension .venv/.ready .venv/.kernels
	@[ -n "$(BLENDER)" ] || { echo "say which: make test-blender BLENDER=/path/to/blender" >&2; exit 2; }
	BLENDER="$(abspath $(BLENDER))" .venv/bin/python -m pytest tests/real_blender

# Renders by the wheels; with BLENDER, its windows too, on a virtual screen (Xvfb). FIELD names a VideoRF to show.
docs-images: setup extension
	.venv/bin/python scripts/docs_images.py $(if $(BLENDER),--blender "$(abspath $(BLENDER))") $(if $(FIELD),--field "$(FIELD)")

clean:
	rm -rf build demo dist .venv .venv-bpy45 .venv-bpy52
