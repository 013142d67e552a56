# SPDX-License-Identifier: Apache-2.0
"""A run's stream, coded as soon as the run is saved, beside scoring; a container when the run is complete.

Where a point lies is known when the last refinement has ended and the surface is read off the map; how a cloud is cut
into slices depends on all of its points. So slices are coded side by side from then on, and the bytes are those of
`encode` afterwards. A container also holds the run's records, which scores and report complete.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from ggslam.coding.settings import CodecSettings
from ggslam.errors import ConfigError, GgslamError, RunFolderError
from ggslam.jobs.encode.coded_cells import is_cells_file
from ggslam.jobs.encode.coding import PRESETS, encode_saved_run
from ggslam.jobs.encode.stream_output import check_stream_output
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_container import is_container, write_container
from ggslam.system.plurals import quantity


@dataclass(frozen=True)
class EncodeRequest:
    """What a run is coded as.

    Attributes:
        out: the stream, or a .ggz: all that merging needs.
        settings: every choice of the codec.
        preset, rate, ids: as of `encode_file`.
    """

    out: Path
    settings: CodecSettings = field(default_factory=CodecSettings)
    preset: str = "pointcloud"
    rate: str = "r03"
    ids: bool = True

    @property
    def needs_complete_run(self) -> bool:
        """Whether records of the run that scoring changes are coded, too."""
        return is_container(self.out)

    def check(self, run: Path, sources: Sequence[Path] = (), overwrite: bool | None = False) -> None:
        """Finds out before hours of work what cannot become of a run.

        Args:
            run: its folder.
            sources: folders of the recording and of the run in whose map it begins.
            overwrite: whether a stream may be replaced; None: that cannot be chosen.

        Raises:
            ConfigError: nothing can be coded so, or the file must not be written there.
            RunFolderError: its folder cannot be written to.
        """
        if self.preset not in PRESETS:
            raise ConfigError(f"preset: expected one of {', '.join(PRESETS)}, found '{self.preset}'")
        if is_cells_file(self.out):
            raise ConfigError(f"`encode` {self.out}: a .ggc is of a grid store, and this is a run")
        if run.resolve() in self.out.resolve().parents:
            raise ConfigError(f"`encode` {self.out}: lies in the run's own folder; name a file beside it")
        if check_stream_output(self.out, sources, "`encode` ") and not overwrite:
            ways = "remove it" if overwrite is None else "use `overwrite`"
            raise ConfigError(f"`encode` {self.out}: is there already; {ways} or choose another name")


class RunEncoding:
    """A saved run being coded in a thread of its own.

    Args:
        request: what to code it as.
        folder: the run, saved, and complete if the request needs that.
    """

    def __init__(self, request: EncodeRequest, folder: RunFolder) -> None:
        self._request, self._folder = request, folder
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="encode")
        self._done: Future[str] = self._pool.submit(self._encode)

    def wait(self) -> str:
        """What was written, in a line for people.

        Raises:
            GgslamError: it could not be.
        """
        try:
            return self._done.result()
        except GgslamError:
            raise
        except (OSError, MemoryError) as error:
            raise RunFolderError(f"{self._request.out}: {error}") from error
        finally:
            self._pool.shutdown()

    def _encode(self) -> str:
        r = self._request
        if is_container(r.out):
            held = write_container(self._folder, r.out, r.rate, r.settings)
            return f"coded {quantity(held.gaussians, 'Gaussian')}: {r.out}, {quantity(r.out.stat().st_size, 'byte')}"
        done = encode_saved_run(self._folder.path, r.out, r.settings, r.preset, r.rate, r.ids)
        notes = "".join(f"; {note}" for note in done.notes)
        what = quantity(done.report.input_points, "Gaussian" if r.preset == "splat" else "point")
        return (
            f"coded {what} in {quantity(len(done.report.slices), 'slice')}: {r.out}, "
            f"{quantity(done.report.total_bytes, 'byte')}, {done.report.bits_per_point:.2f} bits each{notes}"
        )
