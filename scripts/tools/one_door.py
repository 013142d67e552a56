# SPDX-License-Identifier: Apache-2.0
"""Finds reads of files that do not go through the door, `ggslam/system/untrusted_files.py`; a part of house.py.

A file that a user or a stranger gave may be a pipe, a device, a folder, or larger than memory. `open_untrusted`,
`read_untrusted` and what is built on them (`open_zip`, `read_picture`, `copy_untrusted`) check for that; a plain `open`
does not. A call that reads from a file which the door opened is fine, and so is writing.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass

DOORS = {"open_untrusted", "open_zip"}
"""Functions that give an open file."""
OPENED = {"IO", "BinaryIO", "TextIO", "ZipFile"}
"""Types of parameters that are open files."""
READERS = {
    "cv2": {"imread", "imreadmulti", "imdecode", "imdecodemulti", "VideoCapture", "FileStorage"},
    "np": {"load", "fromfile", "memmap", "loadtxt", "genfromtxt", "fromregex"},
    "sqlite3": {"connect"}, "zipfile": {"ZipFile"}, "tarfile": {"open", "TarFile"}, "torch": {"load"},
    "pickle": {"load"}, "mmap": {"mmap"}, "gzip": {"open", "GzipFile"}, "bz2": {"open", "BZ2File"},
    "lzma": {"open", "LZMAFile"}, "io": {"open", "FileIO", "open_code"}, "codecs": {"open"}, "Image": {"open"},
    "shelve": {"open"}, "h5py": {"File"}, "onnxruntime": {"InferenceSession"}, "rosbags.highlevel": {"AnyReader"},
    "Stage": {"Open"}, "os": {"open"}, "shutil": {"copy", "copy2", "copyfile", "copytree"},
}  # fmt: skip
"""What opens or decodes files, by the last name before the dot."""
_MODULES = {"numpy": "np", "PIL.Image": "Image"}
_MODE = re.compile(r"[rwaxbtU+]{1,4}")
_FILES = re.compile(r"path|file|log|source|^Path$", re.IGNORECASE)

ALLOWED = {
    "ggslam.system.untrusted_files:open_untrusted": "the door",
    "ggslam.system.images:decode_image": "the door of pictures: their headers were read",
    "ggslam.sequences.video:_open": "OpenCV takes names only; the door looks first",
    "ggslam.sequences.formats.ros_messages:<import>": "rosbags takes names only; the door looks first",
    "ggslam.objects.onnx_sessions:_open_session": "onnxruntime takes names only; the door looks first",
    "ggslam.formats.gaussian_usd_reading:read_gaussian_usd": "usd-core takes names only; the door looks first",
    "ggslam.slam.color_poses:_decode": "JPEGs that this process made, in memory",
    "ggslam.mapping.between_frames:decode": "JPEGs that this process made, in memory",
    "ggslam.system.process_memory:peak_memory_bytes": "/proc",
    "ggslam.system.process_memory:most_memory_bytes": "/sys",
    "ggslam.jobs.doctor.checkup:_memory_gb": "/proc and /sys",
    "ggslam.runs.environment:processor": "/proc",
    "ggslam.system.energy:_number": "/sys",
    "ggslam.system.energy:_text": "/sys",
    "ggslam.reporting.page:_file": "a file of this package",
    "ggslam.viewer.page_text:_page": "files of this package",
    "ggslam.cuda.compiler:library_path": "sources of this package",
    "ggslam.native.loader:source_hash": "sources of this package",
    "ggslam.abi.headers:__init__": "headers of this package",
    "ggslam.system.interrupts:*": "/dev/null",
    "ggslam.submaps.index:create": "a new index",
    "ggslam.submaps.index:copy": "a new index",
    "ggslam.submaps.index:_connect": "SQLite takes names only; the door looks first",
    "ggslam.submaps.index_schema:_objects_to_expect": "in memory",
    "ggslam.submaps.cell_files:wait_for_disk": "a file that was just written, so that the system writes it to the disk",
    "ggslam.submaps.cell_files:__init__": "a lock: never read but for a number, opened without waiting",
    "ggslam.system.array_file:finish": "a file that was just written, so that the system writes it to the disk",
    "ggslam.system.forks:_was_forked": "/proc",
    "ggslam.system.forks:_pauses": "/proc",
    "ggslam.system.atomic:sync_folder": "a folder, so that the system writes its names to the disk",
    "ggslam.system.atomic:_sync": "a file that was just written, so that the system writes it to the disk",
    "ggslam.runs.publishing:sync_all": "files that were just written, so that the system writes them to the disk",
    "ggslam.system.folder_lock:writer_of": "a lock: never read but for a number, opened without waiting",
    "ggslam.system.folder_lock:_lock": "a lock, likewise",
}
"""Reads that may be elsewhere: module:function, and why."""


@dataclass(frozen=True)
class Read:
    """A call that opens or decodes a file.

    Attributes:
        place: module:function.
        line: its number.
        what: the call.
    """

    place: str
    line: int
    what: str

    def __str__(self) -> str:
        return f"{self.place.partition(':')[0]}:{self.line} {self.what} (in {self.place.partition(':')[2]})"


def reads_in(module: str, source: str) -> Iterator[Read]:
    """All reads of a module but those from files that a door opened."""
    tree = ast.parse(source)
    yield from _imported(module, tree)
    yield from _of_scope(module, "<module>", tree, set())


def strays(found: list[Read]) -> tuple[list[str], list[str]]:
    """Reads that are not allowed, and allowances that nothing needs."""
    used = {key for read in found for key in (read.place, f"{read.place.partition(':')[0]}:*") if key in ALLOWED}
    return [str(read) for read in found if not used & {read.place, f"{read.place.partition(':')[0]}:*"}], [
        place for place in ALLOWED if place not in used
    ]


def _imported(module: str, tree: ast.Module) -> Iterator[Read]:
    """Readers that are imported by name, which calls do not tell."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            names = READERS.get(_MODULES.get(node.module, node.module), set())
            for alias in node.names:
                if alias.name in names:
                    yield Read(f"{module}:<import>", node.lineno, f"from {node.module} import {alias.name}")


