# SPDX-License-Identifier: Apache-2.0
"""Networks of the true layouts and sizes with random weights: what they find means nothing, but is always segments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from random_networks import RandomDecoder, RandomEncoder, RandomYolo
from test_sam_pairs import META_AXES, META_OUTPUTS, export, meta_inputs

from ggslam.objects.model_files import open_segmenter
from ggslam.objects.onnx_segmenter import OnnxSegmenterSettings
from ggslam.objects.sam_segmenter import SamSegmenter, SamTuning
from ggslam.system.tuning import overridden


def noise(width: int = 320, height: int = 240) -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (height, width, 3), dtype=np.uint8)


def check_segments(segments: np.ndarray, height: int, width: int, most: int) -> int:
    """Ids without gaps, by the areas that are seen or covered; their number."""
    assert segments.dtype == np.uint16 and segments.shape == (height, width)
    ids = np.unique(segments[segments > 0])
    assert np.array_equal(ids, np.arange(1, len(ids) + 1)) and len(ids) <= most
    assert all(np.count_nonzero(segments == i) >= 5e-4 * height * width for i in ids)
    return len(ids)


@pytest.mark.parametrize(("version", "shape"), [(5, (25200, 117)), (8, (116, 8400)), (11, (116, 8400))])
def test_yolo(tmp_path: Path, version: int, shape: tuple[int, int]) -> None:
    torch.manual_seed(version)
    network = RandomYolo(version).eval()
    images = torch.rand(1, 3, 640, 640)
    with torch.no_grad():
        detections, prototypes = network(images)
    assert tuple(detections.shape[1:]) == shape and tuple(prototypes.shape) == (1, 32, 160, 160)
    path = export(tmp_path / "yolo.onnx", network, {"images": images}, ["output0", "output1"], {})
    settings = OnnxSegmenterSettings(detection_score=0.2)
    segmenter = open_segmenter(path, settings)
    found = segmenter.segment(noise())
    assert check_segments(found, 240, 320, 300) > 3
    assert np.array_equal(found, segmenter.segment(noise()))
    assert check_segments(segmenter.segment(noise(90, 200)), 200, 90, 300) > 3
    shy = export(tmp_path / "shy.onnx", RandomYolo(version, -9).eval(), {"images": images}, ["output0", "output1"], {})
    assert not open_segmenter(shy, settings).segment(noise()).any()


@pytest.mark.long("exports and runs a vision transformer of 4,096 tokens")
def test_sam(tmp_path: Path) -> None:
    torch.manual_seed(0)
    export(tmp_path / "encoder.onnx", RandomEncoder().eval(), {"x": torch.rand(1, 3, 1024, 1024)}, ["embeddings"], {})
    decoder = RandomDecoder(1).eval()
    with torch.no_grad():
        masks, scores, small = decoder(*meta_inputs().values())
    assert tuple(masks.shape) == (1, 4, 1500, 2250) and tuple(small.shape) == (1, 4, 256, 256) and scores.shape[1] == 4
    export(tmp_path / "decoder.onnx", decoder, meta_inputs(), META_OUTPUTS, META_AXES)
    segmenter = open_segmenter(tmp_path, OnnxSegmenterSettings(mask_quality=0))
    assert isinstance(segmenter, SamSegmenter)
    with overridden(SamTuning, points_per_side=3):
        found = segmenter.segment(noise())
        assert check_segments(found, 240, 320, 27) >= 1
        assert np.array_equal(found, segmenter.segment(noise()))
        export(tmp_path / "decoder.onnx", RandomDecoder(-9).eval(), meta_inputs(), META_OUTPUTS, META_AXES)
        assert not open_segmenter(tmp_path, OnnxSegmenterSettings()).segment(noise()).any()
