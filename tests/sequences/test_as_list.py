# SPDX-License-Identifier: Apache-2.0
"""Sequences as lists and as data sets of torch."""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from format_makers import MORE_MAKERS, make_record3d
from torch.utils.data import DataLoader, Subset

from ggslam.errors import SequenceError
from ggslam.scene.frame import Frame
from ggslam.sequences import Sequence, collate_frames, open_sequence


def same(one: Frame, other: Frame) -> bool:
    return np.array_equal(one.color, other.color) and one.source_index == other.source_index


def test_indices(room: Path) -> None:
    sequence = open_sequence(room, start=2, stop=12, stride=2)
    assert len(sequence) == 5
    assert sequence[0].source_index == 2 and sequence[-1].source_index == 10 and sequence[-1].index == 4
    assert same(sequence[np.int64(1)], sequence.frame(1))
    for wrong in (5, -6):
        with pytest.raises(IndexError, match=f"-5.*4.*{wrong}"):
            sequence[wrong]
    with pytest.raises(TypeError):
        sequence["first"]  # type: ignore[call-overload]


def test_slices_are_sequences(room: Path) -> None:
    sequence = open_sequence(room, scale=0.5)
    part = sequence[4:20:3][1:-1]
    assert isinstance(part, Sequence) and part.camera == sequence.camera and list(part.selection) == [7, 10, 13, 16]
    assert [frame.index for frame in part] == [0, 1, 2, 3]
    assert part.ground_truth is not None and sequence.ground_truth is not None
    assert np.array_equal(part.ground_truth, sequence.ground_truth[7:17:3])
    assert np.array_equal(part.timestamps, sequence.timestamps[7:17:3])
    assert part.has_masks and same(part[0], sequence[7]) and len(sequence) == 24
    assert len(sequence[30:]) == 0 and list(sequence[30:]) == [] and not sequence[30:].has_masks
    with pytest.raises(SequenceError, match="slice.* 1.* -1"):
        sequence[::-1]


def test_iteration(room: Path) -> None:
    sequence = open_sequence(room, stop=3)
    assert [frame.index for frame in sequence] == [0, 1, 2]
    assert all(frame.mask is not None for frame in sequence)


@pytest.mark.parametrize("name", ["vmap", "record3d", "strayscanner", "ros1"])
def test_pickled(tmp_path: Path, name: str) -> None:
    sequence = open_sequence(MORE_MAKERS[name](tmp_path))[1:]
    again = pickle.loads(pickle.dumps(sequence))
    assert len(again) == len(sequence) and again.camera == sequence.camera
    assert same(again[-1], sequence[-1])


@pytest.mark.parametrize("workers", [0, 2])
def test_data_loader(room: Path, workers: int) -> None:
    sequence = open_sequence(room, stop=8)
    loader = DataLoader(sequence, batch_size=3, collate_fn=collate_frames, num_workers=workers)  # type: ignore[arg-type]
    batches = list(loader)
    assert [len(batch["index"]) for batch in batches] == [3, 3, 2]
    batch, frame = batches[1], sequence[4]
    assert {name: (tuple(t.shape), t.dtype) for name, t in batch.items()} == {
        "color": ((3, 3, 120, 160), torch.float32), "depth": ((3, 120, 160), torch.float32),
        "T_world_camera": ((3, 4, 4), torch.float64), "timestamp": ((3,), torch.float64),
        "index": ((3,), torch.int64), "source_index": ((3,), torch.int64), "mask": ((3, 120, 160), torch.int64),
    }  # fmt: skip
    assert frame.mask is not None and frame.T_world_camera is not None
    assert torch.equal((batch["color"][1] * 255).round().byte().permute(1, 2, 0), torch.from_numpy(frame.color))
    assert np.array_equal(batch["depth"][1], frame.depth) and np.array_equal(batch["mask"][1], frame.mask)
    assert np.array_equal(batch["T_world_camera"][1], frame.T_world_camera)


def test_workers_open_archives_for_themselves(tmp_path: Path) -> None:
    sequence = open_sequence(make_record3d(tmp_path))
    expected = [frame.color for frame in sequence]
    often = Subset(sequence, list(range(len(sequence))) * 4)  # type: ignore[arg-type, var-annotated]
    loader = DataLoader(often, 1, num_workers=2, collate_fn=collate_frames)  # type: ignore[arg-type]
    for number, batch in enumerate(loader):
        found = (batch["color"][0] * 255).round().byte().permute(1, 2, 0).numpy()
        assert np.array_equal(found, expected[number % len(expected)])


def test_batches_of_frames_that_lack_something(room: Path) -> None:
    frame = open_sequence(room, stop=1)[0]
    bare = dataclasses.replace(frame, mask=None, T_world_camera=None)
    batch = collate_frames([frame, bare])
    assert "mask" not in batch and torch.isnan(batch["T_world_camera"][1]).all()
    last = open_sequence(room, start=2, stop=8, stride=2)[1:][-1]
    assert [collate_frames([last])[name].tolist() for name in ("index", "source_index")] == [[1], [6]]
    small = open_sequence(room, stop=1, scale=0.5)[0]
    with pytest.raises(SequenceError, match="80x60, 160x120"):
        collate_frames([frame, small])
    with pytest.raises(SequenceError, match="none"):
        collate_frames([])