def _of_scope(module: str, name: str, scope: ast.AST, opened: set[str]) -> Iterator[Read]:
    """Reads of a function; those inside it know the files that it opened."""
    inner: list[tuple[str, ast.AST]] = []
    own: list[ast.AST] = []
    waiting = list(ast.iter_child_nodes(scope))
    while waiting:
        node = waiting.pop(0)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            inner.append((node.name, node))
            continue
        own.append(node)
        waiting += ast.iter_child_nodes(node)
    known = opened | _names_of_open_files(scope, own)
    for node in own:
        if isinstance(node, ast.Call) and (what := _what_reads(node, known)):
            yield Read(f"{module}:{name}", node.lineno, what)
    for inner_name, node in inner:
        yield from _of_scope(module, inner_name if name == "<module>" else name, node, known)


def _names_of_open_files(scope: ast.AST, nodes: list[ast.AST]) -> set[str]:
    found = set[str]()
    if isinstance(scope, (ast.FunctionDef, ast.AsyncFunctionDef)):
        for argument in (*scope.args.posonlyargs, *scope.args.args, *scope.args.kwonlyargs):
            if argument.annotation is not None and OPENED & set(re.findall(r"\w+", ast.unparse(argument.annotation))):
                found.add(argument.arg)
    for node in nodes:
        if isinstance(node, ast.withitem) and isinstance(node.optional_vars, ast.Name) and _is_door(node.context_expr):
            found.add(node.optional_vars.id)
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and _is_door(node.value):
            found.add(node.targets[0].id)
    return found


def _is_door(node: ast.expr) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in DOORS


def _what_reads(call: ast.Call, opened: set[str]) -> str:
    """The call in words if it opens or decodes a file that no door opened; else nothing."""
    first = call.args[0] if call.args else None
    if isinstance(call.func, ast.Name):
        return _unless_written(call, 1, "open") if call.func.id == "open" else ""
    if not isinstance(call.func, ast.Attribute):
        return ""
    name, owner = call.func.attr, _last_name(call.func.value)
    if name in READERS.get(_MODULES.get(owner, owner), set()):
        fine = isinstance(first, ast.Name) and first.id in opened
        if fine or (owner == "zipfile" and _mode(call, 1) not in ("", "r")):
            return ""
        return f"{owner}.{name}"
    if name in ("read_bytes", "read_text"):
        return f".{name}"
    if name == "open" and owner not in opened:
        mode = _mode(call, 0)
        if _MODE.fullmatch(mode):
            return _unless_written(call, 0, ".open")
        return ".open" if not call.args and not call.keywords and _FILES.search(owner) else ""
    return ""


def _mode(call: ast.Call, place: int) -> str:
    """A call's mode if it is written out; else nothing."""
    given = [word.value for word in call.keywords if word.arg == "mode"]
    node = given[0] if given else call.args[place] if len(call.args) > place else None
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


def _unless_written(call: ast.Call, place: int, what: str) -> str:
    mode = _mode(call, place) or "r"
    return f"{what}({mode!r})" if set(mode) & {"r", "+"} else ""


def _last_name(node: ast.expr) -> str:
    """a.b.c -> c; Path(...) -> Path."""
    if isinstance(node, ast.Call):
        return _last_name(node.func)
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""
