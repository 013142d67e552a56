# SPDX-License-Identifier: Apache-2.0
"""YOLO-seg exports in the layouts of v5, v8 and v11: three heads of strides 8, 16 and 32 on an input of 640, and 32
prototypes of 160 x 160. The networks are small, and their weights such that they detect what is red, green or cyan."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from test_onnx_segmenter import EXPECTED, picture

from ggslam.objects.onnx_outputs import yolo_candidates
from ggslam.objects.onnx_segmenter import OnnxSegmenter

SIZE, STRIDES, PROTOTYPES, CLASSES = 640, (8, 16, 32), 32, 80
COLORS = torch.tensor([[1.0, 0, 0], [0, 1, -1], [0, 0, 1]])
"""What is red, green but not cyan, and cyan, as weights of red, green and blue."""


class ColorYolo(torch.nn.Module):
    """Cells of the coarsest head detect their colour, with a box of the whole input; the other heads detect nothing."""

    def __init__(self, version: int, classes: int) -> None:
        super().__init__()
        self.version, self.classes, self.anchors = version, classes, 3 if version == 5 else 1
        self.prototypes = torch.nn.Conv2d(3, PROTOTYPES, 4, 4)
        self.heads = torch.nn.ModuleList(torch.nn.Conv2d(3, 3, s, s, bias=False) for s in STRIDES)
        with torch.no_grad():
            self.prototypes.weight.zero_()
            self.prototypes.bias.zero_()
            self.prototypes.weight[:3] = COLORS[:, :, None, None] / 16
            self.prototypes.bias[3] = 1
            for head, stride in zip(self.heads, STRIDES, strict=True):
                head.weight.copy_((COLORS / stride**2)[:, :, None, None].expand(-1, -1, stride, stride))

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        stages = []
        for head, stride in zip(self.heads, STRIDES, strict=True):
            colors = head(images).flatten(2)  # [1, 3, cells]
            usable = 1.0 if stride == 32 else 0.0
            box = torch.full_like(colors[:, :1], SIZE / 2)
            boxes = torch.cat([box, box, 2 * box, 2 * box], 1)
            scores = usable * torch.sigmoid(40 * (colors - 0.8))
            if self.classes == 1:
                scores = scores.amax(1, keepdim=True)
            none = torch.zeros_like(colors[:, :1]).expand(-1, max(0, self.classes - 3), -1)
            weights = torch.cat([9 * colors, -4.5 * torch.ones_like(box)], 1)
            zeros = torch.zeros_like(box).expand(-1, PROTOTYPES - 4, -1)
            objectness = [usable * torch.ones_like(box)] if self.version == 5 else []
            stage = torch.cat([boxes, *objectness, scores, none, weights, zeros], 1)
            stages += [stage] * self.anchors
        detections = torch.cat(stages, 2)
        return (detections.transpose(1, 2) if self.version == 5 else detections), self.prototypes(images)


def export(path: Path, version: int, classes: int) -> Path:
    pytest.importorskip("onnx", reason="the package onnx, which makes the test models, is not installed")
    pytest.importorskip("onnxruntime", reason="the package onnxruntime is not installed")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            ColorYolo(version, classes), torch.zeros(1, 3, SIZE, SIZE), str(path), input_names=["images"],
            output_names=["output0", "output1"], dynamo=False,
        )  # fmt: skip
    return path


def iou(found: np.ndarray, expected: np.ndarray) -> list[float]:
    return [float(((found == i) & (expected == i)).sum() / ((found == i) | (expected == i)).sum()) for i in (1, 2, 3)]


@pytest.mark.parametrize(
    ("version", "classes", "shape"),
    [(5, CLASSES, (25200, 117)), (5, 1, (25200, 38)), (8, CLASSES, (116, 8400)), (11, 1, (37, 8400))],
)
def test_known_objects_come_out(tmp_path: Path, version: int, classes: int, shape: tuple[int, int]) -> None:
    model = ColorYolo(version, classes)
    detections, prototypes = model(torch.zeros(1, 3, SIZE, SIZE))
    assert tuple(detections.shape[1:]) == shape and tuple(prototypes.shape) == (1, 32, 160, 160)
    segmenter = OnnxSegmenter(export(tmp_path / f"v{version}.onnx", version, classes))
    found = segmenter.segment(picture())
    assert min(iou(found, EXPECTED)) > 0.95


def test_objectness_multiplies_the_score_of_a_class() -> None:
    """In v5 a sure class of a cell without an object is none."""
    table = np.zeros((1, 25200, 5 + CLASSES + PROTOTYPES), np.float32)
    table[0, :, :4] = 320, 320, 100, 60
    table[0, 7, [4, 9]], table[0, 8, [4, 9, 10]], table[0, 9, [4, 50]] = (0.1, 0.9), (0.8, 0.5, 0.9), (0.9, 0.2)
    found = yolo_candidates(table, np.zeros((1, PROTOTYPES, 160, 160), np.float32), 0.15, 300)
    assert np.allclose(found.scores, [0.72, 0.18])
    assert np.array_equal(found.boxes, np.tile(np.float32([270, 290, 370, 350]), (2, 1)))
