# SPDX-License-Identifier: Apache-2.0
"""What the documentation says is so: examples run, commands exist, the settings are those of the code, pages build."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from ggslam.cli.main import app

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("*.md"))
pytestmark = pytest.mark.skipif(not DOCS.is_dir(), reason="not in a checkout")


def run_python(*arguments: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], cwd=cwd, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(("page", "least"), [("python.md", 12), ("pytorch.md", 6)])
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


def test_the_settings_page_is_up_to_date() -> None:
    result = run_python("scripts/make_settings_reference.py", "--check")
    assert result.returncode == 0, result.stderr


def test_every_setting_says_what_it_means() -> None:
    rows = [line for line in (DOCS / "settings.md").read_text().splitlines() if line.startswith("| `")]
    assert len(rows) > 150
    assert not [row for row in rows if row.endswith("|  |")]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_and_options_exist(page: Path) -> None:
    group = typer.main.get_command(app)
    known = {name: {o for p in command.params for o in p.opts + p.secondary_opts}
             for name, command in group.commands.items()}  # type: ignore[attr-defined]  # fmt: skip
    blocks = re.findall(r"```bash\n(.*?)```", page.read_text(), re.S)
    inline = re.findall(r"`ggslam ([^`]*)`", page.read_text())
    for line in [*re.findall(r"(?:^|bin/)ggslam ([^\n#]*)", "\n".join(blocks), re.M), *inline]:
        name, *words = line.split()
        assert name in known, line
        options = {word for word in words if word.startswith("--")}
        assert options <= known[name] | {"--help"}, line


def test_pages_build_and_fetch_nothing(tmp_path: Path) -> None:
    pytest.importorskip("material", reason="mkdocs-material is not installed (extra [docs])")
    result = run_python("-m", "mkdocs", "build", "--strict", "-q", "-d", str(tmp_path / "site"))
    assert result.returncode == 0, result.stdout + result.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) >= len(PAGES)
    for page in pages:
        tags = re.findall(r"<(?:script|link|img|iframe)\b[^>]*>", page.read_text())
        assert not [tag for tag in tags if re.search(r"(?:src|href)=[\"']?(?:https?:)?//", tag)], page
