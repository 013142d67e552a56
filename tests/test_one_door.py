# SPDX-License-Identifier: Apache-2.0
"""Files that came from elsewhere are read through `ggslam/system/untrusted_files.py` only."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts" / "tools"))
import house  # noqa: E402
import one_door  # noqa: E402


def test_all_files_come_in_by_the_door() -> None:
    strays, needless = house.strays()
    assert strays == []
    assert needless == []


@pytest.mark.parametrize(
    "source",
    [
        "open(path)", "open(path, 'rb')", "open(path, mode='r+b')", "path.open('rb')", "path.open()", "Path(p).open()",
        "path.read_bytes()", "Path(p).read_text(encoding='utf-8')", "cv2.imread(str(path))", "cv2.imdecode(data, 1)",
        "cv2.VideoCapture(str(path))", "np.load(path)", "numpy.fromfile(path)", "np.memmap(path)", "np.loadtxt(path)",
        "sqlite3.connect(path)", "zipfile.ZipFile(path)", "zipfile.ZipFile(path, 'r')", "tarfile.open(path)",
        "PIL.Image.open(path)", "torch.load(path)", "os.open(path, os.O_RDONLY)", "gzip.open(path)",
        "io.open(path)", "shutil.copyfile(path, b)", "shutil.copytree(path, b)", "from shutil import copy2",
        "from sqlite3 import connect", "from numpy import load", "from cv2 import imread",
        "def f():\n    def g():\n        return path.read_bytes()",
        "class A:\n    def f(self):\n        open(self.path)",
        "with elsewhere(path) as file:\n    np.load(file)",
        "def f():\n    with open_untrusted(p) as file:\n        pass\ndef g():\n    np.load(file)",
    ],
)  # fmt: skip
def test_a_planted_read_is_found(source: str) -> None:
    found = list(one_door.reads_in("ggslam.jobs.planted", source))
    assert len(found) == 1
    assert one_door.strays(found)[0] == [str(found[0])]
    assert found[0].line == next(i for i, line in enumerate(source.splitlines(), 1) if _is_read(line))


def _is_read(line: str) -> bool:
    return not line.lstrip().startswith(("def ", "class ", "with ", "pass"))


@pytest.mark.parametrize(
    "source",
    [
        "open(path, 'wb')", "temporary.open('xb')", "with path.open('wb') as log: pass", "RunFolder.open(path)",
        "request.open()", "zipfile.ZipFile(path, 'w')", "np.frombuffer(data)", "data.decode()",
        "def f():\n    with open_untrusted(p) as file:\n        np.load(file)",
        "def f():\n    with open_zip(p) as archive, archive.open('a') as member:\n        member.read()",
        "def f(file: IO[bytes]):\n    zipfile.ZipFile(file)",
        "def f():\n    file = open_untrusted(p)\n    zipfile.ZipFile(file)",
    ],
)  # fmt: skip
def test_what_is_no_read_by_name_is_not(source: str) -> None:
    assert list(one_door.reads_in("ggslam.jobs.planted", source)) == []


def test_an_allowance_is_for_one_function() -> None:
    read = one_door.Read("ggslam.system.untrusted_files:elsewhere", 1, "os.open")
    assert one_door.strays([read])[0] == [str(read)]
