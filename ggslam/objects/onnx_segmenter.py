# SPDX-License-Identifier: Apache-2.0
"""Segments from a user's own model: a YOLO-seg or SAM-family export in ONNX, run by onnxruntime."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import ConfigError
from ggslam.objects.onnx_outputs import PROTOTYPE_GREY, Letterbox, MaskCandidates, mask_candidates, yolo_candidates
from ggslam.objects.onnx_sessions import IMAGE_TYPES, OnnxSession, Pixels, image_values
from ggslam.system.settings import setting, settings_class, tuning_class


@tuning_class(frozen=True)
class OnnxSegmenterTuning:
    """Numbers of running a segmentation model."""

    overlap: float = setting(0.7, 0, 1)
    """Of two masks with a larger intersection over union the one with the lower score is dropped."""
    min_area: float = setting(5e-4, 0, 1)
    """Segments below this share of the image are dropped."""
    max_masks: int = setting(300, 1, 65535)
    """Masks of the highest scores that are used."""
    threads: int = setting(0, 0, 1024)
    """Threads of the model; 0: chosen by onnxruntime."""


@settings_class(frozen=True)
class OnnxSegmenterSettings(OnnxSegmenterTuning):
    """How a segmentation model is run and which of its masks are used."""

    detection_score: float = setting(0.25, 0, 1)
    """Least class score of a detection (YOLO family)."""
    mask_quality: float = setting(0.7, 0, 1)
    """Least predicted intersection over union of a mask (SAM family)."""
    input_size: int = setting(640, 32, 8192, "px")
    """Width and height of the model's input if the model does not fix them; a SAM encoder gets 1024."""
    pixels: Pixels = "auto"
    """Input of a model that takes real numbers. unit: values from 0 to 1; imagenet: those normalised by ImageNet's mean
    and standard deviation; bytes: 0 to 255; auto: as a SAM encoder's export wants it, unit for other models."""


class OnnxSegmenter:
    """Class-agnostic segments of single images. Ids mean nothing from one image to the next.

    Understood are models with one image as input, [1, 3, H, W] in RGB, and as outputs

    - masks and their scores (names with "mask", and "score" or "iou"): exports of the SAM family with a grid of points
      inside; the image is put in the upper left corner of the input;
    - detections and prototypes (an output of rank 3 and one of rank 4): exports of the YOLO-seg family (v5, v8,
      v11, FastSAM), with or without non-maximum suppression inside; the image is put in the middle of the input.
    """

    def __init__(self, path: str | Path, settings: OnnxSegmenterSettings | None = None) -> None:
        """Loads a model.

        Raises:
            MissingDependency: onnxruntime is not installed.
            ConfigError: no such file, no ONNX model, or inputs and outputs that are not understood.
        """
        self.path, self.settings = Path(path), settings or OnnxSegmenterSettings()
        self._session = OnnxSession(self.path, self.settings.threads)
        self._input = self._find_input()
        self._outputs, self._gives_masks = self._find_outputs()
        height, width = (n if isinstance(n, int) else self.settings.input_size for n in self._input.shape[2:])
        self._size = width, height

    def segment(self, color: np.ndarray) -> np.ndarray:
        """Segments uint16 [H, W] of an image uint8 [H, W, 3] RGB: 1, 2, ... by falling area, 0 where there is none.

        Where masks overlap the smaller one is on top.

        Raises:
            ConfigError: the model fails, or its outputs are not what their names and ranks say.
        """
        height, width = color.shape[:2]
        letterbox = Letterbox.fit(width, height, self._size, centred=not self._gives_masks)
        candidates = self._candidates(self._feed(letterbox.place(color, 0 if self._gives_masks else PROTOTYPE_GREY)))
        settings = self.settings
        return candidates.segments(letterbox, width, height, settings.overlap, settings.min_area, settings.max_masks)

    def _feed(self, image: np.ndarray) -> np.ndarray:
        """The tensor [1, 3, h, w] of an image uint8 [h, w, 3], as the model wants it."""
        values = image_values(image, IMAGE_TYPES[self._input.type], self.settings.pixels)
        return np.ascontiguousarray(values.transpose(2, 0, 1)[None])

    def _candidates(self, tensor: np.ndarray) -> MaskCandidates:
        settings = self.settings
        first, second = self._session.run(self._outputs, {self._input.name: tensor})
        try:
            if self._gives_masks:
                return mask_candidates(first, second, self._size, settings.mask_quality, settings.max_masks)
            return yolo_candidates(first, second, settings.detection_score, settings.max_masks)
        except ConfigError as error:
            raise ConfigError(f"{self.path}: {error}") from None

    def _find_input(self) -> Any:
        inputs = self._session.inputs
        if len(inputs) == 1:
            shape = inputs[0].shape
            if inputs[0].type in IMAGE_TYPES and len(shape) == 4 and (shape[1] == 3 or isinstance(shape[1], str)):
                return inputs[0]
        raise self._not_understood()

    def _find_outputs(self) -> tuple[list[str], bool]:
        """Names of (masks, scores) and true, or of (detections, prototypes) and false."""
        outputs = {output.name: output.shape for output in self._session.outputs}
        masks = [name for name, shape in outputs.items() if "mask" in name.lower() and len(shape) in (3, 4)]
        scores = [name for name in outputs if name not in masks and any(w in name.lower() for w in ("score", "iou"))]
        if masks and scores:
            # Beside the masks some exports give the same ones smaller: "low_res_masks".
            return [min(masks, key=lambda name: ("low" in name.lower(), len(name))), scores[0]], True
        detections = [name for name, shape in outputs.items() if len(shape) == 3]
        prototypes = [name for name, shape in outputs.items() if len(shape) == 4]
        if len(detections) == 1 and len(prototypes) == 1:
            return [detections[0], prototypes[0]], False
        raise self._not_understood()

    def _not_understood(self) -> ConfigError:
        for half, values, other in (
            ("encoder", self._session.outputs, "decoder"), ("decoder", self._session.inputs, "encoder"),
        ):  # fmt: skip
            if any("embed" in value.name.lower() for value in values):
                return ConfigError(
                    f"{self.path}: a SAM {half} alone; expected its {other} beside it, named alike or the only "
                    f"*{other}*.onnx there; found {self._session}"
                )
        return ConfigError(
            f"{self.path}: not a segmentation model that is understood. Expected one image [1, 3, H, W] as input, and "
            f"masks with scores, or YOLO-seg detections with prototypes, as outputs; found {self._session}"
        )
