#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Builds, tests and measures what runs on a GPU, in one call, from the checkout: needs an NVIDIA GPU, nvcc, cmake, Python
# with a CUDA build of torch, numpy and pytest; installs nothing and needs no network. Whole runs and some tests also need
# opencv, scipy, pyyaml and pydantic, closing loops needs gtsam: where they are missing, PYTHONPATH may name a folder that
# has them. Goes on after a step that fails and says at the end which did.
#   FOLDER=...     where the log of each step goes (default: build/gpu_check)
#   ARCHIVE=...    also puts all of that into one file .tar.gz at the end, whatever happened
#   STEPS="..."    which steps to run, in this order whatever is said:
#                    machine build compile tests slam realtime profile loops bench training volumes frontends
#   SHORT=1        less of everything, for ten minutes in all (tests: those that need the GPU); no step begins or goes
#                  on after LIMIT seconds
#   LIMIT=...      seconds; 0: none (default: 0, with SHORT 540)
#   DATA=...       folder with recordings (default: GGSLAM_DATA, else ../shared/data, shared/data or build/recordings,
#                  whichever there is); without recordings a room is generated
#   SLAM="..."     arguments of scripts/benchmarks/bench_cuda_slam.py, for the steps slam, realtime, profile and loops
#   BENCH="..."    arguments of scripts/benchmarks/bench_cuda_render.py
#   TRAINING="..." arguments of scripts/benchmarks/bench_cuda_training.py
#   VOLUMES="..."  arguments of scripts/benchmarks/bench_cuda_volumes.py
#   FRONTENDS="..." arguments of scripts/benchmarks/bench_frontends.py; the step needs recordings
#   SANITIZE=1     runs a few tests under compute-sanitizer's memcheck, racecheck and synccheck, too (minutes)
set -u
cd "$(dirname "$0")/../.."
export PYTHONPATH=$PWD:$PWD/scripts/benchmarks:$PWD/scripts/tools${PYTHONPATH:+:$PYTHONPATH} PYTHONUNBUFFERED=1 OMP_WAIT_POLICY=PASSIVE
export python=${PYTHON:-python3}
export folder=${FOLDER:-build/gpu_check}
export GGSLAM_CACHE=${GGSLAM_CACHE:-$PWD/build/cuda_cache}
mkdir -p "$folder"
for place in "${DATA:-}" "${GGSLAM_DATA:-}" ../shared/data shared/data build/recordings; do
  [ -z "$place" ] || [ ! -d "$place" ] || { export GGSLAM_DATA=$place && break; }
done
wanted=${STEPS:-machine build compile tests slam realtime profile loops bench training volumes frontends}
export PICK="not slow" SLAM=${SLAM:-} BENCH=${BENCH:-} TRAINING=${TRAINING:-} VOLUMES=${VOLUMES:-} FRONTENDS=${FRONTENDS:-} LOOPS=""
limit=${LIMIT:-0}
if [ -n "${SHORT:-}" ]; then
  limit=${LIMIT:-540}
  PICK="gpu and not slow"
  SLAM=${SLAM:---only redkitchen --frames 100}
  LOOPS="--frames 40 --loops 5"
  BENCH=${BENCH:---counts 300000 --sizes 640x480 --repeat 15}
  TRAINING=${TRAINING:---counts 300000 --sizes 640x480 --repeat 15}
fi
failed="" times=""

finish() {
  [ -z "${ARCHIVE:-}" ] || tar czf "$ARCHIVE" -C "$folder" .
}
trap finish EXIT

# missing MODULE...: those that Python lacks.
missing() {
  "$python" - "$@" <<'CODE'
import importlib.util
import sys
print(*(name for name in sys.argv[1:] if importlib.util.find_spec(name) is None))
CODE
}
export whole_runs="numpy torch cv2 scipy yaml pydantic"

# step NAME FUNCTION: runs it if the step is wanted and there is time, shows its output and keeps it.
step() {
  local name=$1 left=86400 start=$SECONDS status
  case " $wanted " in *" $name "*) ;; *) return ;; esac
  if [ "$limit" -gt 0 ]; then
    left=$((limit - SECONDS))
    if [ "$left" -le 5 ]; then
      echo "=== $name: left out, no time"
      failed="$failed $name" times="$times $name:-"
      return
    fi
  fi
  echo "=== $name"
  timeout -k 10 "$left" bash -uc "$2" 2>&1 | tee "$folder/$name.log"
  status=${PIPESTATUS[0]}
  echo "=== $name: status $status, $((SECONDS - start)) s"
  times="$times $name:$((SECONDS - start))"
  [ "$status" -eq 0 ] || failed="$failed $name"
}

