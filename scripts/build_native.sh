#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Compiles the native core in place, so that a checkout can be used without installing it.
set -eu
cd "$(dirname "$0")/.."
[ "$(sed -n 's/^CMAKE_HOME_DIRECTORY:INTERNAL=//p' build/dev/CMakeCache.txt 2>/dev/null)" = "$PWD" ] || rm -rf build/dev  # of another checkout
cmake -S . -B build/dev -DCMAKE_BUILD_TYPE=Release >/dev/null
said=$(cmake --build build/dev -j "${JOBS:-2}" -- --no-print-directory 2>&1) || { echo "$said"; exit 1; }
echo "$said" | grep -vE '^\[|Consolidate|Scanning' || true  # warnings
mkdir -p ggslam/native/_lib
cp build/dev/libggslam_core.* ggslam/native/_lib/.new && mv ggslam/native/_lib/.new ggslam/native/_lib/libggslam_core.so
