# SPDX-License-Identifier: Apache-2.0
"""What the documentation says is so: examples run, commands exist, the settings are those of the code, pages build."""

from __future__ import annotations

import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from ggslam.cli.main import app

sys.path.insert(0, str(Path(__file__).parent))
from test_imports import FLOORS, JOBS  # noqa: E402

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
README = ROOT / "README.md"
PAGES = sorted(DOCS.glob("*.md"))
ALL = [README, ROOT / "CONTRIBUTING.md", ROOT / "examples" / "README.md", *PAGES]
MOST_WORDS = 2000
OWN_TESTS = ("python.md", "pytorch.md")
"""Pages whose programs are run by tests of their own."""
pytestmark = pytest.mark.skipif(not DOCS.is_dir(), reason="not in a checkout")


def check_page(script: str) -> None:
    """Runs a script of ours with `--check`, in this process: another one would load everything again."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [script, "--check"])
        runpy.run_path(str(ROOT / "scripts" / "tools" / script), run_name="__main__")


@pytest.mark.long("every example of a page, in order")
@pytest.mark.parametrize(("page", "least"), [("python.md", 12), ("pytorch.md", 7)])
def test_examples_run_in_order(tmp_path: Path, page: str, least: int) -> None:
    text = (DOCS / page).read_text()
    blocks = list(re.finditer(r"```python\n(.*?)```", text, re.S))
    assert len(blocks) >= least
    environment: dict[str, object] = {}
    before = Path.cwd()
    os.chdir(tmp_path)
    try:
        for block in blocks:
            line = text[: block.start(1)].count("\n")
            exec(compile("\n" * line + block[1], str(DOCS / page), "exec"), environment)
    finally:
        os.chdir(before)


def test_the_papers_figures_are_those_of_the_code() -> None:
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as ended:
        patch.setattr(sys, "argv", ["replica.py", "--check"])
        runpy.run_path(str(ROOT / "scripts" / "papers" / "replica.py"), run_name="__main__")
    assert not ended.value.code


def test_the_settings_page_is_up_to_date() -> None:
    check_page("make_settings_reference.py")


def test_every_setting_says_what_it_means() -> None:
    rows = [line for line in (DOCS / "settings.md").read_text().splitlines() if line.startswith("| `")]
    assert 60 < len(rows) <= 90
    assert len((DOCS / "settings.md").read_text().split()) < 4000
    assert not [row for row in rows if row.endswith("|  |")]


def test_the_commands_page_is_up_to_date() -> None:
    check_page("make_command_reference.py")


def test_the_readme_is_short() -> None:
    assert len(README.read_text().split()) <= MOST_WORDS


@pytest.mark.parametrize("page", ALL, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_and_options_exist(page: Path) -> None:
    group = typer.main.get_command(app)
    known = {name: {o for p in command.params for o in p.opts + p.secondary_opts}
             for name, command in group.commands.items()}  # type: ignore[attr-defined]  # fmt: skip
    text = page.read_text()
    blocks = "\n".join(re.findall(r"```bash\n(.*?)```", text, re.S)).replace("\\\n", " ")
    inline = [" ".join(words.split()) for words in re.findall(r"`ggslam ([^`]*)`", text)]
    for line in [*re.findall(r"(?:^|bin/)ggslam ([^\n#&]*)", blocks, re.M), *inline]:
        name, *words = line.split()
        if name.startswith("--"):
            continue
        assert name in known, line
        options = {word for word in words if word.startswith("--")}
        assert options <= known[name] | {"--help"}, line


@pytest.mark.parametrize("page", ALL, ids=lambda page: str(page.relative_to(ROOT)))
def test_scripts_and_files_that_are_named_exist(page: Path) -> None:
    text = page.read_text()
    for name in re.findall(r"`((?:ggslam|scripts|examples|tests|configs)/[\w/.-]+)`", text):
        assert (ROOT / name).exists() or (ROOT / f"{name}.py").exists(), name
    for command in re.findall(r"python (scripts/[\w/]+\.py[^`]*)", text):
        path, *words = command.split()
        source = (ROOT / path).read_text()
        assert [w for w in words if w.startswith("--") and f'"{w.strip("[],")}"' not in source] == [], command


@pytest.mark.parametrize("page", ALL, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        name, _, part = target.partition("#")
        other = page.parent / name if name else page
        assert other.exists(), target
        if part:
            titles = re.findall(r"^#+ (.*)$", other.read_text(), re.M)
            anchors = {re.sub(r"[^\w\- ]", "", t.lower()).strip().replace(" ", "-") for t in titles}
            assert part in anchors, target


def test_pictures_are_used_and_small() -> None:
    text = "".join(page.read_text() for page in ALL)
    for path in [*(DOCS / "pictures").iterdir(), *(ROOT / "assets").iterdir()]:
        assert path.name in text and path.stat().st_size < 3e6, path


@pytest.mark.long("runs the programs of the README and the pages as they stand")
def test_short_programs_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the README and of the pages that have no test of their own; they share what a reader would have."""
    import numpy as np

    from ggslam.scene.camera import Camera
    from ggslam.synthetic import write_synthetic_sequence

    monkeypatch.chdir(tmp_path)
    write_synthetic_sequence("demo/room", frames=4, width=96, height=72)
    camera = Camera(width=96, height=72, fx=80.0, fy=80.0, cx=47.5, cy=35.5)
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3)) + [0, 0, 2]
    ran = 0
    for page in ALL:
        for code in re.findall(r"```python\n(.*?)```", page.read_text(), re.S):
            if page.name in OWN_TESTS or "device=cuda" in code:
                continue
            given = {"camera": camera, "points": points, "rgb": np.full((500, 3), 90, np.uint8),
                     "depth": np.full((72, 96), 2, np.float32), "color": np.full((72, 96, 3), 90, np.uint8),
                     "T_world_camera": np.eye(4)}  # fmt: skip
            exec(compile(code, str(page), "exec"), given)
            ran += 1
    assert ran >= 3


