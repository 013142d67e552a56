# SPDX-License-Identifier: Apache-2.0
"""Internal settings are used as they are given, and told of once a run; runs of earlier versions are read."""

from __future__ import annotations

from pathlib import Path

import yaml

from ggslam.jobs.progress import SilentObserver
from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest
from ggslam.slam.config import config_to_dict, load_config

FAST = ["mapping.iterations_per_frame=0", "mapping.first_frame_iterations=1", "refine_iterations=0"]


class Notes(SilentObserver):
    def __init__(self) -> None:
        self.texts: list[str] = []

    def note(self, text: str) -> None:
        self.texts.append(text)


def run(room: Path, out: Path, *overrides: str, config: Path | None = None) -> list[str]:
    """Notes of a short run that name an internal setting."""
    notes, sequence = Notes(), SequenceRequest(room, stop=3)
    given = None if config is None else str(config)
    execute(RunRequest(sequence, out, given, [*FAST, *overrides], evaluate=False, check=False), notes)
    return [text for text in notes.texts if "tracking.align." in text or "mapping.rates." in text]


def test_internal_settings_are_told_of_once_and_kept(room: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("mapping: {rates: {beta1: 0.8}}")
    told = run(room, tmp_path / "run", "tracking.align.min_matches=77", config=mine)
    assert len(told) == 1 and "tracking.align.min_matches" in told[0] and "mapping.rates.beta1" in told[0]
    kept = RunFolder.open(tmp_path / "run").config()
    assert kept.tracking.align.min_matches == 77 and kept.mapping.rates.beta1 == 0.8


def test_public_settings_need_no_note(room: Path, tmp_path: Path) -> None:
    assert run(room, tmp_path / "run", "tracking.points.count=3000") == []


def test_runs_with_all_settings_in_their_file_are_read(room: Path, tmp_path: Path) -> None:
    run(room, tmp_path / "run")
    config = load_config(None, [*FAST, "loops.graph.turn_length=2.5"])
    (tmp_path / "run" / "config.yaml").write_text(yaml.safe_dump(config_to_dict(config)))
    assert RunFolder.open(tmp_path / "run").config() == config
