# SPDX-License-Identifier: Apache-2.0
"""Resumes an interrupted run: finds its checkpoint and checks that recording and settings are unchanged."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from ggslam import __version__
from ggslam.errors import ConfigError, RunFolderError
from ggslam.jobs.progress import Observer
from ggslam.jobs.run.checkpointing import Checkpointing
from ggslam.runs.checkpoints import Checkpoints
from ggslam.runs.environment import environment
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest, fingerprint, identity_of, request_in
from ggslam.runs.records.start import VERSION, StartRecord, hash_of
from ggslam.sequences import Sequence
from ggslam.slam.config import Config, config_from_dict
from ggslam.slam.slam import Slam

_SAME_BITS = ("instruction_set", "torch", "numpy", "scipy", "opencv-python-headless", "gtsam", "processor")
"""What the last bits of a computation go with. The number of threads is not among them."""


@dataclass(frozen=True)
class Resumption:
    """What a run was asked to do, and what that needs, opened again."""

    start: StartRecord
    request: SequenceRequest
    sequence: Sequence
    config: Config
    earlier: RunFolder | None

    @staticmethod
    def of(
        folder: RunFolder, recording: Path | None, evaluate: bool | None = None, model: str | None = None,
        loss: str | None = None,
    ) -> Resumption:  # fmt: skip
        """That of a run.

        Args:
            folder: of the run, see `RunFolder.open_unfinished`.
            recording: where its recording is now; None: where it was.
            evaluate: whether it will be scored; None: as it was asked to.
            model: of masks that whoever goes on knows to be the run's.
            loss: name of the loss, likewise.

        Raises:
            GgslamError: see `resume`.
        """
        start = Checkpoints(folder.path).start()
        where = Checkpoints(folder.path).folder / StartRecord.FILE
        if start.ggslam != __version__ or start.version != VERSION:
            raise RunFolderError(
                f"{folder.path}: was begun with ggslam {start.ggslam} (checkpoints of version {start.version}), "
                f"this is {__version__} (version {VERSION}): resume it with that one"
            )
        if hash_of(start.config) != start.config_hash:
            raise RunFolderError(f"{where}: the settings are not those that the run was begun with")
        config = config_from_dict(start.config, str(where))
        if (model or "") != config.masks.model:
            raise ConfigError(_other_model(folder.path, config.masks.model))
        if loss != start.loss:
            raise ConfigError(_other_loss(folder.path, config.masks.model, start.loss))
        request = request_in(start.open, recording)
        sequence = request.open(truth=start.evaluate if evaluate is None else evaluate)
        found, expected = identity_of(sequence), start.recording
        differing = [name for name in expected if found.get(name) != expected[name]]
        if differing:
            name = differing[0]
            raise RunFolderError(
                f"{sequence.path}: not the recording that {folder.path} was begun with: {name.replace('_', ' ')}: "
                f"expected {expected[name]}, found {found.get(name)}"
            )
        return Resumption(start, request, sequence, config, _earlier(start))

    def restore(
        self, slam: Slam, checkpoints: Checkpoints, checkpointing: Checkpointing, observer: Observer
    ) -> int | None:
        """Brings a fresh `Slam` to the newest checkpoint; returns the frame that comes next, None if there is none."""
        beside = checkpoints.restore(slam, observer.note)
        if not beside:
            observer.note("there is no checkpoint yet: the run begins anew")
            return None
        begin = checkpointing.go_on(beside)
        observer.note(f"going on after frame {begin - 1} of {len(self.sequence)}")
        now = environment(self.config.threads)
        other = [name for name in _SAME_BITS if now.get(name) != self.start.environment.get(name)]
        if other:
            observer.note(f"other {', '.join(other)} than the run was begun with: the last bits may differ")
        return begin


def _other_model(run: Path, model: str) -> str:
    if not model:
        return f"{run}: was begun without a model of masks"
    command = go_on_command(run, model)
    return f"{run}: was begun with a model of masks, which is run like a program; if it is yours: `{command}`"


def _other_loss(run: Path, model: str, loss: str | None) -> str:
    if loss is None:
        return f"{run}: was begun without a loss of your own"
    command = go_on_command(run, model, loss)
    return f"{run}: was begun with the loss {loss}, which is run like a program; if it is yours: `{command}`"


def go_on_command(run: Path, model: str = "", loss: str | None = None) -> str:
    """What goes on with a run that was cut off; `model` of masks and `loss`: that it was begun with."""
    forms = {
        (False, False): "ggslam run --resume {run}",
        (True, False): "ggslam run --resume {run} --set masks.model={model}",
        (False, True): "ggslam run --resume {run} --loss {loss}",
        (True, True): "ggslam run --resume {run} --set masks.model={model} --loss {loss}",
    }
    values = {"run": str(run), "model": model, "loss": loss or ""}
    return forms[bool(model), loss is not None].format(**{name: shlex.quote(text) for name, text in values.items()})


def _earlier(start: StartRecord) -> RunFolder | None:
    """The run whose map this one began with."""
    if start.map is None:
        return None
    try:
        earlier = RunFolder.open(Path(start.map))
    except RunFolderError as error:
        raise RunFolderError(f"the run began with the map of another one: {error}") from None
    if fingerprint(earlier) != start.map_fingerprint:
        raise ConfigError(f"{start.map}: not the run any more whose map this one began with")
    return earlier
