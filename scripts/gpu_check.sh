#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Builds, tests and measures what runs on a GPU, in one call, from the checkout: needs an NVIDIA GPU, nvcc, cmake, Python
# with a CUDA build of torch, numpy and pytest; installs nothing and needs no network. Goes on after a step that fails and
# says at the end which did.
#   FOLDER=...     where the log of each step goes (default: build/gpu_check)
#   STEPS="..."    which steps to run (default: machine build compile tests bench training)
#   BENCH="..."    arguments of scripts/bench_cuda_render.py
#   TRAINING="..." arguments of scripts/bench_cuda_training.py
#   SANITIZE=1     runs a few tests under compute-sanitizer's memcheck and racecheck, too (minutes)
set -u
cd "$(dirname "$0")/.."
export PYTHONPATH=$PWD:$PWD/scripts PYTHONUNBUFFERED=1 OMP_WAIT_POLICY=PASSIVE
python=${PYTHON:-python3}
folder=${FOLDER:-build/gpu_check}
export GGSLAM_CACHE=${GGSLAM_CACHE:-$PWD/build/cuda_cache}
mkdir -p "$folder"
failed=""

# step NAME COMMAND...: runs a command if the step is wanted, shows its output and keeps it.
step() {
  local name=$1
  shift
  case " ${STEPS:-machine build compile tests bench training} " in *" $name "*) ;; *) return ;; esac
  echo "=== $name"
  local start=$SECONDS
  "$@" 2>&1 | tee "$folder/$name.log"
  local status=${PIPESTATUS[0]}
  echo "=== $name: status $status, $((SECONDS - start)) s"
  [ "$status" -eq 0 ] || failed="$failed $name"
}

machine() {
  nvidia-smi --query-gpu=name,driver_version,memory.total,compute_cap --format=csv
  nvcc --version | tail -2
  "$python" -c 'import sys, torch; print(sys.version.split()[0], torch.__version__, torch.cuda.is_available())'
  "$python" -c 'import torch; assert torch.cuda.is_available(), "torch finds no GPU"'
}

build() {
  JOBS=${JOBS:-$(nproc)} bash scripts/build_native.sh &&
    test -f ggslam/native/_lib/libggslam_core.so
}

# Compiles the rasterizer for this GPU as a user's first call does, then once more to list registers and spills.
compile() {
  "$python" - <<'CODE' || return 1
import time
import torch
from ggslam.cuda.compiler import compiled_library
architecture = "".join(map(str, torch.cuda.get_device_capability()))
start = time.perf_counter()
print(compiled_library(architecture), f"{time.perf_counter() - start:.1f} s")
CODE
  local arch
  arch=$("$python" -c 'import torch; print("".join(map(str, torch.cuda.get_device_capability())))')
  local source
  for source in rendering/api mapping/image_loss; do
    nvcc -O3 -std=c++17 -ftz=true -Xptxas -v -gencode "arch=compute_$arch,code=sm_$arch" -c -o /dev/null \
      -I ggslam/cuda/kernels "ggslam/cuda/kernels/$source.cu" 2>&1 | grep -E "Compiling|spill|Used" | { c++filt 2>/dev/null || cat; }
  done
}

tests() {
  "$python" -m pytest -q -p no:cacheprovider tests/rendering -rs
}

sanitize() {
  local tool
  for tool in memcheck racecheck; do
    compute-sanitizer --tool "$tool" --error-exitcode 1 "$python" -m pytest -q -p no:cacheprovider -m gpu \
      tests/rendering/test_cuda_device.py tests/rendering/test_cuda_training.py \
      -k "channels or crowded or every_size or every_age" || return 1
  done
}

bench() {
  # shellcheck disable=SC2086
  "$python" scripts/bench_cuda_render.py ${BENCH:-}
}

training() {
  # shellcheck disable=SC2086
  "$python" scripts/bench_cuda_training.py ${TRAINING:-}
}

step machine machine
step build build
step compile compile
step tests tests
[ -z "${SANITIZE:-}" ] || STEPS="sanitize" step sanitize sanitize
step bench bench
step training training
if [ -n "$failed" ]; then
  echo "failed:$failed"
  exit 1
fi
echo "all steps passed"
