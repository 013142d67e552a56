# SPDX-License-Identifier: Apache-2.0
"""`encode_cloud`: a cloud as a G-PCC stream (ISO/IEC 23090-9, first edition), coded in parallel slices."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from ggslam.coding.attribute_values import CodedAttribute, plan_attributes
from ggslam.coding.cloud import CodingReport, EncodedCloud, PointCloud
from ggslam.coding.container import UnitType, unit_bytes
from ggslam.coding.geometry_tools import GeometrySample, geometry_parameters
from ggslam.coding.parallel_slices import in_order
from ggslam.coding.position_quantiser import PositionQuantiser
from ggslam.coding.quantization import Quantization, choose_quantization
from ggslam.coding.sequence_parameters import SequenceParameters
from ggslam.coding.settings import CodecSettings
from ggslam.coding.slice_encoder import CloudToCode, CodedSlice, encode_slice
from ggslam.coding.slices import assign_slices
from ggslam.coding.user_data import write_user_data
from ggslam.errors import ConfigError, FormatError


def encode_cloud(
    points: np.ndarray,
    attributes: Mapping[str, np.ndarray] | None = None,
    settings: CodecSettings | None = None,
    *,
    reconstruct: bool = False,
) -> EncodedCloud:
    """Codes a cloud. The same input gives the same bytes, whatever the number of threads.

    Args:
        points: [N, 3], float (metres) or integer (voxels).
        attributes: by name, whole numbers [N, 3] or [N]. "object_id" comes back exactly; others are coded with the
            quantiser parameter of the settings, unless `AttributeSettings(lossless=True)` says that they are ids.
        settings: every choice; None: the defaults.
        reconstruct: also return what a decoder makes of the stream.

    Raises:
        ConfigError: settings or arrays that do not fit together.
        FormatError: no points, or positions that are no numbers.
    """
    start = time.perf_counter()
    settings = settings or CodecSettings()
    points = checked_points(points)
    arrays = {name: np.asarray(values) for name, values in (attributes or {}).items()}
    plans = plan_attributes(arrays, len(points), settings)
    quantization = choose_quantization(
        points, settings.voxel_size, settings.geometry_bits, settings.geometry_scale, settings.box, settings.unit,
        settings.shift,
    )  # fmt: skip
    assert quantization.size is not None
    quantiser = PositionQuantiser(settings.geometry_qp)
    sample = GeometrySample(len(points), quantization.size, quantiser)
    sample.add(quantization.of(points))
    numbers = assign_slices(points, quantization, settings)
    sequence = sequence_parameters(quantization, [plan for plan, _ in plans], quantiser)
    geometry = geometry_parameters(settings, sample)
    cloud = CloudToCode(points, arrays, numbers, plans, sequence, geometry, quantization, settings, reconstruct)
    count = 1 if numbers is None else int(numbers.max()) + 1
    slices = list(in_order(lambda number: encode_slice(cloud, number), count, settings.threads))
    data = parameter_units(cloud, count) + b"".join(coded.data for coded in slices)
    report = CodingReport(
        len(points), sum(coded.report.points for coded in slices), len(data),
        tuple(coded.report for coded in slices), time.perf_counter() - start,
    )  # fmt: skip
    return EncodedCloud(data, report, _reconstruction(cloud, slices) if reconstruct else None)


def checked_points(points: np.ndarray) -> np.ndarray:
    """The points as an array; ConfigError, FormatError: see `encode_cloud`."""
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ConfigError(f"points: expected [N, 3], found {list(points.shape)}")
    if len(points) == 0:
        raise FormatError("a cloud without points cannot be coded")
    if not np.issubdtype(points.dtype, np.integer) and not np.isfinite(points).all():
        raise FormatError("the cloud has positions that are not finite numbers")
    return points


def sequence_parameters(
    quantization: Quantization, plans: list[CodedAttribute], quantiser: PositionQuantiser
) -> SequenceParameters:
    """The set that all slices share."""
    resolution, _ = quantization.resolution()
    assert quantization.size is not None
    x, y, z = (side + quantiser.reach for side in quantization.size)
    return SequenceParameters(
        tuple(plan.description for plan in plans), False, quantization.origin, 0, (x, y, z),
        resolution, quantization.metres, frame_counter_bits=1,
    )  # fmt: skip


def parameter_units(cloud: CloudToCode, slices: int) -> bytes:
    """Parameter sets, once for all slices, and the unit of what they cannot hold."""
    attribute = {parameters.attribute_id: parameters for _, parameters in cloud.plans}
    units = [unit_bytes(UnitType.SEQUENCE_PARAMETERS, cloud.sequence.write())]
    units.append(unit_bytes(UnitType.GEOMETRY_PARAMETERS, cloud.geometry.write()))
    units += [unit_bytes(UnitType.ATTRIBUTE_PARAMETERS, attribute[identity].write()) for identity in sorted(attribute)]
    content = _side_information(cloud)
    if slices > 1:
        content["slices"] = slices  # the standard does not tell where a stream of several slices was cut off
    if content:
        units.append(unit_bytes(UnitType.USER_DATA, write_user_data(content)))
    return b"".join(units)


def _side_information(cloud: CloudToCode) -> dict[str, Any]:
    content: dict[str, Any] = {}
    if not cloud.quantization.resolution()[1]:
        content["scale"] = cloud.quantization.scale / cloud.quantization.unit
    if any(cloud.quantization.shift):
        content["shift"] = list(cloud.quantization.shift)
    if any(plan.name != plan.description.label or plan.description.instance for plan, _ in cloud.plans):
        content["names"] = [plan.name for plan, _ in cloud.plans]
    tables = {
        plan.name: {
            "bits": plan.table.bits, "ids": len(plan.table.ids) if plan.table.tells_ids else plan.table.ids.tolist(),
        }
        for plan, _ in cloud.plans
        if plan.table is not None
    }
    if tables:
        content["tables"] = tables
    if cloud.settings.metadata:
        content["metadata"] = dict(cloud.settings.metadata)
    return content


def _reconstruction(cloud: CloudToCode, slices: list[CodedSlice]) -> PointCloud:
    grid = np.concatenate([coded.grid_points for coded in slices if coded.grid_points is not None])
    attributes = {
        plan.name: np.concatenate([coded.attributes[plan.name] for coded in slices if coded.attributes is not None])
        for plan, _ in cloud.plans
    }
    ids = frozenset(plan.name for plan, _ in cloud.plans if plan.table is not None)
    return PointCloud(grid, attributes, cloud.quantization, dict(cloud.settings.metadata), ids)
