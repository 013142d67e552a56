# SPDX-License-Identifier: Apache-2.0
"""A small run with objects to look at."""

from __future__ import annotations

from pathlib import Path

import pytest

from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest


@pytest.fixture(scope="session")
def run(room: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run of the first frames of the generated room; not to be changed."""
    request = RunRequest(
        SequenceRequest(room, stop=6), out=tmp_path_factory.mktemp("viewed") / "room", evaluate=False,
        overrides=["mapping.iterations_per_frame=2"],
    )  # fmt: skip
    return execute(request).folder
