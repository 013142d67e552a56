# SPDX-License-Identifier: Apache-2.0
"""Coding of clouds that come in blocks: what is in memory is a block, or the slices that threads have in their hands.

The blocks are gone through once and kept in a temporary file; slices are cut, sorted into a second one, and coded from
there. The stream is, byte for byte, that of the whole cloud.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import IO

import numpy as np

from ggslam.coding.attribute_values import AttributeSummary, plan_summaries
from ggslam.coding.cloud import CodingReport
from ggslam.coding.encoder import checked_points, encode_cloud, parameter_units, sequence_parameters
from ggslam.coding.geometry_syntax import GeometryParameters
from ggslam.coding.geometry_tools import GeometrySample, geometry_parameters
from ggslam.coding.parallel_slices import in_order
from ggslam.coding.position_quantiser import PositionQuantiser
from ggslam.coding.quantization import Quantization, choose_quantization
from ggslam.coding.settings import CodecSettings
from ggslam.coding.slice_encoder import CloudToCode, CodedSlice, encode_slice
from ggslam.coding.slices import PlaneCuts, Points, slices_wanted
from ggslam.errors import FormatError
from ggslam.system.atomic import atomic_write, write_failure
from ggslam.system.tuning import Tuning

Block = tuple[np.ndarray, Mapping[str, np.ndarray]]
"""Points [N, 3] and attributes by name, as `encode_cloud` takes them; all blocks of a cloud have the same types."""


class BlockTuning(Tuning):
    """How much of a cloud is in memory."""

    rows_at_once = 1 << 16
    """Points that are read at a time."""


_POINTS = " points"


def encode_blocks(blocks: Iterator[Block], settings: CodecSettings, out: Path) -> CodingReport:
    """Codes a cloud and writes the stream. The bytes are those of `encode_cloud`.

    A cloud of one slice, one that is cut in cubes, and one of which an interval has more points than a slice may have,
    are coded in memory.

    Args:
        blocks: of the cloud, in its order.
        settings: every choice.
        out: the file, in a folder that is there; temporary files lie beside it, too.

    Raises:
        ConfigError, FormatError: as `encode_cloud`.
        RunFolderError: a file cannot be written.
    """
    start = time.perf_counter()
    with ExitStack() as stack:
        try:
            spool, sorted_rows, coded = (stack.enter_context(tempfile.TemporaryFile(dir=out.parent)) for _ in range(3))
            cloud = _Spool.of(blocks, settings, spool)
            cut = cloud.cut(sorted_rows)
            report = _encode_whole(cloud, out) if cut is None else _encode_cut(cloud, cut, coded, out)
        except OSError as error:
            raise write_failure(out, error) from error
    return replace(report, seconds=time.perf_counter() - start)


class _Spool:
    """A cloud in a file, a row for each point, and what is known of it as a whole.

    Args:
        file: with the rows.
        first: a block of the cloud, for the types.
    """

    def __init__(self, file: IO[bytes], first: Block, settings: CodecSettings) -> None:
        points, attributes = first
        fields = {_POINTS: points, **attributes}
        self.file, self.settings = file, settings
        self.dtype = np.dtype([(name, values.dtype, values.shape[1:]) for name, values in fields.items()])
        self.count = 0
        self.corners = np.stack([points.min(0), points.max(0)])
        self.summaries: dict[str, AttributeSummary] = {}

    @staticmethod
    def of(blocks: Iterator[Block], settings: CodecSettings, file: IO[bytes]) -> _Spool:
        """Writes the blocks down; raises FormatError if there are no points."""
        spool: _Spool | None = None
        for points, attributes in blocks:
            if len(points):
                points = checked_points(points)
                spool = spool or _Spool(file, (points, attributes), settings)
                spool._add(points, attributes)
        if spool is None:
            raise FormatError("a cloud without points cannot be coded")
        return spool

    def _add(self, points: np.ndarray, attributes: Mapping[str, np.ndarray]) -> None:
        rows = np.empty(len(points), self.dtype)
        for name, values in {_POINTS: points, **attributes}.items():
            rows[name] = values
        self.file.write(rows.tobytes())
        self.count += len(points)
        together = np.concatenate([self.corners, points])
        self.corners = np.stack([together.min(0), together.max(0)])
        for name, values in attributes.items():
            own = AttributeSummary.of(values, self.settings.attribute(name))
            self.summaries[name] = self.summaries[name].join(own) if name in self.summaries else own

    def rows(self, file: IO[bytes], start: int, count: int) -> np.ndarray:
        """Rows of a file in this form; may be called by several threads."""
        size = self.dtype.itemsize
        return np.frombuffer(os.pread(file.fileno(), count * size, start * size), self.dtype)

    def split(self, rows: np.ndarray) -> Block:
        """Points and attributes of rows, each an array of its own."""
        columns = {name: np.ascontiguousarray(rows[name]) for name in self.dtype.names or ()}
        return columns.pop(_POINTS), columns

    def blocks(self) -> Iterator[np.ndarray]:
        """All rows, some at a time."""
        self.file.flush()
        for start in range(0, self.count, BlockTuning.rows_at_once):
            yield self.rows(self.file, start, min(BlockTuning.rows_at_once, self.count - start))

    def quantization(self) -> Quantization:
        """The grid."""
        s = self.settings
        return choose_quantization(
            self.corners, s.voxel_size, s.geometry_bits, s.geometry_scale, s.box, s.unit, s.shift
        )

    def geometry(self, grid: Quantization) -> GeometryParameters:
        """The parameter set of all slices."""
        assert grid.size is not None
        sample = GeometrySample(self.count, grid.size, PositionQuantiser(self.settings.geometry_qp))
        for rows in self.blocks():
            sample.add(grid.of(np.ascontiguousarray(rows[_POINTS])))
        return geometry_parameters(self.settings, sample)

    def cut(self, file: IO[bytes]) -> _Cut | None:
        """Sorts the rows by slice into a file; None if they are better coded as a whole."""
        wanted = slices_wanted(self.count, self.settings)
        if wanted == 1 or self.settings.split == "cube":
            return None
        grid = self.quantization()

        def points() -> Iterator[Points]:
            return ((grid.of(np.ascontiguousarray(rows[_POINTS])), None) for rows in self.blocks())

        assert grid.size is not None
        if self.settings.split == "interval":
            cuts = PlaneCuts.by_interval(grid.size, wanted)
        else:
            cuts = PlaneCuts.by_count(points, grid.size, wanted)
        counts = np.zeros(wanted, np.int64)
        for block, _ in points():
            counts += np.bincount(cuts.numbers(block), minlength=wanted)
        if counts.max() > self.settings.max_points or (counts > 0).sum() == 1:
            return None
        place = np.cumsum(counts) - counts
        begins = place.copy()
        for rows in self.blocks():
            numbers = cuts.numbers(grid.of(np.ascontiguousarray(rows[_POINTS])))
            order = np.argsort(numbers, kind="stable")
            for number, own in zip(*_runs(numbers[order]), strict=True):
                file.seek(place[number] * self.dtype.itemsize)
                file.write(rows[order[own]].tobytes())
                place[number] += own.stop - own.start
        file.flush()
        filled = counts > 0
        return _Cut(file, begins[filled], counts[filled])


class _Cut:
    """Rows sorted by slice: the file, first row and number of rows of each."""

    def __init__(self, file: IO[bytes], begins: np.ndarray, counts: np.ndarray) -> None:
        self.file, self.begins, self.counts = file, begins.tolist(), counts.tolist()


def _runs(values: np.ndarray) -> tuple[list[int], list[slice]]:
    """The different values of a sorted array and where each stands."""
    starts = np.flatnonzero(np.diff(values.astype(np.int64), prepend=-1))
    ends = [*starts[1:].tolist(), len(values)]
    return values[starts].tolist(), [slice(a, b) for a, b in zip(starts.tolist(), ends, strict=True)]


def _encode_whole(cloud: _Spool, out: Path) -> CodingReport:
    points, attributes = cloud.split(np.concatenate(list(cloud.blocks())))
    encoded = encode_cloud(points, attributes, cloud.settings)
    with atomic_write(out) as temporary:
        temporary.write_bytes(encoded.data)
    return encoded.report


def _encode_cut(cloud: _Spool, cut: _Cut, coded: IO[bytes], out: Path) -> CodingReport:
    plans, grid = plan_summaries(cloud.summaries, cloud.settings), cloud.quantization()
    sequence = sequence_parameters(grid, [plan for plan, _ in plans], PositionQuantiser(cloud.settings.geometry_qp))
    geometry = cloud.geometry(grid)
    shared = CloudToCode(np.empty((0, 3)), {}, None, plans, sequence, geometry, grid, cloud.settings, False)

    def code(number: int) -> CodedSlice:
        points, attributes = cloud.split(cloud.rows(cut.file, cut.begins[number], cut.counts[number]))
        return encode_slice(replace(shared, points=points, attributes=attributes), number)

    slices = []
    for done in in_order(code, len(cut.counts), cloud.settings.threads):
        coded.write(done.data)
        slices.append(replace(done, data=b""))
    with atomic_write(out) as temporary, temporary.open("wb") as file:
        file.write(parameter_units(shared, len(slices)))
        coded.seek(0)
        shutil.copyfileobj(coded, file, 1 << 20)
        size = file.tell()
    reports = tuple(done.report for done in slices)
    return CodingReport(cloud.count, sum(report.points for report in reports), size, reports, 0.0)
