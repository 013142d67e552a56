#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Builds the source distribution and, from it, wheels for machines without a compiler: dist/ggslam-*-py3-none-*.whl. One
# wheel serves all Python versions (the core knows nothing of Python) and every Linux with glibc 2.28 or newer.
#   bash scripts/build_wheels.sh [x86_64] [aarch64]     which ones (default: this machine's own)
#   FOLDER=...   where to work (default: a temporary folder that is removed)
#   PYTHON=...   what makes the environment that builds (default: python3)
# Needs GCC; for another processor than this machine's its cross compiler, in Debian and Ubuntu g++-aarch64-linux-gnu or
# g++-x86-64-linux-gnu. Refuses a wheel that needs a newer glibc, as those of newer compilers than GCC 12 may.
set -eu
cd "$(dirname "$0")/.."
root=$PWD
unset PYTHONPATH
own=$(uname -m)
work=${FOLDER:-$(mktemp -d)}
mkdir -p "$work"
[ -n "${FOLDER:-}" ] || trap 'rm -rf "$work"' EXIT
[ $# -gt 0 ] || set -- "$own"
quietly() { "$@" >"$work/build.log" 2>&1 || { tail -30 "$work/build.log"; exit 1; }; }

"${PYTHON:-python3}" -m venv "$work/build"
python=$work/build/bin/python
"$python" -m pip install -q --disable-pip-version-check build wheel
rm -rf "$work/dist" && mkdir "$work/dist"
quietly "$python" -m build --sdist -o "$work/dist" "$root"
mkdir "$work/dist/source" && tar -xf "$work"/dist/*.tar.gz --strip-components 1 -C "$work/dist/source"
for machine in "$@"; do
  case $machine in x86_64|aarch64) ;; *) echo "no wheels for $machine"; exit 2 ;; esac
  settings=(-C cmake.define.GGSLAM_PORTABLE=ON)
  compiler=${CXX:-g++}
  if [ "$machine" != "$own" ]; then
    compiler=${machine/_/-}-linux-gnu-g++
    settings+=(-C cmake.define.CMAKE_SYSTEM_NAME=Linux -C cmake.define.CMAKE_SYSTEM_PROCESSOR="$machine")
  fi
  rm -rf "$work/$machine"
  CXX=$compiler quietly "$python" -m build --wheel "${settings[@]}" -o "$work/$machine" "$work/dist/source"
  quietly "$python" -m wheel tags --remove --platform-tag "manylinux_2_28_$machine" "$work/$machine"/*.whl
  cp "$work/$machine"/*.whl "$work/dist/"
done
rm -rf "$work/dist/source"
"$python" scripts/tools/check_wheel_file.py "$work"/dist/*.whl
mkdir -p dist && cp "$work"/dist/* dist/
