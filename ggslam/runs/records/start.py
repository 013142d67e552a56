# SPDX-License-Identifier: Apache-2.0
"""start.json beside the checkpoints of a run: what it was asked to do, so that it can be asked again."""

from __future__ import annotations

import hashlib
import json
from typing import Any, ClassVar, Final

from ggslam.runs.records.record import RecordFile
from ggslam.runs.records.sequence import OpenRecord
from ggslam.system.json_files import json_ready

VERSION: Final = 3
"""Version of the format of checkpoints."""


class StartRecord(RecordFile):
    """What a run was asked to do.

    Attributes:
        version: of the format.
        ggslam: version of the program; another one cannot go on.
        open: how the recording is opened.
        recording: what tells the recording from another one, see `recordings.identity_of`.
        config: all settings.
        config_hash: of these, so that a file that was changed by hand is noticed.
        evaluate: whether the run is to be scored.
        map: folder of the run whose map it began with.
        map_fingerprint: of that run.
        localize_only: whether that map stays as it is.
        loss: name of the user's own loss, see `jobs.run.named_loss`; None: none. It is never loaded from here.
        environment: versions and machine; others compute the last bits differently.
    """

    FILE: ClassVar[str] = "start.json"
    version: int
    ggslam: str
    open: OpenRecord
    recording: dict[str, Any]
    config: dict[str, Any]
    config_hash: str
    evaluate: bool = True
    map: str | None = None
    map_fingerprint: str | None = None
    localize_only: bool = False
    loss: str | None = None
    environment: dict[str, str | int | float | None] = {}


def hash_of(values: Any) -> str:
    """SHA-256 of plain values."""
    return hashlib.sha256(json.dumps(json_ready(values), sort_keys=True).encode()).hexdigest()
