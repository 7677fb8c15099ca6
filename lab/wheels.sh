#!/usr/bin/env bash
# What the machine lacks beside ../shared/gpu/pack.sh: run after it.
python3 -m pip download -q --no-deps --only-binary=:all: --python-version 3.12 --platform manylinux2014_x86_64 --platform manylinux_2_17_x86_64 --platform manylinux_2_28_x86_64 \
  -d .gpu/wheels jsonschema==4.26.0 jsonschema-specifications==2025.9.1 attrs==26.1.0 referencing==0.37.0 rpds-py==2026.9.1 filelock==4.2.11 hypothesis==6.155.2 sortedcontainers==2.4.0 pytest-xdist==3.8.0 execnet==2.1.2
