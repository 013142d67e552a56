# SPDX-License-Identifier: Apache-2.0
"""Rows of a Gaussian map as bytes and back, bit for bit: parameters, optimizer state, votes, births, everything."""

from __future__ import annotations

import io
from collections.abc import Mapping

import torch

from ggslam.scene.arrays import arrays_of, arrays_to_bytes
from ggslam.scene.gaussian_map import GaussianMap

Rows = Mapping[str, torch.Tensor]
"""What `GaussianMap.take` gives."""


def encode_rows(rows: Rows) -> bytes:
    """Content of a part of a cell (NumPy's .npz)."""
    return arrays_to_bytes(**{name: values.numpy() for name, values in rows.items()})


def decode_rows(data: bytes, source: str) -> dict[str, torch.Tensor]:
    """The rows that `encode_rows` was given.

    Raises:
        FormatError: damaged; names `source`.
    """
    what = f"{source}: no Gaussians written by ggslam"
    arrays = arrays_of(io.BytesIO(data), what, lambda held: {name: held[name] for name in held.files})
    return {name: torch.from_numpy(values) for name, values in arrays.items()}


def map_like(gaussians: GaussianMap, rows: Rows | None = None) -> GaussianMap:
    """A map with the channels of another one, and these rows."""
    channels = gaussians.features.shape[1]
    out = GaussianMap(gaussians.sh_degree, channels, with_moments=gaussians.with_moments, growth=0.0)
    if rows is not None and len(rows["means"]):
        out.append(rows)
    return out


def join(parts: list[Rows]) -> Rows:
    """Rows one after the other."""
    return parts[0] if len(parts) == 1 else {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
