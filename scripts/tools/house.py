# SPDX-License-Identifier: Apache-2.0
"""Prints how the house stands: modules by room, imports that run up, circles, and what the style rules forbid.

python scripts/tools/house.py           # all of it but the time of the tests
python scripts/tools/house.py --suite   # runs the README's tests, too, and says how long they took
python scripts/tools/house.py --names   # says which functions and calls it counted
"""

from __future__ import annotations

import argparse
import ast
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).parents[2]
PACKAGE = HERE / "ggslam"
sys.path[:0] = [str(HERE), str(HERE / "tests"), str(HERE / "scripts" / "tools")]

import growth  # noqa: E402
import one_door  # noqa: E402
import test_imports as plan  # noqa: E402

LONGEST = 60
IRREGULAR = re.compile(
    "kept|held|made|found|seen|told|known|given|taken|written|drawn|chosen|sent|lost|built|met|said|shown|grown|thrown|"
    "torn|worn|bound|brought|thought|bought|caught|sought|fed|led|won|begun|broken|spoken|stolen|frozen|forgotten|"
    "hidden|driven|risen|fallen|gone|done|born"
)
REGULAR = re.compile("[a-z]{2,}(ed|ing)")
NO_PARTICIPLES = re.compile(
    "need|feed|seed|speed|embed|exceed|proceed|string|ring|king|thing|spring|sing|wing|bring|swing|ping|timing|recording|setting"
)
PREPOSITIONS = re.compile(
    "by|to|of|in|on|at|from|with|for|into|as|out|up|down|off|over|onto|and|or|not|within|around|after|before|again|once|back|away|together|along|against|between|through|under|than|like|here|there|per"
)


def functions() -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    """Every function and method of the package, with its place."""
    for name, path in plan.modules().items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                yield f"{name}:{node.lineno} {node.name}", node


def is_bare_participle(name: str) -> bool:
    """Whether a function's name is a participle with nothing that it belongs to: `_named`, `kept_in`, `watching`."""
    if name.startswith("__"):  # Python's own, such as __missing__
        return False
    first, *rest = name.strip("_").split("_")
    participle = IRREGULAR.fullmatch(first) or (REGULAR.fullmatch(first) and not NO_PARTICIPLES.fullmatch(first))
    return bool(participle) and (not rest or bool(PREPOSITIONS.fullmatch(rest[0])))


def upward_imports() -> list[str]:
    """Imports that the plan of the house does not allow."""
    found = []
    for name in plan.modules():
        try:
            if name.count(".") and name != "ggslam.__main__":
                plan.test_imports_run_downwards(name)
        except AssertionError as error:
            found.append(str(error))
    return found


def circles() -> list[str]:
    """Circles of imports (the first one)."""
    try:
        plan.test_no_circles()
    except AssertionError as error:
        return [str(error)]
    return []


PURPOSES = {
    "SLAM": "sight slam tracking mapping loops movers objects rendering scene geometry features native cuda",
    "recordings, files and stores": "sequences formats coding runs submaps system abi errors __init__ __main__",
    "live messages": "messages middleware",
    "work on finished runs": "jobs localization merging changes driving volumes evaluation viewer reporting",
    "command line": "cli",
    "generated recordings": "synthetic",
}
"""What the rooms are for."""


def code_lines(text: str) -> int:
    """Lines of a module without blank ones, comments and docstrings."""
    documented: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            documented.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    lines = enumerate(text.splitlines(), 1)
    return sum(1 for number, line in lines if line.strip() and line.lstrip()[0] != "#" and number not in documented)


def lines_by_purpose() -> dict[str, int]:
    """Lines of code of the package; rooms without a purpose count as "else"."""
    purpose = {room: name for name, rooms in PURPOSES.items() for room in rooms.split()}
    found: Counter[str] = Counter()
    for name, path in plan.modules().items():
        room = name.split(".")[1] if name.count(".") else "__init__"
        found[purpose.get(room, "else")] += code_lines(path.read_text())
    return dict(found)


ONLY_FOR_USERS = {
    "ggslam.volumes.raycast", "ggslam.volumes.cuda.raycast", "ggslam.driving.dynamic_layer", "ggslam.driving.outlines",
}  # fmt: skip
"""Modules of the library that people call and ggslam itself does not: the surface of a TSDF as a camera sees it, on CPU
and GPU; what moves, for robots that drive while a map is made."""


def is_package(name: str) -> bool:
    """Whether a module is a package."""
    return name in plan.modules() and plan.modules()[name].name == "__init__.py"


