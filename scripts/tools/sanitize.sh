#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Compiles the core with a sanitizer of GCC, in a folder of its own, runs tests with it, and counts what it reports of our
# code: bash scripts/tools/sanitize.sh address|undefined|thread [--all] [arguments of pytest]
#
# Without arguments of pytest: the tests that run the core's parts, --all: all but the slow ones. One instruction set is
# built, the widest that this processor has, or GGSLAM_ONLY. Exits with 1 if anything was reported or a test failed.
set -eu
cd "$(dirname "$0")/../.."
kind=${1:-}; shift || true
case $kind in address|undefined|thread) ;; *) sed -n 's/^# //p' "$0" | sed -n 2,8p; exit 2 ;; esac
tests=(tests/native tests/abi tests/volumes tests/driving tests/coding tests/rendering tests/tracking tests/mapping tests/submaps)
if [ "${1:-}" = --all ]; then shift; tests=(tests); elif [ $# -gt 0 ]; then tests=(); fi

# --- build ------------------------------------------------------------------------------------------------------------
only=baseline
for set in avx2 avx512; do
  needed=$([ $set = avx2 ] && echo bmi2 || echo avx512bw)
  if grep -qw "$needed" /proc/cpuinfo 2>/dev/null; then only=$set; fi
done
only=${GGSLAM_ONLY:-$only}
build=$PWD/build/sanitize-$kind
cmake -S . -B "$build" -DCMAKE_BUILD_TYPE=Release -DGGSLAM_SANITIZE="$kind" -DGGSLAM_ONLY="$only" >/dev/null
cmake --build "$build" -j "${JOBS:-2}" -- --no-print-directory >"$build/build.log" 2>&1 || { tail -40 "$build/build.log"; exit 1; }

# --- run --------------------------------------------------------------------------------------------------------------
# What is preloaded must be the libraries of the compiler that built the core. Exceptions are thrown by libstdc++, which
# Python itself does not load.
library() { "${CXX:-g++}" -print-file-name="$1"; }
rm -rf "$build/reports"; mkdir -p "$build/reports"
common="log_path=$build/reports/report:print_stacktrace=1:suppressions=$PWD/scripts/tools/sanitize_$kind.txt"
preload=
case $kind in
  # Python, torch and numpy leave memory to the end of the process: leaks are not looked for.
  address)
    preload="$(library libasan.so) $(library libstdc++.so)"
    export ASAN_OPTIONS="$common:detect_leaks=0:halt_on_error=0:allocator_may_return_null=1:handle_segv=1"
    ;;
  undefined) export UBSAN_OPTIONS="$common" ;;
  thread)
    preload="$(library libtsan.so) $(library libstdc++.so)"
    export TSAN_OPTIONS="$common:halt_on_error=0:report_signal_unsafe=0:ignore_noninstrumented_modules=1:exitcode=0"
    ;;
esac
python=${PYTHON:-python}
status=0
GGSLAM_SANITIZER=$kind GGSLAM_CORE=$build/libggslam_core.so PYTHONPATH=$PWD OMP_NUM_THREADS=1 LD_PRELOAD=$preload \
  "$python" -m pytest -q -p no:cacheprovider -m "not slow" "${tests[@]}" "$@" || status=$?

# --- count ------------------------------------------------------------------------------------------------------------
# A report is ours where its stack meets the core.
"$python" - "$kind" "$build/reports" "$status" <<'END'
import re, sys
from collections import Counter
from pathlib import Path

kind, folder, status = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
begin = {"address": r"ERROR: AddressSanitizer", "undefined": r"runtime error:", "thread": r"WARNING: ThreadSanitizer"}[kind]
ours, others = Counter(), 0
for path in sorted(folder.iterdir()):
    lines = path.read_text(errors="replace").splitlines()
    starts = [i for i, line in enumerate(lines) if re.search(begin, line)] + [len(lines)]
    for first, end in zip(starts, starts[1:]):
        place = next((m for line in lines[first:end] for m in re.findall(r"ggslam/(?:native/src|abi)/([\w/.]+:\d+)", line)), None)
        if place is None and not any("libggslam_core" in line for line in lines[first:end]):
            others += 1
            continue
        what = lines[first].split(begin.split()[-1])[-1].strip(": ")
        ours[f"{place or 'the core'}: {re.sub(r'0x[0-9a-f]+|(?<=value )[-+.e0-9]+', '...', what)[:100]}"] += 1
for what, count in ours.most_common():
    print(f"{count:6d}  {what}")
print(f"{kind}: {sum(ours.values())} reports of our code ({len(ours)} places), {others} of others; tests exited with {status}")
sys.exit(1 if ours or status else 0)
END
