# SPDX-License-Identifier: Apache-2.0
"""Models of a user, stood in for by tiny ones whose masks are colours: red, green and blue things on black."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ggslam.errors import ConfigError, MissingDependency
from ggslam.objects.onnx_outputs import Letterbox
from ggslam.objects.onnx_segmenter import OnnxSegmenter, OnnxSegmenterSettings

WIDTH, HEIGHT, SIZE = 160, 120, 320
"""Of the image, and of the square input: the image is doubled, 40 rows of border above and below."""
RED, GREEN, BLUE = (20, 30, 60, 70), (80, 50, 140, 110), (100, 70, 120, 90)
"""Boxes (left, top, right, bottom) in the image; the blue one lies in the green one."""


def inside(box: tuple[int, int, int, int]) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[box[1] : box[3], box[0] : box[2]] = True
    return mask


def picture() -> np.ndarray:
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[inside(RED)] = (255, 0, 0)
    image[inside(GREEN)] = (0, 255, 0)
    image[inside(BLUE)] = (0, 255, 255)
    return image


EXPECTED = (2 * inside(RED) + 1 * inside(GREEN)) * ~inside(BLUE) + 3 * inside(BLUE)
"""By falling area: green 3600 pixels, red 1600, blue 400."""


# --- models ----------------------------------------------------------------------------------------------------------


def save(path: Path, nodes: list[Any], inputs: list[Any], outputs: list[Any], constants: dict[str, np.ndarray]) -> Path:
    onnx = pytest.importorskip("onnx", reason="the package onnx, which makes the test models, is not installed")
    pytest.importorskip("onnxruntime", reason="the package onnxruntime is not installed")
    initializers = [onnx.numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = onnx.helper.make_graph(nodes, "test", inputs, outputs, initializers)
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
    return path


def helper() -> Any:
    return pytest.importorskip("onnx", reason="the package onnx, which makes the test models, is not installed").helper


def value(name: str, shape: list[Any], dtype: str = "FLOAT") -> Any:
    h = helper()
    return h.make_tensor_value_info(name, getattr(sys.modules["onnx"].TensorProto, dtype), shape)


def color_masks(weights: np.ndarray, step: int) -> dict[str, np.ndarray]:
    """Constants of a convolution: logits from mean colours of `step` x `step` pixels; weights [n, 4]: r, g, b, 1."""
    kernel = np.tile(weights[:, :3, None, None] / step**2, (1, 1, step, step))
    return {"kernel": kernel.astype(np.float32), "bias": weights[:, 3].astype(np.float32)}


def yolo(path: Path, detections: np.ndarray, open_size: bool = False) -> Path:
    """32 prototypes: the three colours, a constant, and zeros. Detections do not depend on the image."""
    weights = np.zeros((32, 4))
    weights[:4] = np.eye(4)
    nodes = [
        helper().make_node("Conv", ["images", "kernel", "bias"], ["output1"], strides=[4, 4]),
        helper().make_node("Identity", ["table"], ["output0"]),
    ]
    size, grid = (["h", "w"], ["sh", "sw"]) if open_size else ([SIZE, SIZE], [SIZE // 4, SIZE // 4])
    return save(
        path, nodes, [value("images", [1, 3, *size])],
        [value("output0", list(detections.shape)), value("output1", [1, 32, *grid])],
        {**color_masks(weights, 4), "table": detections.astype(np.float32)},
    )  # fmt: skip


def rows() -> list[tuple[list[float], float, list[float]]]:
    """(corners in the input, score, coefficients of r, g, b, 1) of what the model detects."""

    def corners(box: tuple[int, int, int, int]) -> list[float]:
        return [2 * box[0], 2 * box[1] + 40, 2 * box[2], 2 * box[3] + 40]

    whole = [0.0, 0.0, SIZE, SIZE]
    return [
        (corners(BLUE), 0.8, [0, 0, 9, -4.5]),
        (whole, 0.9, [0, 9, 0, -4.5]),
        (corners((100, 60, 120, 100)), 0.5, [0, 0, 9, -4.5]),  # the blue thing again
        (whole, 0.7, [9, 0, 0, -4.5]),
        (whole, 0.2, [-9, -9, -9, 4.5]),  # the background, below the threshold
    ]


def raw_detections(count: int = 64, classes: int = 3) -> np.ndarray:
    """[1, 4 + classes + 32, count]: centre and size, class scores, coefficients."""
    table = np.zeros((4 + classes + 32, count))
    for i, (box, score, weights) in enumerate(rows()):
        left, top, right, bottom = box
        table[:4, 7 * i] = (left + right) / 2, (top + bottom) / 2, right - left, bottom - top
        table[4 + i % classes, 7 * i] = score
        table[4 + classes : 8 + classes, 7 * i] = weights
    return table[None]


def final_detections(count: int = 300) -> np.ndarray:
    """[1, count, 6 + 32]: corners, score, class, coefficients."""
    table = np.zeros((count, 38))
    for i, (box, score, weights) in enumerate(rows()):
        table[i, :10] = [*box, score, i, *weights]
    return table[None]


MASK_WEIGHTS = np.array([
    [0, 9, 0, -4.5], [0, 9, 0.1, -4.5], [9, 0, 0, -4.5], [0, 0, 9, -4.5], [9, 9, 9, -4.5], [0, 0, 0, 1.0],
])  # fmt: skip
"""Green, green again, red, blue, all of them, the whole image."""
MASK_SCORES = np.array([[0.95, 0.8, 0.9, 0.99, 0.1, 0.69]], np.float32)


def sam(path: Path, dtype: str = "FLOAT", probabilities: bool = False, extra: bool = False) -> Path:
    """Masks [1, 6, h, w] at half the input's size, and their scores."""
    h, proto = helper(), sys.modules["onnx"].TensorProto
    nodes = [
        h.make_node("Cast", ["image"], ["real"], to=proto.FLOAT),
        h.make_node("Div", ["real", "range"], ["unit"]),
        h.make_node("Conv", ["unit", "kernel", "bias"], ["logits"], strides=[2, 2]),
        h.make_node("Sigmoid" if probabilities else "Identity", ["logits"], ["masks"]),
        h.make_node("Identity", ["quality"], ["iou_predictions"]),
    ]
    outputs = [value("iou_predictions", [1, 6]), value("masks", [1, 6, SIZE // 2, SIZE // 2])]
    if extra:
        nodes.append(h.make_node("MaxPool", ["masks"], ["low_res_masks"], kernel_shape=[8, 8], strides=[8, 8]))
        outputs.insert(0, value("low_res_masks", [1, 6, SIZE // 16, SIZE // 16]))
    divisor = np.float32(255 if dtype == "UINT8" else 1)
    constants = {**color_masks(MASK_WEIGHTS, 2), "quality": MASK_SCORES, "range": divisor}
    return save(path, nodes, [value("image", [1, 3, SIZE, SIZE], dtype)], outputs, constants)


def agreement(found: np.ndarray, expected: np.ndarray) -> float:
    assert found.dtype == np.uint16 and found.shape == expected.shape
    return float((found == expected).mean())


# --- tests -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["raw", "final"])
def test_yolo(tmp_path: Path, kind: str) -> None:
    path = yolo(tmp_path / "yolo.onnx", raw_detections() if kind == "raw" else final_detections())
    assert agreement(OnnxSegmenter(path).segment(picture()), EXPECTED) == 1
    background = OnnxSegmenter(path, OnnxSegmenterSettings(detection_score=0.15)).segment(picture())
    assert agreement(background, np.where(EXPECTED > 0, EXPECTED + 1, 1)) > 0.99
    few = OnnxSegmenter(path, OnnxSegmenterSettings(max_masks=1)).segment(picture())
    assert agreement(few, inside(GREEN) & ~inside(BLUE) | inside(BLUE)) == 1  # the best score: all that is green
    assert not OnnxSegmenter(path, OnnxSegmenterSettings(detection_score=0.95)).segment(picture()).any()


def test_yolo_boxes_cut_masks(tmp_path: Path) -> None:
    table = final_detections()
    table[0, 1, :4] = [200, 150, 240, 400]  # columns 100 to 120, rows from 55 on
    found = OnnxSegmenter(yolo(tmp_path / "yolo.onnx", table)).segment(picture())
    cut = inside((100, 55, 120, 110))
    assert agreement((found > 0).astype(np.uint16), inside(RED) | cut) == 1


def test_upright_image_and_open_size(tmp_path: Path) -> None:
    """The border is then left and right; the input has the size of the settings."""
    table = final_detections(40)
    table[0, :, :4] = [0, 0, 1000, 1000]
    path = yolo(tmp_path / "yolo.onnx", table, open_size=True)
    upright = np.ascontiguousarray(picture().transpose(1, 0, 2))
    for size in (160, 320, 480):
        found = OnnxSegmenter(path, OnnxSegmenterSettings(input_size=size, detection_score=0.6)).segment(upright)
        assert agreement(found, np.ascontiguousarray(EXPECTED.T)) > (0.995 if size >= 320 else 0.98)


@pytest.mark.parametrize("dtype", ["FLOAT", "FLOAT16", "UINT8"])
def test_masks_with_scores(tmp_path: Path, dtype: str) -> None:
    path = sam(tmp_path / "sam.onnx", dtype)
    assert agreement(OnnxSegmenter(path).segment(picture()), EXPECTED) > 0.999
    everything = OnnxSegmenter(path, OnnxSegmenterSettings(mask_quality=0.6)).segment(picture())
    assert agreement(everything, np.where(EXPECTED > 0, EXPECTED + 1, 1)) > 0.999
    large = OnnxSegmenter(path, OnnxSegmenterSettings(min_area=0.05)).segment(picture())
    assert agreement(large, EXPECTED * (EXPECTED < 3)) < 1 and set(np.unique(large)) == {0, 1, 2}


def test_probabilities_and_small_masks_beside(tmp_path: Path) -> None:
    path = sam(tmp_path / "sam.onnx", probabilities=True, extra=True)
    assert agreement(OnnxSegmenter(path).segment(picture()), EXPECTED) > 0.999


def test_imagenet_pixels(tmp_path: Path) -> None:
    """Black is then below zero: the model sees what it would see of other colours."""
    path = sam(tmp_path / "sam.onnx")
    grey = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)  # 0.35: no mask as it is, nor less the mean
    grey[inside(RED)] = (190, 90, 90)  # 0.745 (- 0.485) / 0.229 = 1.14
    found = OnnxSegmenter(path, OnnxSegmenterSettings(pixels="imagenet", mask_quality=0.85)).segment(grey)
    assert agreement(found, inside(RED)) > 0.999


def test_same_image_same_segments(tmp_path: Path) -> None:
    segmenter = OnnxSegmenter(yolo(tmp_path / "yolo.onnx", raw_detections()))
    np.testing.assert_array_equal(segmenter.segment(picture()), segmenter.segment(picture()))


def test_models_that_are_not_understood(tmp_path: Path) -> None:
    h = helper()
    decoder = save(
        tmp_path / "decoder.onnx", [h.make_node("Add", ["image_embeddings", "point_coords"], ["masks"])],
        [value("image_embeddings", [1, 256, 64, 64]), value("point_coords", [1, 256, 64, 64])],
        [value("masks", [1, 256, 64, 64])], {},
    )  # fmt: skip
    with pytest.raises(
        ConfigError, match=r"decoder\.onnx.* image_embeddings tensor\(float\) \[1, 256, 64, 64\]"
    ):
        OnnxSegmenter(decoder)
    classifier = save(
        tmp_path / "classifier.onnx", [h.make_node("GlobalAveragePool", ["image"], ["pooled"])],
        [value("image", [1, 3, 64, 64])], [value("pooled", [1, 3, 1, 1])], {},
    )  # fmt: skip
    with pytest.raises(ConfigError, match=r"classifier\.onnx.* image .*pooled tensor\(float\) \[1, 3, 1, 1\]"):
        OnnxSegmenter(classifier)


def test_detections_of_another_layout(tmp_path: Path) -> None:
    """Fewer columns than boxes and coefficients have are refused, not misread."""
    segmenter = OnnxSegmenter(yolo(tmp_path / "other.onnx", np.zeros((1, 200, 36))))
    with pytest.raises(ConfigError, match=r"other\.onnx.*\[1, 200, 36\]"):
        segmenter.segment(picture())


def test_files_that_are_no_models(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="the package onnxruntime is not installed")
    with pytest.raises(ConfigError, match=r"none\.onnx"):
        OnnxSegmenter(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("hello")
    with pytest.raises(ConfigError, match=r"text\.onnx"):
        OnnxSegmenter(tmp_path / "text.onnx")


def test_missing_package_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingDependency, match=r"ggslam\[masks\]"):
        OnnxSegmenter(tmp_path / "model.onnx")


@pytest.mark.parametrize(
    "wrong", [{"overlap": 1.5}, {"mask_quality": -1}, {"max_masks": 0}, {"input_size": 1}, {"pixels": "grey"}]
)
def test_settings_out_of_range(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=rf"OnnxSegmenterSettings\.{next(iter(wrong))}"):
        OnnxSegmenterSettings(**wrong)


@pytest.mark.parametrize("centred", [True, False])
@pytest.mark.parametrize("size", [(64, 64), (97, 51), (640, 640)])
def test_letterbox_there_and_back(size: tuple[int, int], centred: bool) -> None:
    """A smooth image comes back from the input, and from a grid of half its size, where it was."""
    x, y = np.meshgrid(np.arange(80), np.arange(60))
    image = np.stack([2 * x, 3 * y, x + y], -1).astype(np.uint8)
    letterbox = Letterbox.fit(80, 60, size, centred)
    placed = letterbox.place(image, 0).astype(np.float32)
    assert placed.shape[:2] == size[::-1]
    half = placed[: size[1] // 2 * 2, : size[0] // 2 * 2].reshape(size[1] // 2, 2, size[0] // 2, 2, 3).mean((1, 3))
    even = size[0] % 2 == 0
    for grid in [placed, half] if even else [placed]:
        back = np.stack([letterbox.to_image(np.ascontiguousarray(grid[..., c]), 80, 60) for c in range(3)], -1)
        assert np.abs(back - image)[4:-4, 4:-4].max() < 2.5