@pytest.mark.parametrize("page", [DOCS / "house.md", ROOT / "CONTRIBUTING.md"], ids=lambda page: page.name)
def test_the_plan_of_the_rooms_is_the_one_that_is_tested(page: Path) -> None:
    found = re.search(r"^ *(cli >.*?errors)$", page.read_text(), re.S | re.M)
    assert found is not None
    assert [{name.strip() for name in floor.split(",")} for floor in found[1].split(">")] == list(FLOORS)


def test_every_room_is_in_the_picture_and_in_the_table() -> None:
    picture, table = (DOCS / "house.svg").read_text(), (DOCS / "house.md").read_text()
    for room in set().union(*FLOORS):
        assert f">{room}</text>" in picture and f"`{room}`" in table, room
    order = re.findall(r"^watch >.*$", table, re.M)
    assert [{name.strip() for name in floor.split(",")} for floor in order[0].split(">")] == list(JOBS)


def test_every_extra_is_in_the_list() -> None:
    extras = set(re.findall(r"^(\w+) = \[", (ROOT / "pyproject.toml").read_text().split("optional-dependencies]")[1]
                            .split("[project.scripts]")[0], re.M))  # fmt: skip
    listed = set(re.findall(r"^\| `\[(\w+)\]`", (DOCS / "getting-started.md").read_text(), re.M))
    for_us = {"test", "dev", "bench", "formats", "browser", "conformance"}  # for tests and benchmarks
    assert listed == extras - for_us


@pytest.mark.long("all pages are built")
def test_pages_build_and_fetch_nothing(tmp_path: Path) -> None:
    pytest.importorskip("zensical", reason="zensical is not installed (extra [docs])")
    shutil.copytree(DOCS, tmp_path / "docs")
    shutil.copy(ROOT / "mkdocs.yml", tmp_path)
    command = [sys.executable, "-m", "zensical", "build", "--strict"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) >= len(PAGES)
    for page in pages:
        tags = re.findall(r"<(?:script|link|img|iframe)\b[^>]*>", page.read_text())
        assert not [tag for tag in tags if re.search(r"(?:src|href)=[\"']?(?:https?:)?//", tag)], page
