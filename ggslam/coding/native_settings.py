# SPDX-License-Identifier: Apache-2.0
"""Fills the compiled core's structures from parameter sets and headers."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import c_int32, c_uint8
from dataclasses import dataclass

from ggslam.abi.core import (
    DetailSettings,
    OctreeSettings,
    PredictiveSettings,
    RahtSettings,
    TreeSettings,
)
from ggslam.coding.attribute_syntax import LIFTING, AttributeHeader, AttributeParameters
from ggslam.coding.geometry_syntax import GeometryHeader, GeometryParameters
from ggslam.coding.sequence_parameters import AttributeDescription


@dataclass(frozen=True)
class AttributePayload:
    """One attribute of a slice, not yet decoded."""

    header: AttributeHeader
    parameters: AttributeParameters
    payload: memoryview


@dataclass(frozen=True)
class CodingContext:
    """What a stream says of all its slices.

    separate_bits: bins of equal probability are a stream of their own.
    keeps_contexts: slices may go on with the contexts of the one before.
    first_version: the first version of this codec wrote the stream.
    axes: which of the coded axes are x, y and z.
    """

    separate_bits: bool = False
    keeps_contexts: bool = False
    first_version: bool = False
    axes: tuple[int, int, int] = (0, 1, 2)


def raht_settings(
    parameters: AttributeParameters,
    components: int,
    bit_depth: int,
    deltas: tuple[int, int] = (0, 0),
    rdoq: float = 0.0,
    first_version: bool = False,
) -> RahtSettings:
    """What the attribute coder depends on, of an attribute with these components.

    Args:
        deltas: of a slice, added to the quantiser parameters.
        rdoq: `CodecSettings.rdoq`.
        first_version: the stream has the first version's square roots of large weights.
    """
    first, others = parameters.qps(bit_depth, deltas)
    return RahtSettings(
        components, bit_depth, first, others, int(parameters.prediction), *parameters.thresholds, index=-1,
        first_version=int(first_version), rdoq=rdoq,
    )  # fmt: skip


def layer_qps(coded: AttributePayload, bit_depth: int) -> tuple[int, ctypes.Array]:
    """Number of levels with quantisers of their own, and these."""
    deltas, own = coded.header.qp_deltas, coded.header.layer_deltas
    qps = [coded.parameters.qps(bit_depth, (deltas[0] + a, deltas[1] + b)) for a, b in own]
    return len(qps), _pairs(qps)


def _pairs(values: Sequence[tuple[int, int]]) -> ctypes.Array:
    pair = c_int32 * 2
    return (pair * 32)(*(pair(a, b) for a, b in values))


def detail_settings(
    coded: AttributePayload, description: AttributeDescription, context: CodingContext, index: int
) -> DetailSettings:
    details, header, depth = coded.parameters.details, coded.header, description.bit_depth
    layers, qps = layer_qps(coded, depth)
    if layers == 0:
        layers, qps = 1, _pairs([coded.parameters.qps(depth, header.qp_deltas)])
    largest = (1 << 30) - 1
    bias = [details.bias[context.axes.index(axis)] for axis in range(3)]
    return DetailSettings(
        description.components, depth, int(coded.parameters.encoding == LIFTING), details.neighbours,
        min(details.search_between, largest), (c_int32 * 3)(*bias), details.levels,
        int(details.canonical_order), details.decimation, (c_int32 * 32)(*details.periods),
        details.first_distance + header.distance_delta, details.direct_predictors, details.direct_threshold,
        int(details.no_average), min(details.search_within, largest), min(details.skip_layers, largest),
        int(details.blend), int(bool(header.component_weights)), _pairs(header.component_weights), layers, qps,
        int(context.separate_bits), index,
    )  # fmt: skip


def octree_settings(parameters: GeometryParameters, depth: int) -> OctreeSettings:
    near = parameters.neighbour_boundary > 0
    return OctreeSettings(
        depth, parameters.neighbour_boundary, int(near and parameters.adjacent_child),
        min(parameters.intra_prediction, 32) if near else 0, int(parameters.unique_points),
    )  # fmt: skip


def tree_settings(parameters: GeometryParameters, header: GeometryHeader, separate_bits: bool) -> TreeSettings:
    near = parameters.neighbour_boundary > 0
    shift = parameters.qp_shift
    axes = (c_uint8 * 64)(*header.axes)
    return TreeSettings(
        len(header.axes), parameters.neighbour_boundary, int(near and parameters.adjacent_child),
        min(parameters.intra_prediction, 32) if near else 0, int(parameters.unique_points), parameters.direct_mode,
        int(parameters.direct_pairs), parameters.direct_rate, int(parameters.planes),
        (c_int32 * 3)(*parameters.plane_thresholds), int(parameters.scaling),
        (parameters.base_qp + header.qp_offset) << shift, (parameters.base_qp + parameters.direct_qp_offset) << shift,
        shift, header.codewords, int(separate_bits), axes,
    )  # fmt: skip


def predictive_settings(
    parameters: GeometryParameters, header: GeometryHeader, separate_bits: bool
) -> PredictiveSettings:
    shift = parameters.qp_shift
    interval = 1 << min(max(parameters.qp_interval_log2 + header.qp_interval_delta, 0), 30)
    return PredictiveSettings(
        int(parameters.unique_points), int(parameters.scaling), (parameters.base_qp + header.qp_offset) << shift, shift,
        interval, (c_int32 * 3)(*header.residual_bits), int(separate_bits),
    )  # fmt: skip
