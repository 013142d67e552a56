#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Runs ggslam as Linux on ARM does, emulated on another processor: the wheel for aarch64 is unpacked beside an ARM Python,
# and tests run that compare the core with references (NEON is its only instruction set there), decode the golden
# streams, and map the sample recording. Arguments are tests instead of the chosen ones.
#   FOLDER=...   where to work; kept, and what was fetched is used again (default: build/arm)
#   WHEEL=...    what to test (default: dist/ggslam-*aarch64.whl, built if it is missing)
#   TORCH=...    default: torch==2.8.0, whose ARM build on package indexes needs no CUDA libraries
# Needs Debian or Ubuntu with qemu-user and its own Python 3.11 for ARM to download (`apt-get download`), pip, 2 GB of disk.
# Emulation is about 20 times as slow as the processor below it: an hour.
set -eu
cd "$(dirname "$0")/.."
root=$PWD
work=${FOLDER:-$root/build/arm}
mkdir -p "$work"
python=${PYTHON:-python3}
wheel=${WHEEL:-$(ls dist/ggslam-*aarch64.whl 2>/dev/null || true)}
if [ -z "$wheel" ]; then
  bash scripts/build_wheels.sh aarch64
  wheel=$(ls dist/ggslam-*aarch64.whl)
fi

# --- an ARM system, without touching this one's packages --------------------------------------------------------------
if [ ! -x "$work/system/usr/bin/python3.11" ]; then
  mkdir -p "$work/lists/partial" "$work/cache/archives/partial" "$work/debs"
  apt=(apt-get -q -o APT::Architecture=arm64 -o APT::Architectures=arm64 -o APT::Sandbox::User=root
       -o Dir::State::lists="$work/lists" -o Dir::State::status=/dev/null -o Dir::Cache="$work/cache")
  "${apt[@]}" update >/dev/null
  (cd "$work/debs" && "${apt[@]}" download python3.11 python3.11-minimal libpython3.11-minimal libpython3.11-stdlib libc6 \
    libgcc-s1 libstdc++6 libgomp1 zlib1g libexpat1 libssl3 libffi8 libsqlite3-0 libbz2-1.0 liblzma5 libncursesw6 \
    libtinfo6 libreadline8 libuuid1 libdb5.3 libnsl2 libtirpc3 libcrypt1 >/dev/null)
  for deb in "$work"/debs/*.deb; do dpkg -x "$deb" "$work/system"; done
fi

# --- packages for it --------------------------------------------------------------------------------------------------
pip=("$python" -m pip install -q --disable-pip-version-check --root-user-action ignore --no-deps --target "$work/packages" --upgrade)
for glibc in 2_28 2_27 2_26 2_24 2_17; do pip+=(--platform "manylinux_${glibc}_aarch64"); done
pip+=(--platform manylinux2014_aarch64 --python-version 3.11 --only-binary=:all:)
if [ ! -d "$work/packages/torch" ]; then
  sed -n 's/^\([a-z0-9-]*==[^ ]*\) --hash.*/\1/p' requirements/demo.lock requirements/tests.lock |
    grep -E '^(annotated|attrs|click|execnet|filelock|fsspec|gtsam|hypothesis|iniconfig|jinja2|kornia|markdown-it|markupsafe|mdurl|mpmath|networkx|numpy|opencv|packaging|pluggy|pydantic|pygments|pytest|pyyaml|rich|scipy|setuptools|shellingham|sortedcontainers|sympy|typer|typing)' |
    sort -u >"$work/packages.txt"
  "${pip[@]}" -r "$work/packages.txt"
  "${pip[@]}" "${TORCH:-torch==2.8.0}"
fi
"${pip[@]}" "$wheel"

# --- run --------------------------------------------------------------------------------------------------------------
# Tests that start other programs are not among the chosen: those would not be emulated.
export PYTHONPATH=$work/packages OMP_WAIT_POLICY=PASSIVE
export GGSLAM_GPCC=${GGSLAM_GPCC:-$root/../shared/gpcc} GGSLAM_DATA=${GGSLAM_DATA:-$root/../shared/data}
arm() { qemu-aarch64 -L "$work/system" "$work/system/usr/bin/python3.11" "$@"; }
rm -rf "$work/away" && mkdir "$work/away" && cd "$work/away"
arm -c 'import platform; from ggslam.native.loader import load_library, available_instruction_sets
print(platform.machine(), available_instruction_sets(), load_library()._name)'
arm -m ggslam run "$root/assets/sample" --config fast-cpu --out run
if [ $# -eq 0 ]; then
  set -- coding/test_golden_streams.py coding/test_golden_more.py mapping/test_cross_entropy.py \
    mapping/test_insertion.py mapping/test_losses.py rendering/test_3dgs_rules.py rendering/test_cpu_gradients.py \
    rendering/test_cpu_rules.py rendering/test_fused_adam.py rendering/test_pixel_terms.py rendering/test_thin_splats.py \
    sight/test_coarse_views.py sight/test_view.py tracking/test_gicp.py tracking/test_target_parts.py \
    volumes/test_esdf.py volumes/test_occupancy.py volumes/test_scan_quantization.py volumes/test_tsdf_fusion.py
  set -- "${@/#/$root/tests/}" -k "not cuda"  # kernels of GPUs are compiled by this machine's compiler
fi
arm -m pytest -q -p no:cacheprovider --rootdir "$root" -c "$root/pyproject.toml" "$@"
echo "the wheel works on emulated ARM"
