#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Sets up a virtual environment with everything the tests use, and runs them in a process per processor and one more,
# since some wait for browsers and other processes. Arguments go to pytest; `-n 0` runs all in one process.
set -eu
cd "$(dirname "$0")/.."
venv=${GGSLAM_VENV:-.venv}
VENV=$venv bash scripts/install.sh tests
# pytest rewrites every test file before it runs it; what it made is kept for the next time.
unset PYTHONDONTWRITEBYTECODE
# The tests import the installed package, not the checkout, so that packaging is tested too. A file's tests stay in one
# process, for they share what they prepare.
processes=$(( $(nproc 2>/dev/null || echo 1) + 1 ))
exec "$venv/bin/pytest" -q -n $(( processes < 8 ? processes : 8 )) --dist loadfile --no-loadscope-reorder "$@"
