#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Builds sdist and wheel (the wheel from the sdist), looks into both, installs the wheel into empty environments and
# runs there, with no compiler on the path: doctor, the generated room, a short run, exports. Needs no checkout on the
# path. Leaves dist/.
#   FOLDER=...   where to work (default: a temporary folder that is removed)
#   TORCH=...    what to install first (default: torch==2.13.0), so that nothing else chooses another build of it
#   PYTHONS=...  Pythons to install the wheel for, one after another (default: python3)
#   DEMO=1       runs the README's first commands, too: minutes for each Python
#   BUILT=1      takes what is in FOLDER/dist
set -eu
cd "$(dirname "$0")/.."
root=$PWD
unset PYTHONPATH
work=${FOLDER:-$(mktemp -d)}
mkdir -p "$work"
[ -n "${FOLDER:-}" ] || trap 'rm -rf "$work"' EXIT
python=${PYTHON:-python3}
[ -n "${BUILT:-}" ] || FOLDER=$work bash scripts/build_wheels.sh
wheel=$(echo "$work"/dist/*"$(uname -m)".whl)

"$python" - "$wheel" "$work"/dist/*.tar.gz <<'CHECK'
import sys, tarfile, zipfile
from pathlib import Path

wheel, sdist = sys.argv[1:]
packed = set(zipfile.ZipFile(wheel).namelist())
source = {"/".join(name.split("/")[1:]) for name in tarfile.open(sdist).getnames()}
presets = [path.name for path in Path("configs").glob("*.yaml")]
data = [p for p in Path("ggslam").rglob("*") if p.suffix in (".js", ".css", ".html", ".typed", ".cu", ".cuh")]
data += Path("ggslam/abi").rglob("*.hpp")
data += Path("ggslam/native/formulas").glob("*.hpp")
needed = {"ggslam/native/_lib/libggslam_core.so", *(f"ggslam/configs/{name}" for name in presets), *map(str, data)}
assert any("viewer/static" in name for name in needed) and "ggslam/py.typed" in needed and len(presets) > 5
junk = [n for n in packed if n.startswith(("tests/", "scripts/", "docs/", "examples/")) or "/native/src/" in n or "/portable/" in n or n.endswith(".pyc")]
assert needed <= packed, f"{wheel} lacks {needed - packed}"
assert not junk, f"{wheel} holds {junk[:5]}"
assert any(n.endswith("licenses/LICENSE") for n in packed), f"{wheel} lacks the licence"
needed = {"LICENSE", "README.md", "CHANGELOG.md", "CITATION.cff", "CMakeLists.txt", "pyproject.toml", "ggslam/py.typed",
          "configs/default.yaml", "tests/conftest.py", "ggslam/native/src/common/dispatch.hpp", "examples/run_slam.py",
          "docs/index.md", "ggslam/cuda/kernels/rendering/api.cu", "ggslam/cuda/kernels/rendering/tile.cuh",
          "ggslam/abi/cuda/rendering.hpp"}
ends = (".so", ".pyc", ".whl", ".o")
junk = [n for n in source if n.endswith(ends) or n.split("/")[0] in (".git", "build", "dist", "runs", "demo", ".ci")]
assert needed <= source, f"{sdist} lacks {needed - source}"
assert not junk, f"{sdist} holds {junk[:5]}"
for name, count in ((wheel, len(packed)), (sdist, len(source))):
    print(f"{Path(name).name}: {count} files, {Path(name).stat().st_size / 1e6:.1f} MB")
CHECK

use_in_empty_environment() {  # $1: a Python
  local name="empty-$("$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])')"
  "$1" -m venv "$work/$name"
  local bin="$work/$name/bin"
  install() { PATH="$bin" "$bin/python" -m pip install -q --disable-pip-version-check --only-binary=:all: "$@"; }
  ggslam() { PATH="$bin" "$bin/ggslam" "$@"; }
  install "${TORCH:-torch==2.13.0}"
  install "$wheel"
  rm -rf "$work/away" && mkdir "$work/away" && cd "$work/away"
  ggslam doctor
  ggslam synth room --frames 12 --width 160 --height 120
  ggslam run room --config fast-cpu --out run
  for format in ply splat pcd; do ggslam export run --format "$format" --out "map.$format"; done
  ggslam export run --format colmap --voxel 0.03 --out colmap
  ggslam export run --format mesh --voxel 0.05 --out mesh.ply
  ggslam view run --html room.html
  PATH="$bin" "$bin/python" "$root/examples/export_everything.py" run exports
  ggslam volumes run --voxel 0.05
  if [ -n "${DEMO:-}" ]; then ggslam synth demo/room && ggslam run demo/room --out demo/run; fi
  cd "$root"
  echo "the wheel works in $name"
}
for each in ${PYTHONS:-$python}; do use_in_empty_environment "$each"; done
