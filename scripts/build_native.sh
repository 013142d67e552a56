#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Compiles the native core in place, so that a checkout can be used without installing it.
set -eu
cd "$(dirname "$0")/.."
cmake -S . -B build/dev -DCMAKE_BUILD_TYPE=Release >/dev/null
cmake --build build/dev -j "${JOBS:-2}" -- --no-print-directory 2>&1 | grep -vE '^\[|Consolidate|Scanning' || true
mkdir -p ggslam/native/_lib
cp build/dev/libggslam_core.* ggslam/native/_lib/.new && mv ggslam/native/_lib/.new ggslam/native/_lib/libggslam_core.so
