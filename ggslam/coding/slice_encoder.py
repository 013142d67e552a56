# SPDX-License-Identifier: Apache-2.0
"""Codes one slice: its geometry unit, its attribute units and its side information."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ggslam.coding.attribute_syntax import AttributeHeader, AttributeParameters
from ggslam.coding.attribute_values import CodedAttribute
from ggslam.coding.cloud import SliceReport
from ggslam.coding.container import UnitType, unit_bytes
from ggslam.coding.geometry_syntax import GeometryHeader, GeometryParameters
from ggslam.coding.geometry_tools import levels_of, tree_sides
from ggslam.coding.native_settings import raht_settings
from ggslam.coding.position_quantiser import PositionQuantiser
from ggslam.coding.quantization import Quantization
from ggslam.coding.sequence_parameters import SequenceParameters
from ggslam.coding.settings import CodecSettings
from ggslam.coding.slice_coder import MAX_SLICE_POINTS, SliceCoder
from ggslam.coding.user_data import write_user_data
from ggslam.errors import ConfigError


@dataclass(frozen=True)
class CloudToCode:
    """What all slices share. Arrays are read, never changed."""

    points: np.ndarray
    attributes: Mapping[str, np.ndarray]
    slice_numbers: np.ndarray | None
    plans: list[tuple[CodedAttribute, AttributeParameters]]
    sequence: SequenceParameters
    geometry: GeometryParameters
    quantization: Quantization
    settings: CodecSettings
    reconstruct: bool


@dataclass(frozen=True)
class CodedSlice:
    """Units of a slice and what they hold. Reconstruction only if it was asked for."""

    data: bytes
    report: SliceReport
    grid_points: np.ndarray | None
    attributes: dict[str, np.ndarray] | None


def encode_slice(cloud: CloudToCode, number: int) -> CodedSlice:
    """Codes the points of slice `number`."""
    start = time.perf_counter()
    settings = cloud.settings
    rows = None if cloud.slice_numbers is None else np.flatnonzero(cloud.slice_numbers == number)
    seen = cloud.quantization.of(cloud.points)
    grid = seen.positions(rows)
    origin = np.array([grid[:, axis].min() for axis in range(3)], np.int32)
    geometry, quantiser = cloud.geometry, PositionQuantiser(settings.geometry_qp)
    if quantiser.qp:
        grid = quantiser.steps(seen.places(grid, rows) - origin)
    else:
        for axis in range(3):
            grid[:, axis] -= origin[axis]
    sides = tree_sides(geometry, quantiser.bits([int(grid[:, axis].max()) for axis in range(3)]))
    axes, grid = levels_of(geometry, sides), quantiser.restore(grid, sides)
    header = GeometryHeader(number, (int(origin[0]), int(origin[1]), int(origin[2])), axes, len(grid))
    depth = header.depth
    coder = SliceCoder()
    order = coder.build(grid, depth)
    counts = None
    if coder.leaves < coder.points and settings.duplicates == "merge":
        counts = coder.leaf_points()
        coder.merge()
    if coder.points > MAX_SLICE_POINTS:
        raise ConfigError(f"{coder.points} points lie in one voxel: merge duplicates or choose smaller voxels")
    header = replace(header, points=coder.points)
    payload = header.write(cloud.sequence, geometry) + coder.encode_geometry(geometry, axes) + header.footer()
    units = [unit_bytes(UnitType.GEOMETRY, payload)]
    if rows is not None:
        order = np.take(rows.astype(np.uint32), order)
    sizes, reconstructed, corrections = _encode_attributes(cloud, number, coder, order, counts, units)
    attribute_end = sum(map(len, units))
    if corrections:
        content = write_user_data({"slice": number, "corrections": corrections})
        units.append(unit_bytes(UnitType.USER_DATA, content))
    positions = None
    if cloud.reconstruct:
        positions = coder.positions() + origin
    data = b"".join(units)
    report = SliceReport(
        number, coder.points, len(units[0]), sizes, len(data) - attribute_end, time.perf_counter() - start
    )
    return CodedSlice(data, report, positions, reconstructed if cloud.reconstruct else None)


def _encode_attributes(
    cloud: CloudToCode,
    number: int,
    coder: SliceCoder,
    order: np.ndarray,
    counts: np.ndarray | None,
    units: list[bytes],
) -> tuple[dict[str, int], dict[str, np.ndarray], dict[str, Any]]:
    """Appends a unit for each attribute; returns sizes, values that a decoder will see, and corrections of ids."""
    sizes, reconstructed, corrections = {}, {}, {}
    for plan, parameters in cloud.plans:
        values = cloud.attributes[plan.name]
        if counts is None:
            components = plan.components(values, order)
        else:
            components = plan.merged_components(values, order, counts)
        original = components.copy() if plan.table is not None else components
        description = plan.description
        settings = raht_settings(
            parameters, description.components, description.bit_depth, rdoq=0.0 if plan.table else cloud.settings.rdoq
        )
        payload = coder.encode_attribute(settings, components)
        header = AttributeHeader(number, plan.index, parameters.attribute_id)
        units.append(unit_bytes(UnitType.ATTRIBUTE, header.write(parameters) + payload))
        sizes[plan.name] = len(units[-1])
        wrong = plan.corrections(original, components)
        if wrong is not None:
            corrections[plan.name] = wrong
        if cloud.reconstruct:
            reconstructed[plan.name] = plan.values(components, wrong)
    return sizes, reconstructed, corrections
