# SPDX-License-Identifier: Apache-2.0
"""SAM encoders and decoders, exported in the layouts that usual exporters give them. Their weights are made: a mask is
what has the colour of the point that was asked, so the segments of a picture are known."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch.nn import functional

from ggslam.errors import ConfigError
from ggslam.objects.model_files import find_pair, open_segmenter
from ggslam.objects.onnx_segmenter import OnnxSegmenterSettings
from ggslam.objects.sam_segmenter import SamSegmenter, SamTuning
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.slam.config import load_config
from ggslam.slam.slam import Slam
from ggslam.system.tuning import overridden

SIZE, GRID, PATCH = 1024, 256, 4
MEAN = torch.tensor([0.485, 0.456, 0.406])[:, None, None]
DEVIATION = torch.tensor([0.229, 0.224, 0.225])[:, None, None]
PALETTE = torch.tensor([[0.1, 0.1, 0.9], [0.9, 0.1, 0.1], [0.1, 0.9, 0.1], [0.9, 0.9, 0.1]])
"""Colours of the picture's background and of its things, by falling area."""


def scene(width: int = 640, height: int = 480) -> tuple[np.ndarray, np.ndarray]:
    """An image and its true segments 1 to 4."""
    segments = np.ones((height, width), np.uint8)
    cv2.rectangle(segments, (width // 2 + 20, height // 12), (width - 30, height // 2), 2, -1)
    cv2.ellipse(segments, (width // 4, height * 2 // 3), (width // 7, height // 5), 20, 0, 360, 3, -1)
    cv2.circle(segments, (width * 3 // 4, height * 3 // 4), min(width, height) // 7, 4, -1)
    return (PALETTE.numpy() * 255).astype(np.uint8)[segments - 1], segments


def least_iou(found: np.ndarray, truth: np.ndarray) -> float:
    ids = range(1, 5)
    return float(min(((found == i) & (truth == i)).sum() / ((found == i) | (truth == i)).sum() for i in ids))


# --- encoders --------------------------------------------------------------------------------------------------------


def packed(colors: torch.Tensor) -> torch.Tensor:
    """[1, 256, 64, 64]: colours [1, 3, 256, 256], the 4 x 4 of a patch in 48 channels."""
    patches = functional.pixel_unshuffle(colors, PATCH)
    return torch.cat([patches, torch.zeros_like(patches[:, :1]).expand(-1, 256 - 48, -1, -1)], 1)


class Encoder(torch.nn.Module):
    """Takes [1, 3, 1024, 1024], normalised; of SAM 2 it gives the colours in features of high resolution, of Optimum
    another embedding beside them. An image that is not placed as the layout wants it is all black: SAM's has zeros
    below or beside it, that of SAM 2 and EfficientSAM fills the input."""

    def __init__(self, layout: str) -> None:
        super().__init__()
        self.layout = layout

    def forward(self, image: torch.Tensor) -> Any:
        if self.layout == "efficient":  # normalises itself, which is then undone, and takes any size
            colors = functional.interpolate(image, (SIZE, SIZE), mode="bilinear")
        elif self.layout == "channels last":
            image = (image / 255).permute(2, 0, 1)
            height, width = image.shape[-2:]
            colors = functional.pad(image, (0, SIZE - width, 0, SIZE - height))[None]
        else:
            colors = image * DEVIATION + MEAN
        small = functional.avg_pool2d(colors, PATCH)
        if self.layout != "channels last":
            corner = image[..., -1, -1].abs().amax()
            small = small * (corner > 1e-6 if self.layout in ("sam2", "efficient") else corner < 1e-6)
        if self.layout == "sam2":
            features = torch.cat([small, torch.zeros_like(small[:, :1]).expand(-1, 29, -1, -1)], 1)
            middle = functional.avg_pool2d(features, 2)
            last = functional.avg_pool2d(middle, 2).repeat(1, 8, 1, 1)
            return features, torch.cat([middle, middle], 1), last
        embedding = packed(small)
        return (embedding, torch.zeros_like(embedding)) if self.layout == "optimum" else embedding


# --- decoders --------------------------------------------------------------------------------------------------------


def answers(
    colors: torch.Tensor, points: torch.Tensor, labels: torch.Tensor, others: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Logits [n, 4, 256, 256] and scores [n, 4] of points [n, k, 2] in colours [1, 3, 256, 256]. The first mask is for
    several points, and of the others one is vague and one is bad. Points of another number, labels or colours than
    there are in the picture are worth nothing.

    Args:
        others: points that are none, beside the one that is.
    """
    x, y = ((points[:, 0, i] / PATCH).floor().clamp(0, GRID - 1).long() for i in (0, 1))
    color = colors.flatten(2)[0][:, y * GRID + x].t()  # [n, 3]
    is_known = ((color[:, None] - PALETTE).abs().amax(2) < 0.03).any(1)
    right = (labels[:, 0] == 1) & ((labels == -1).sum(1) == others)
    distance = (colors - color[:, :, None, None]).abs().amax(1)  # [n, 256, 256]
    masks = torch.stack([
        torch.ones_like(distance) * 9, 60 * (0.4 - distance), 3 * (0.7 - distance), torch.ones_like(distance) * 9,
    ], 1)  # fmt: skip
    scores = torch.tensor([[0.99, 0.95, 0.99, 0.3]]) * (is_known & right)[:, None]
    return masks, scores


class MetaDecoder(torch.nn.Module):
    """Meta's: one prompt, a point that is none beside it, and masks of the image's size."""

    def __init__(self, others: int = 1) -> None:
        super().__init__()
        self.others = others

    def forward(
        self, embeddings: torch.Tensor, points: torch.Tensor, labels: torch.Tensor, hint: torch.Tensor,
        has_hint: torch.Tensor, size: torch.Tensor,
    ) -> Any:  # fmt: skip
        colors = functional.pixel_shuffle(embeddings[:, :48], PATCH)
        small, scores = answers(colors, points + 0 * hint.sum() + 0 * has_hint.sum(), labels, self.others)
        large = functional.interpolate(small, (SIZE, SIZE), mode="bilinear")
        inner = torch.floor(SIZE / size.max() * size + 0.5).long()
        large = large[..., : inner[0], : inner[1]]
        size = size.long()
        return functional.interpolate(large, (size[0], size[1]), mode="bilinear"), scores, small


class Sam2Decoder(torch.nn.Module):
    """Several prompts at once, three masks of each."""

    def forward(
        self, embeddings: torch.Tensor, features0: torch.Tensor, features1: torch.Tensor, points: torch.Tensor,
        labels: torch.Tensor, hint: torch.Tensor, has_hint: torch.Tensor,
    ) -> Any:  # fmt: skip
        unused = 0 * (hint.sum() + has_hint.sum() + embeddings.sum() + features1.sum())
        masks, scores = answers(features0[:, :3], points + unused, labels, 0)
        return masks[:, 1:], scores[:, 1:]


class EfficientDecoder(torch.nn.Module):
    """Points [1, n, 1, 2] in an image of a given size, masks [1, n, 3, h, w] of it."""

    def forward(self, embeddings: torch.Tensor, points: torch.Tensor, labels: torch.Tensor, size: torch.Tensor) -> Any:
        colors = functional.pixel_shuffle(embeddings[:, :48], PATCH)
        points = torch.stack([points[..., 0] * SIZE / size[1], points[..., 1] * SIZE / size[0]], -1)
        masks, scores = answers(colors, points[0], labels[0], 0)
        return functional.interpolate(masks[:, 1:], (size[0], size[1]), mode="bilinear")[None], scores[None, :, 1:]


class OptimumDecoder(torch.nn.Module):
    """Points [1, n, k, 2] and whole numbers of labels."""

    def forward(
        self, points: torch.Tensor, labels: torch.Tensor, embeddings: torch.Tensor, positions: torch.Tensor
    ) -> Any:
        colors = functional.pixel_shuffle(embeddings[:, :48], PATCH)
        masks, scores = answers(colors, points[0] + 0 * positions.sum(), labels[0], 0)
        return scores[None, :, 1:], masks[None, :, 1:]


def export(path: Path, net: torch.nn.Module, inputs: dict[str, torch.Tensor], outputs: list[str], axes: Any) -> Path:
    pytest.importorskip("onnx", reason="the package onnx, which makes the test models, is not installed")
    pytest.importorskip("onnxruntime", reason="the package onnxruntime is not installed")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            net, tuple(inputs.values()), str(path), input_names=list(inputs), output_names=outputs, dynamic_axes=axes,
            dynamo=False, opset_version=17,
        )  # fmt: skip
    return path


def meta_inputs() -> dict[str, torch.Tensor]:
    """What Meta's decoder is exported with."""
    return {
        "image_embeddings": torch.rand(1, 256, 64, 64), "point_coords": 1000 * torch.rand(1, 5, 2),
        "point_labels": torch.ones(1, 5), "mask_input": torch.zeros(1, 1, 256, 256), "has_mask_input": torch.ones(1),
        "orig_im_size": torch.tensor([1500.0, 2250.0]),
    }  # fmt: skip


META_AXES = {"point_coords": {1: "num_points"}, "point_labels": {1: "num_points"}}
META_OUTPUTS = ["masks", "iou_predictions", "low_res_masks"]


def export_meta(path: Path, low_res: bool = True, others: int = 1) -> Path:
    outputs = META_OUTPUTS if low_res else [*META_OUTPUTS[:2], "others"]
    return export(path, MetaDecoder(others), meta_inputs(), outputs, META_AXES)


def export_encoder(path: Path, layout: str = "meta") -> Path:
    image = torch.rand(1, 3, SIZE, SIZE)
    name, outputs, axes = "image", ["image_embeddings"], {}
    if layout == "sam2":
        outputs = ["high_res_feats_0", "high_res_feats_1", "image_embed"]
    elif layout == "optimum":
        name, outputs = "pixel_values", ["image_embeddings", "image_positional_embeddings"]
    elif layout == "efficient":
        name, axes = "batched_images", {"batched_images": {0: "batch", 2: "height", 3: "width"}}
    elif layout == "channels last":
        name, image, axes = "input_image", 255 * torch.rand(768, SIZE, 3), {"input_image": {0: "height", 1: "width"}}
    return export(path, Encoder(layout), {name: image}, outputs, axes)


def export_sam2(path: Path) -> Path:
    inputs = {
        "image_embed": torch.rand(1, 256, 64, 64), "high_res_feats_0": torch.rand(1, 32, 256, 256),
        "high_res_feats_1": torch.rand(1, 64, 128, 128), "point_coords": 1000 * torch.rand(2, 3, 2),
        "point_labels": torch.ones(2, 3), "mask_input": torch.zeros(2, 1, 256, 256), "has_mask_input": torch.ones(1),
    }  # fmt: skip
    axes = {name: {0: "num_labels", 1: "num_points"} for name in ("point_coords", "point_labels")}
    axes["mask_input"] = {0: "num_labels"}
    return export(path, Sam2Decoder(), inputs, ["masks", "iou_predictions"], axes)


def export_pair(folder: Path, layout: str) -> Path:
    """The folder of an encoder and a decoder."""
    if layout == "optimum":
        encoder, decoder = folder / "vision_encoder.onnx", folder / "prompt_encoder_mask_decoder.onnx"
        inputs = {
            "input_points": 1000 * torch.rand(1, 2, 3, 2), "input_labels": torch.ones(1, 2, 3, dtype=torch.int64),
            "image_embeddings": torch.rand(1, 256, 64, 64), "image_positional_embeddings": torch.rand(1, 256, 64, 64),
        }  # fmt: skip
        axes = {name: {0: "batch", 1: "prompts", 2: "points"} for name in ("input_points", "input_labels")}
        export(decoder, OptimumDecoder(), inputs, ["iou_scores", "pred_masks"], axes)
    elif layout == "efficient":
        encoder, decoder = folder / "efficient_sam_vitt_encoder.onnx", folder / "efficient_sam_vitt_decoder.onnx"
        inputs = {
            "image_embeddings": torch.rand(1, 256, 64, 64), "batched_point_coords": 1000 * torch.rand(1, 5, 1, 2),
            "batched_point_labels": torch.ones(1, 5, 1), "orig_im_size": torch.tensor([1080, 1920]),
        }  # fmt: skip
        axes = {name: {1: "num_points"} for name in ("batched_point_coords", "batched_point_labels")}
        export(decoder, EfficientDecoder(), inputs, ["output_masks", "iou_predictions"], axes)
    elif layout == "sam2":
        encoder = folder / "sam2_hiera_tiny.encoder.onnx"
        export_sam2(folder / "sam2_hiera_tiny.decoder.onnx")
    else:
        encoder = folder / "encoder.onnx"
        export_meta(folder / "decoder.onnx", low_res=layout != "whole masks only")
    export_encoder(encoder, layout)
    return folder


# --- tests -----------------------------------------------------------------------------------------------------------


@pytest.mark.long("asks a decoder of one prompt at all 256 points")
@pytest.mark.parametrize("layout", ["meta", "whole masks only", "channels last", "sam2", "efficient", "optimum"])
def test_known_things_come_out(tmp_path: Path, layout: str) -> None:
    segmenter = open_segmenter(export_pair(tmp_path, layout), OnnxSegmenterSettings())
    assert isinstance(segmenter, SamSegmenter)
    for size, side in (((640, 480), SamTuning.points_per_side), ((300, 500), 8)):
        image, truth = scene(*size)
        with overridden(SamTuning, points_per_side=side):
            found = segmenter.segment(image)
        assert found.dtype == np.uint16 and found.shape == truth.shape and found.max() == 4
        assert least_iou(found, truth) > 0.95


def segments(path: Path, image: np.ndarray, side: int = 8, **settings: Any) -> np.ndarray:
    """With fewer points than usual, for speed."""
    with overridden(SamTuning, points_per_side=side):
        return open_segmenter(path, OnnxSegmenterSettings(**settings)).segment(image)


@pytest.mark.long("exports and segments six times")
def test_masks_are_filtered(tmp_path: Path) -> None:
    """By their scores, by their stability, and those for several points are not taken: each of them would cover the
    whole picture. A point finds what it is in."""
    export_pair(tmp_path, "meta")
    image, truth = scene()
    assert least_iou(segments(tmp_path, image), truth) > 0.95
    assert not segments(tmp_path, image, mask_quality=0.96).any()
    one = segments(tmp_path, image, side=1)
    assert np.array_equal(np.unique(one), [0, 1]) and ((one == 1) == (truth == 1)).mean() > 0.98
    assert segments(tmp_path, image, max_masks=1).max() == 1
    with overridden(SamTuning, min_stability=0):
        assert segments(tmp_path, image, side=2, mask_quality=0.96).any()


def test_pixels_can_be_told(tmp_path: Path) -> None:
    """An encoder that is given other values than it was made for finds other colours, which are none of the picture."""
    export_pair(tmp_path, "meta")
    image, truth = scene()
    assert not segments(tmp_path, image, pixels="unit").any()
    assert least_iou(segments(tmp_path, image, pixels="imagenet"), truth) > 0.95


def test_decoders_without_the_point_that_is_none(tmp_path: Path) -> None:
    """The test's own nets tell whether it was given."""
    export_encoder(tmp_path / "encoder.onnx")
    export_meta(tmp_path / "decoder.onnx", others=0)
    assert not segments(tmp_path, scene()[0]).any()


def test_a_run_learns_what_a_pair_finds(tmp_path: Path) -> None:
    """A picture on a wall, 2 m away."""
    export_pair(tmp_path, "sam2")
    color, truth = scene(160, 120)
    depth = np.full(truth.shape, 2, np.float32)
    frames = [Frame(i, i, i / 30, color, depth, Camera(160, 120, 150, 150, 79.5, 59.5)) for i in range(8)]
    slam = Slam(frames[0].camera, load_config(None, [f"masks.model={tmp_path}", "mapping.iterations_per_frame=2"]))
    for frame in frames:
        slam.step(frame)
    result = slam.finish()
    assert result.objects is not None and result.objects.supervision == "model"
    ids, places = result.gaussians.object_id.numpy(), result.gaussians.means.numpy()
    x, y = (np.rint(150 * places[:, i] / places[:, 2] + c).astype(int) for i, c in ((0, 79.5), (1, 59.5)))
    true = truth[y.clip(0, 119), x.clip(0, 159)]
    assert len(set(ids.tolist()) - {0}) == 4
    assert sum(np.bincount(ids[true == i]).max() for i in range(1, 5)) > 0.9 * len(ids)


@pytest.mark.parametrize(
    ("given", "files", "expected"),
    [
        ("", ["encoder.onnx", "decoder.onnx"], ("encoder.onnx", "decoder.onnx")),
        ("a.Encoder.onnx", ["a.Encoder.onnx", "a.decoder.onnx", "b_decoder.onnx"],
         ("a.Encoder.onnx", "a.decoder.onnx")),
        ("sam_encoder.onnx", ["sam_encoder.onnx", "other_Decoder.onnx"], ("sam_encoder.onnx", "other_Decoder.onnx")),
        ("", ["vision_encoder.onnx", "prompt_encoder_mask_decoder.onnx"],
         ("vision_encoder.onnx", "prompt_encoder_mask_decoder.onnx")),
        ("a_decoder.onnx", ["a_encoder.onnx", "a_decoder.onnx", "b_encoder.onnx"],
         ("a_encoder.onnx", "a_decoder.onnx")),
        ("encoder.onnx", ["encoder.onnx"], None),
        ("encoder.onnx", ["encoder.onnx", "a_decoder.onnx", "b_decoder.onnx"], None),
        ("yolo.onnx", ["yolo.onnx", "encoder.onnx", "decoder.onnx"], None),
        ("missing.onnx", ["encoder.onnx", "decoder.onnx"], None),
    ],
)  # fmt: skip
def test_files_are_paired_by_name(
    tmp_path: Path, given: str, files: list[str], expected: tuple[str, str] | None
) -> None:
    for name in files:
        (tmp_path / name).touch()
    assert find_pair(tmp_path / given) == (expected and tuple(tmp_path / name for name in expected))


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ([], "expected one .*encoder.* found neither$"),
        (["encoder.onnx"], r"found encoder\.onnx$"),
        (["a_encoder.onnx", "b_encoder.onnx", "decoder.onnx"], "a_encoder.*, decoder.onnx; name the encoder's file$"),
    ],
)
def test_folders_that_are_no_pair(tmp_path: Path, files: list[str], said: str) -> None:
    for name in files:
        (tmp_path / name).touch()
    refuse(tmp_path, said)


def refuse(path: Path, said: str) -> None:
    """Refused in one line that says so."""
    with pytest.raises(ConfigError, match=said) as caught:
        open_segmenter(path, OnnxSegmenterSettings()).segment(scene(64, 48)[0])
    assert "\n" not in str(caught.value)


def test_halves_alone_are_refused(tmp_path: Path) -> None:
    encoder = export_encoder(tmp_path / "encoder.onnx")
    refuse(encoder, r"encoder\.onnx: a SAM encoder alone; expected its decoder beside it")
    encoder.unlink()
    refuse(export_meta(tmp_path / "decoder.onnx"), r"decoder\.onnx: a SAM decoder alone; expected its encoder beside")


def test_pairs_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    """A decoder that takes something else, or of another model."""
    encoder = export_encoder(tmp_path / "encoder.onnx")
    decoder = export_sam2(tmp_path / "decoder.onnx")
    refuse(encoder, r"decoder\.onnx: takes high_res_feats_0 .*\[1, 32, 256, 256\], which .*encoder\.onnx does not ")
    small = {"image_embeddings": torch.rand(1, 128, 64, 64), "point_coords": torch.rand(1, 2, 2)}
    export(decoder, Small(), small, ["masks", "iou_predictions"], {})
    refuse(encoder, r"takes image_embeddings .*\[1, 128, 64, 64\].* it gives image_embeddings .*\[1, 256, 64, 64\]$")
    boxes = {"image_embeddings": torch.rand(1, 256, 64, 64), "boxes": torch.rand(1, 4)}
    export(decoder, Small(), boxes, ["masks", "iou_predictions"], {})
    refuse(encoder, r"decoder\.onnx: takes boxes tensor\(float\) \[1, 4\], which .*encoder\.onnx does not give")
    alone = {"image_embeddings": torch.rand(1, 256, 64, 64), "point_labels": torch.rand(1, 4)}
    export(decoder, Small(), alone, ["masks", "iou_predictions"], {})
    refuse(encoder, r"decoder\.onnx: not a SAM decoder that is understood\. Expected .* point_coords .*; found inputs")
    export(decoder, Small(), {**small, "image_embeddings": torch.rand(1, 256, 64, 64)}, ["masks", "iou_scores"], {})
    refuse(encoder, r"decoder\.onnx: expected masks \[1, m, h, w\] and scores \[1, m\] .*, found \[1, 3\] and \[1\]")
    decoder.write_text("hello")
    refuse(encoder, r"decoder\.onnx: cannot be loaded")


class Small(torch.nn.Module):
    """Gives nothing of use."""

    def forward(self, embeddings: torch.Tensor, other: torch.Tensor) -> Any:
        total = embeddings.sum() + other.sum()
        return total.expand(1, 3), total.expand(1)