def unused_modules() -> list[str]:
    """Modules that are reached neither from the command line nor from the public face: tests may need them, users do
    not."""
    seen: set[str] = set()
    pending = ["ggslam.__main__", "ggslam", *ONLY_FOR_USERS]
    while pending:
        name = pending.pop()
        if name not in seen:
            seen.add(name)
            pending += [other for other in plan.imports(name) if other in plan.modules()]
            pending += [name.rpartition(".")[0]] if "." in name else []  # a package is loaded before its modules
            content = plan.modules()[name].read_text()
            texts = [node.value for node in ast.walk(ast.parse(content)) if isinstance(node, ast.Constant)]
            pending += [text for text in texts if text in plan.modules()]  # started as a process of its own
            if "iter_modules(" in content:  # loads all modules of the packages that it imports
                packages = tuple(f"{other}." for other in plan.imports(name) if is_package(other))
                pending += [other for other in plan.modules() if other.startswith(packages)]
    return sorted(set(plan.modules()) - seen)


def length(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its docstring."""
    body = node.body
    documented = isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant)
    start = node.lineno if not documented else node.lineno + (body[0].end_lineno or 0) - body[0].lineno + 1
    return (node.end_lineno or node.lineno) - start + 1


def settings() -> tuple[list[str], list[str], list[str]]:
    """Paths of the public settings, of the internal ones, and of those whose number has no range or whose text is
    missing."""
    from ggslam.jobs.localize.settings import LocalizeSettings
    from ggslam.slam.config import Config
    from ggslam.system.settings import walk

    known = list({one.path: one for kind in (LocalizeSettings, Config) for one in walk(kind)}.values())
    public, internal = ([one.path for one in known if one.internal is internal] for internal in (False, True))
    return public, internal, [one.path for one in known if not one.text or (one.is_number and not one.range())]


def raw_json_reads() -> list[str]:
    """Places that read a run's JSON as bare dictionaries: `read_json` anywhere but in the records and beside its
    definition, and the library's own readers on the floors that look at runs."""
    above = {room for floor in plan.FLOORS[:4] for room in floor} | {"evaluation", "viewer", "reporting"}
    found = []
    for name, path in plan.modules().items():
        own = name in ("ggslam.runs.records.record", "ggslam.runs.map_index", "ggslam.system.json_files",
                       "ggslam.viewer.page_requests")  # what a page sends is no file of a run
        looks_at_runs = above.intersection(name.split(".")[1:2])
        words = r"\bread_json\(" + (r"|\bjson\.loads?\(" if looks_at_runs else "")
        lines = enumerate(path.read_text().splitlines(), 1)
        found += [f"{name}:{i}" for i, line in lines if not own and re.search(words, line)]
    return found


def strays() -> tuple[list[str], list[str]]:
    """Reads of files that do not go through `ggslam/system/untrusted_files.py`, and allowances that nothing needs."""
    return one_door.strays([read for n, p in plan.modules().items() for read in one_door.reads_in(n, p.read_text())])


def suite_minutes() -> float:
    """Wall time of the README's tests."""
    start = time.monotonic()
    subprocess.run(["bash", str(HERE / "scripts" / "run_tests.sh")], check=True)
    return (time.monotonic() - start) / 60


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", action="store_true", help="run the tests and say how long they take")
    parser.add_argument("--names", action="store_true", help="say what was counted")
    arguments = parser.parse_args()

    rooms = Counter(name.split(".")[1] for name in plan.modules() if name.count("."))
    for floor in plan.FLOORS:
        print("  ".join(f"{room} {rooms[room]}" for room in sorted(floor)))
    print()
    for purpose, lines in lines_by_purpose().items():
        print(f"{'lines for ' + purpose:40} {lines}")
    found = list(functions())
    public, internal, unbounded = settings()
    counted = {
        "imports that run up": upward_imports(),
        "circles": circles(),
        "modules that nothing uses": unused_modules(),
        "modules at the root": sorted(path.name for path in PACKAGE.glob("*.py")),
        f"functions over {LONGEST} lines": [place for place, node in found if length(node) > LONGEST],
        "settings, public": public,
        "settings, internal": internal,
        "settings without a range": unbounded,
        "functions named by a bare participle": [place for place, node in found if is_bare_participle(node.name)],
        "raw read_json outside records": raw_json_reads(),
        "files read past the door": strays()[0],
        "numbers named outside settings": list(growth.constants()),
        **{f"files that one more {kind} touches": files for kind, files in growth.files_touched().items()},
    }
    print()
    for what, names in counted.items():
        print(f"{what:40} {len(names)}")
        if arguments.names and names:
            print("\n".join(f"    {name}" for name in names))
    print(f"{'words in the README':40} {len((HERE / 'README.md').read_text().split())}")
    print(f"{'words in the docs':40} {growth.words_of_docs()}")
    print(f"{'longest subject of a commit':40} {len(growth.longest_subject())}")
    if arguments.suite:
        print(f"{'minutes of the tests':40} {suite_minutes():.1f}")


if __name__ == "__main__":
    main()
