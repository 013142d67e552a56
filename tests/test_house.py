# SPDX-License-Identifier: Apache-2.0
"""What `scripts/tools/house.py` counts stays at nothing."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts" / "tools"))
import house  # noqa: E402


def test_functions_are_short_and_well_named() -> None:
    found = list(house.functions())
    assert [place for place, node in found if house.length(node) > house.LONGEST] == []
    assert [place for place, node in found if house.is_bare_participle(node.name)] == []


def test_records_are_read_by_records_and_settings_have_ranges() -> None:
    assert house.raw_json_reads() == []
    public, internal, without_range = house.settings()
    assert len(public) <= 90 and not set(public) & set(internal) and without_range == []


def test_every_module_serves_a_command_or_the_public_face(monkeypatch: pytest.MonkeyPatch) -> None:
    assert house.unused_modules() == []
    monkeypatch.setattr(house, "ONLY_FOR_USERS", set())
    assert "ggslam.volumes.raycast" in house.unused_modules()


def test_every_room_has_a_purpose() -> None:
    assert "else" not in house.lines_by_purpose()
    assert house.code_lines('"""Text."""\n\n# why\nx = 1  # so\ny = """a\nb"""\n') == 3


def test_it_knows_what_it_looks_for() -> None:
    assert all(house.is_bare_participle(name) for name in ("kept", "_named", "sorted_again", "found_in"))
    assert not any(house.is_bare_participle(name) for name in ("keep", "needs", "string", "built_map", "_timing"))


def test_one_more_of_a_kind_touches_few_files() -> None:
    touched = {kind: len(files) for kind, files in house.growth.files_touched().items()}
    assert touched == {"format": 2, "filter": 1, "tracker": 2, "command": 2, "dataset": 2}