machine() {
  nvidia-smi --query-gpu=name,driver_version,memory.total,compute_cap --format=csv
  nvcc --version | tail -2
  "$python" -c 'import sys, torch; print(sys.version.split()[0], torch.__version__, torch.cuda.is_available())'
  echo "$(nproc) processors, recordings: $(ls "${GGSLAM_DATA:-/nowhere}" 2>/dev/null | tr '\n' ' ')"
  local lacks
  lacks=$(missing pytest $whole_runs gtsam)
  [ -z "$lacks" ] || echo "missing Python packages: $lacks"
  "$python" -c 'import sys, torch; sys.exit(None if torch.cuda.is_available() else "torch finds no GPU")'
}

build() {
  JOBS=${JOBS:-$(nproc)} bash scripts/build_native.sh &&
    test -f ggslam/native/_lib/libggslam_core.so
}

# Compiles the kernels for this GPU as a user's first call does, then once more to list registers and spills.
compile() {
  "$python" - <<'CODE' || return 1
import time
import torch
from ggslam.cuda.compiler import compiled_library
architecture = "".join(map(str, torch.cuda.get_device_capability()))
start = time.perf_counter()
print(compiled_library(architecture), f"{time.perf_counter() - start:.1f} s")
CODE
  local arch source
  arch=$("$python" -c 'import torch; print("".join(map(str, torch.cuda.get_device_capability())))')
  find ggslam/cuda/kernels -name '*.cu' ! -name sorting.cu ! -name library.cu -print0 | sort -z | xargs -0 -P "$(nproc)" -I{} sh -c '
    nvcc -O3 -std=c++17 -ftz=true -Xptxas -v -gencode "arch=compute_$0,code=sm_$0" -c -o /dev/null \
      -I ggslam/cuda/kernels -I ggslam "$1" >"$2/$(basename "$1").ptxas" 2>&1' "$arch" {} "$folder"
  for source in "$folder"/*.ptxas; do
    grep -E "Compiling|spill|Used|error|warning" "$source" | { c++filt 2>/dev/null || cat; }
    rm "$source"
  done
}

tests() {
  "$python" -m pytest -q -p no:cacheprovider -rs -m "$PICK" -k "not (emulated or downwards or jumping)" --durations=15 --tb=short \
    --continue-on-collection-errors tests/rendering tests/mapping tests/tracking tests/slam tests/cuda \
    tests/volumes/test_cuda_*.py
}

sanitize() {
  local tool
  for tool in memcheck racecheck synccheck; do
    compute-sanitizer --tool "$tool" --error-exitcode 1 "$python" -m pytest -q -p no:cacheprovider -m gpu \
      tests/rendering tests/mapping tests/tracking \
      -k "channels or crowded or every_size or every_age or terms or neighbours or insertion or identity or tracking" ||
      return 1
  done
}

# run_slam PART ARGUMENT...: one part of the benchmark of whole runs.
run_slam() {
  local part=$1 lacks
  shift
  # shellcheck disable=SC2086
  lacks=$(missing $whole_runs)
  if [ -n "$lacks" ]; then
    echo "left out: whole runs need these Python packages, which are missing: $lacks"
    return 1
  fi
  if [ -n "$(missing gtsam)" ]; then
    echo "gtsam is missing: without closing loops"
    set -- "$@" --set loops.enabled=false
  fi
  # shellcheck disable=SC2086
  "$python" scripts/benchmarks/bench_cuda_slam.py --parts "$part" --json "$folder/slam_$part.json" --out "$folder" $SLAM "$@"
}

slam() { run_slam speed; }
realtime() { run_slam realtime; }
profile() { run_slam profile; }
# shellcheck disable=SC2086
loops() { run_slam loops $LOOPS; }

bench() {
  # shellcheck disable=SC2086
  "$python" scripts/benchmarks/bench_cuda_render.py $BENCH
}

training() {
  # shellcheck disable=SC2086
  "$python" scripts/benchmarks/bench_cuda_training.py $TRAINING
}

volumes() {
  # shellcheck disable=SC2086
  "$python" scripts/benchmarks/bench_cuda_volumes.py $VOLUMES
}

frontends() {
  if [ -z "${GGSLAM_DATA:-}" ]; then
    echo "left out: no recordings"
    return 1
  fi
  # shellcheck disable=SC2086
  "$python" scripts/benchmarks/bench_frontends.py "$GGSLAM_DATA" --device cuda --no-lidar $FRONTENDS
}

export -f missing machine build compile tests sanitize run_slam slam realtime profile loops bench training volumes \
  frontends
[ -z "${SANITIZE:-}" ] || wanted="$wanted sanitize"
for name in machine build compile tests sanitize slam realtime profile loops bench training volumes frontends; do
  step "$name" "$name"
done
echo "seconds:$times"
if [ -n "$failed" ]; then
  echo "failed or left out:$failed"
  exit 1
fi
echo "all steps passed"
