# SPDX-License-Identifier: Apache-2.0
"""A segmented map that needs no training: the generated room's true surfaces and labels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from ggslam.mapping.cpu.insertion import new_gaussians
from ggslam.mapping.settings import InsertionSettings
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IDENTITY_CHANNELS, IdentityClassifier
from ggslam.sequences import Sequence, open_sequence


@dataclass
class SegmentedRoom:
    """Gaussians of some frames of the room with true object ids, identity vectors and a classifier that reads them."""

    sequence: Sequence
    frames: list[Frame]
    gaussians: GaussianMap
    classifier: IdentityClassifier


def classifier_for(ids: np.ndarray, seed: int = 0) -> IdentityClassifier:
    """Random directions, well apart: logits of a vector 2 w / |w|^2 ... are highest for its own class."""
    directions = np.random.default_rng(seed).normal(size=(len(ids), IDENTITY_CHANNELS)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return IdentityClassifier(ids.astype(np.uint16), 4 * directions, np.zeros(len(ids), np.float32))


def build_segmented_room(folder: Path, numbers: tuple[int, ...] = (0, 8, 16)) -> SegmentedRoom:
    sequence = open_sequence(folder)
    frames = [sequence.frame(number) for number in numbers]
    ids = np.unique(np.concatenate([np.unique(frame.mask) for frame in frames]))
    classifier = classifier_for(ids[ids > 0])
    gaussians = GaussianMap(feature_channels=IDENTITY_CHANNELS)
    for index, frame in enumerate(frames):
        everywhere = np.ones(frame.depth.shape, bool)
        new = new_gaussians(
            frame.color, frame.depth, frame.camera, frame.T_world_camera, everywhere, InsertionSettings()
        )
        labels = frame.mask.reshape(-1)[new.pixels]
        number = np.searchsorted(classifier.class_ids, labels).clip(0, len(classifier) - 1)
        features = np.where(labels[:, None] > 0, classifier.weight[number], 0).astype(np.float32)
        gaussians.insert(
            torch.from_numpy(new.means), torch.from_numpy(new.quaternions), torch.from_numpy(new.log_scales),
            torch.full((len(new.means),), 2.0), torch.from_numpy(new.rgb), torch.from_numpy(features),
            birth_keyframe=index, object_id=torch.from_numpy(labels.astype(np.int32)),
        )  # fmt: skip
    return SegmentedRoom(sequence, frames, gaussians, classifier)


@pytest.fixture(scope="module")
def shared_segmented_room(room: Path) -> SegmentedRoom:
    """One for all tests of a file, which leave it as it is."""
    return build_segmented_room(room)


@pytest.fixture
def segmented_room(room: Path) -> SegmentedRoom:
    """Fresh for every test: edits do not leak."""
    return build_segmented_room(room)
