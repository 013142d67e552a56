# SPDX-License-Identifier: Apache-2.0
"""Networks in ONNX files, run by onnxruntime, and images as they take them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from ggslam.errors import ConfigError, MissingDependency
from ggslam.system.untrusted_files import open_untrusted

Pixels = Literal["auto", "unit", "imagenet", "bytes"]
IMAGENET_MEAN = np.array((0.485, 0.456, 0.406), np.float32)
IMAGENET_DEVIATION = np.array((0.229, 0.224, 0.225), np.float32)
IMAGE_TYPES: Final[Mapping[str, Any]] = {
    "tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8,
}  # fmt: skip
"""Types of inputs that images are given to."""
NUMBER_TYPES: Final[Mapping[str, Any]] = {
    "tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(int32)": np.int32, "tensor(int64)": np.int64,
}  # fmt: skip
"""Types of inputs that numbers are given to."""


class OnnxSession:
    """A network.

    Attributes:
        path: of its file.
        inputs, outputs: what it takes and gives: each has a name, a type and a shape, whose entries are numbers, or
            names where any number fits.
    """

    def __init__(self, path: Path, threads: int) -> None:
        """Loads it.

        Raises:
            MissingDependency: onnxruntime is not installed.
            ConfigError: no such file, or no ONNX model.
        """
        self.path = path
        self._session = _open_session(path, threads)
        self.inputs: list[Any] = list(self._session.get_inputs())
        self.outputs: list[Any] = list(self._session.get_outputs())

    def run(self, outputs: Sequence[str], values: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """Outputs by name, of inputs by name.

        Raises:
            ConfigError: the network fails.
        """
        try:
            results: list[np.ndarray] = self._session.run(list(outputs), dict(values))
            return results
        except MemoryError:
            raise
        except Exception as error:  # onnxruntime has no common class of errors
            shapes = ", ".join(str(value.shape) for value in values.values())
            raise ConfigError(f"{self.path}: the model failed on an input {shapes}: {_one_line(error)}") from None

    def __str__(self) -> str:
        return f"inputs {words_of(self.inputs)}; outputs {words_of(self.outputs)}"


def words_of(values: Sequence[Any]) -> str:
    """Name, type and shape of inputs or outputs."""
    return ", ".join(f"{value.name} {value.type} {value.shape}" for value in values)


def image_values(image: np.ndarray, dtype: Any, pixels: Pixels) -> np.ndarray:
    """An image uint8 [h, w, 3] as a network of this type of input wants it, [h, w, 3]."""
    if dtype is np.uint8:
        return image
    values = image.astype(np.float32)
    if pixels != "bytes":
        values /= 255
    if pixels == "imagenet":
        values = (values - IMAGENET_MEAN) / IMAGENET_DEVIATION
    return values.astype(dtype)


def _open_session(path: Path, threads: int) -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise MissingDependency(
            f"to segment with {path} the package onnxruntime is needed: `pip install 'ggslam[masks]'` ({error})"
        ) from None
    open_untrusted(path, ConfigError).close()
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = threads
    # Threads that wait for work must not take the processors from tracking and mapping.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except MemoryError:
        raise
    except Exception as error:  # onnxruntime has no common class of errors
        raise ConfigError(f"{path}: cannot be loaded as an ONNX model: {_one_line(error)}") from None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
