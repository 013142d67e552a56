# SPDX-License-Identifier: Apache-2.0
"""Rows of a Gaussian map as bytes and back, bit for bit: parameters, optimizer state, votes, births, everything.

A line of JSON lists name, dtype and shape of each array; their bytes follow in that order. A cell has some twenty small
arrays, and cells come and go with every keyframe: an archive with a file for each takes ten times as long to read.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping

import numpy as np
import torch

from ggslam.errors import FormatError
from ggslam.scene.gaussian_map import GaussianMap

Rows = Mapping[str, torch.Tensor]
"""What `GaussianMap.take` gives."""
_DTYPES = {np.dtype(name).str for name in ("float32", "float64", "int16", "int32", "int64", "uint8", "bool")}


def encode_rows(rows: Rows) -> bytes:
    """Content of a part of a cell."""
    arrays = {name: np.ascontiguousarray(values.numpy()) for name, values in rows.items()}
    listed = [[name, array.dtype.str, array.shape] for name, array in arrays.items()]
    return b"".join([json.dumps(listed).encode(), b"\n", *(array.tobytes() for array in arrays.values())])


def decode_rows(data: bytes, source: str) -> dict[str, torch.Tensor]:
    """The rows that `encode_rows` was given.

    Raises:
        FormatError: damaged; names `source`.
    """
    try:
        begin = end = data.index(b"\n") + 1
        rows: dict[str, torch.Tensor] = {}
        for name, code, shape in json.loads(data[:begin]):
            if code not in _DTYPES:  # numpy would parse it as a program
                raise ValueError(f"{name}: {str(code)[:20]!r} is no type of numbers of a Gaussian")
            dtype, count = np.dtype(code), math.prod(shape)
            rows[name] = torch.from_numpy(np.frombuffer(data, dtype, count, end).reshape(shape).copy())
            end += dtype.itemsize * count
        if end != len(data):
            raise ValueError(f"{len(data)} bytes, the first line says {end}")
        return rows
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise FormatError(f"{source}: no Gaussians written by ggslam: {error}") from None


def map_like(gaussians: GaussianMap, rows: Rows | None = None) -> GaussianMap:
    """A map with the channels of another one, and these rows."""
    channels = gaussians.features.shape[1]
    out = GaussianMap(
        gaussians.sh_degree, channels, with_moments=gaussians.with_moments, growth=0.0,
        compact_features=gaussians.compact_features,
    )  # fmt: skip
    if rows is not None and len(rows["means"]):
        out.append(rows)
    return out


def join(parts: list[Rows]) -> Rows:
    """Rows one after the other."""
    return parts[0] if len(parts) == 1 else {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
