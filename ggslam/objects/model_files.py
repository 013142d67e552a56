# SPDX-License-Identifier: Apache-2.0
"""Which files a segmentation model is made of: one, or an encoder and its decoder."""

from __future__ import annotations

from pathlib import Path

from ggslam.errors import ConfigError
from ggslam.objects.onnx_segmenter import OnnxSegmenter, OnnxSegmenterSettings
from ggslam.objects.sam_segmenter import SamSegmenter
from ggslam.system.untrusted_files import given_path

_NAMES = (
    ("encoder", "decoder"), ("image_encoder", "mask_decoder"), ("vision_encoder", "prompt_encoder_mask_decoder"),
)  # fmt: skip
"""Parts of the names of an encoder's file and of its decoder's, as usual exports have them."""


def open_segmenter(path: str | Path, settings: OnnxSegmenterSettings) -> OnnxSegmenter | SamSegmenter:
    """A segmentation model.

    Args:
        path: its file; of a SAM encoder and decoder the encoder's file, or the folder of both.
        settings: how it is run.

    Raises:
        MissingDependency: onnxruntime is not installed.
        ConfigError: no such file, no ONNX model, or one that is not understood.
    """
    file = given_path(path, ConfigError)
    pair = find_pair(file)
    return OnnxSegmenter(file, settings) if pair is None else SamSegmenter(*pair, settings)


def find_pair(path: Path) -> tuple[Path, Path] | None:
    """An encoder's file and its decoder's, of a folder that holds both or of one of the two; None: not of such a pair.

    Raises:
        ConfigError: a folder without one of both, or with several.
    """
    if path.is_dir():
        encoders, decoders = _halves(path)
        if len(encoders) == 1 and len(decoders) == 1:
            return encoders[0], decoders[0]
        raise ConfigError(
            f"{path}: expected one *encoder*.onnx and one *decoder*.onnx, found "
            f"{', '.join(p.name for p in encoders + decoders) or 'neither'}{_advice(encoders)}"
        )
    if path.suffix != ".onnx" or not path.is_file():
        return None
    encoders, decoders = _halves(path.parent)
    if path in encoders:
        found = [decoder for decoder in decoders if _are_alike(path, decoder)] or decoders
        return (path, found[0]) if len(found) == 1 else None
    if path in decoders:
        found = [encoder for encoder in encoders if _are_alike(encoder, path)] or encoders
        return (found[0], path) if len(found) == 1 else None
    return None


def _are_alike(encoder: Path, decoder: Path) -> bool:
    return decoder.name.lower() in {encoder.name.lower().replace(half, other) for half, other in _NAMES}


def _halves(folder: Path) -> tuple[list[Path], list[Path]]:
    """Files of encoders and of decoders. "prompt_encoder_mask_decoder" is a decoder."""
    files = sorted(folder.glob("*.onnx"))
    decoders = [path for path in files if "decoder" in path.name.lower()]
    return [path for path in files if "encoder" in path.name.lower() and path not in decoders], decoders


def _advice(encoders: list[Path]) -> str:
    return "; name the encoder's file" if len(encoders) > 1 else ""
