# SPDX-License-Identifier: Apache-2.0
"""Says what would keep a wheel from running elsewhere: its tag, its metadata, what its core asks of the system.

    python scripts/tools/check_wheel_file.py dist/*.whl

A wheel for manylinux_2_28 may need symbols up to glibc 2.28, and no library but those that every Linux has. Reads the
core with readelf (binutils), of whatever processor it is.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import zipfile
from email import message_from_bytes
from pathlib import Path

CORE = "ggslam/native/_lib/libggslam_core.so"
NAME = re.compile(
    r"ggslam-(?P<version>[^-]+)-(?P<tag>py3-none-manylinux_2_(?P<glibc>\d+)_(?P<machine>x86_64|aarch64))\.whl"
)
MACHINES = {"x86_64": "X86-64", "aarch64": "AArch64"}
LIBRARIES = re.compile(r"lib(c|m|pthread)\.so\.6|libpthread\.so\.0|libgcc_s\.so\.1|ld-linux-(x86-64|aarch64)\.so\.\d")
NEWEST = {"GCC": (4, 8)}
"""Of libgcc_s, where glibc 2.28 is."""


def read_elf(core: Path, *what: str) -> str:
    """What readelf says of a library."""
    command = ["readelf", "--wide", *what, str(core)]
    return subprocess.run(command, capture_output=True, text=True, check=True, env={**os.environ, "LC_ALL": "C"}).stdout


def library_problems(listing: str, machine: str, glibc: int) -> list[str]:
    """What a library needs that a system with glibc 2.`glibc` lacks, and what it exports besides ggslam's functions.

    Args:
        listing: of `readelf --wide --file-header --dynamic --version-info --dyn-syms`.
    """
    problems = []
    if not re.search(rf"Machine:.*{MACHINES[machine]}", listing):
        problems.append(f"the core is not for {machine}")
    for library in re.findall(r"\(NEEDED\).*\[(.*)\]", listing):
        if not LIBRARIES.fullmatch(library):
            problems.append(f"the core needs {library}")
    newest = {**NEWEST, "GLIBC": (2, glibc)}
    for version in sorted(set(re.findall(r"Name: (\w+_[\d.]+)  Flags", listing))):
        family, numbers = version.rsplit("_", 1)
        if family not in newest or tuple(map(int, numbers.split("."))) > newest[family]:
            symbols = re.findall(rf"UND (\S+)@{re.escape(version)}\b(?!\.)", listing)
            problems.append(f"the core needs {version}: {', '.join(sorted(set(symbols)))}")
    exported = re.findall(r"(?:GLOBAL|WEAK|UNIQUE)\s+DEFAULT\s+\d+ (\S+)", listing)
    strangers = [name for name in exported if not name.startswith("ggslam_")]
    if strangers or not exported:
        problems.append(f"the core exports {len(exported)} symbols, not ggslam's: {', '.join(strangers[:5]) or 'none'}")
    return problems


def metadata_problems(wheel: zipfile.ZipFile, version: str, tag: str) -> list[str]:
    """What the files of metadata say otherwise than the wheel's name."""
    folder = f"ggslam-{version}.dist-info"
    about = message_from_bytes(wheel.read(f"{folder}/METADATA"))
    built = message_from_bytes(wheel.read(f"{folder}/WHEEL"))
    said = {
        "Name": (about["Name"], "ggslam"), "Version": (about["Version"], version),
        "Requires-Python": (about["Requires-Python"], ">=3.10"),
        "License-Expression": (about["License-Expression"], "Apache-2.0"),
        "Root-Is-Purelib": (built["Root-Is-Purelib"], "false"), "Tag": (",".join(built.get_all("Tag", [])), tag),
    }  # fmt: skip
    return [f"{name} is {found}, not {wanted}" for name, (found, wanted) in said.items() if found != wanted]


def problems_of(path: Path) -> list[str]:
    """What would keep a wheel from running where its name says it does."""
    name = NAME.fullmatch(path.name)
    if name is None:
        return ["the name is not ggslam-VERSION-py3-none-manylinux_2_GLIBC_MACHINE.whl"]
    with zipfile.ZipFile(path) as wheel, tempfile.TemporaryDirectory() as folder:
        if wheel.testzip() is not None or CORE not in wheel.namelist():
            return [f"{CORE} is missing, or a file is damaged"]
        core = Path(wheel.extract(CORE, folder))
        listing = read_elf(core, "--file-header", "--dynamic", "--version-info", "--dyn-syms")
        problems = metadata_problems(wheel, name["version"], name["tag"])
    return problems + library_problems(listing, name["machine"], int(name["glibc"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wheels", nargs="+", type=Path)
    failed = False
    for path in parser.parse_args().wheels:
        problems = problems_of(path)
        failed |= bool(problems)
        print(f"{path.name}: {'; '.join(problems) or 'runs where its name says'} ({path.stat().st_size / 1e6:.1f} MB)")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
