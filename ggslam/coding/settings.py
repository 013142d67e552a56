# SPDX-License-Identifier: Apache-2.0
"""Settings of the encoder. A decoder needs none of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Any, Final, Literal

import numpy as np

from ggslam.system.settings import Conflict, setting, settings_class

Split = Literal["count", "interval", "cube"]
ColorSpace = Literal["ycbcr", "identity", "none"]
Duplicates = Literal["merge", "keep"]
LEVEL_LIMIT: Final = 1_100_000
"""Points per slice that the levels of the first edition allow."""


@settings_class(frozen=True)
class AttributeSettings:
    """How one attribute is coded."""

    qp: int | None = setting(None, 4, 99)
    """Quantiser parameter: the step is 2^((qp - 4) / 6). None: that of `CodecSettings`."""
    chroma_offset: int | None = setting(None, -51, 51)
    """Added to the quantiser parameter of components 1 and 2. None: that of `CodecSettings`."""
    bit_depth: int | None = setting(None, 1, 16, "bits")
    """Bits of a value; None: 8 for uint8, else 16."""
    color_space: ColorSpace | None = None
    """ycbcr: BT.709, 8 bits; identity: components G, B, R; none: components as they are. None: ycbcr for 3 components
    of uint8, else none."""
    label: str | None = None
    """The standard's label: color, reflectance, opacity, frame_index, frame_number, material or normal. None: color
    for 3 components, reflectance for 1, which other decoders read (the reference decoder breaks at the others). The
    attribute's name travels beside it."""
    offset: int = setting(0, -(1 << 30), 1 << 30)
    """Values are `offset` + `scale` times what is coded; every decoder undoes that."""
    scale: int = setting(1, 1, 1 << 24)
    """See `offset`; above 1 values are rounded to multiples."""
    lossless: bool = False
    """Whole values of one component (ids) that come back exactly; `qp` and `bit_depth` are then not used."""

    def __post_init__(self) -> None:
        if self.lossless and (self.scale, self.offset) != (1, 0):
            raise Conflict("lossless", "goes without scale and offset")


@settings_class(frozen=True)
class CodecSettings:
    """How a cloud is coded. The defaults are lossless geometry of voxelised clouds with all tools on."""

    qp: int = setting(22, 4, 99)
    """Quantiser parameter of the attributes, 4 (nearly lossless) to 51 (99 for 16 bits); 6 more double the step."""
    chroma_offset: int = setting(0, -51, 51)
    """Added to `qp` for components 1 and 2."""
    geometry_scale: float = setting(1.0, 1e-6, 1e6)
    """Voxels per input voxel, along an axis: 0.5 codes positions at half the resolution."""
    geometry_qp: int = setting(0, 0, 96)
    """Quantiser parameter of the positions within the octree: steps of 2^(qp / 8) (8 + qp % 8) / 8 of a voxel, whole
    divisions (1 at 0, 2 at 8, 4 at 16), from each slice's lowest corner; decoded points stay on the grid."""
    voxel_size: float | None = setting(None, 1e-12, 1e12, "m")
    """Edge of an input voxel; None: 1 for integer positions, else from `geometry_bits`."""
    unit: float | None = setting(None, 1e-12, 1e12, "m")
    """Length of a step of integer positions; None: they are no lengths. The stream tells it."""
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where integer position 0 stands, metres (with `unit`)."""
    geometry_bits: int = setting(10, 1, 21, "bits")
    """Bits of the longest side of a cloud whose positions are no whole numbers, if `voxel_size` is None."""
    box: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    """Lowest and highest corner, metres: points outside are moved to its faces. None: the cloud's own box."""
    duplicates: Duplicates = "merge"
    """Points in one voxel: merge makes them one, with mean attributes (ids: the most frequent); keep codes them all."""
    slices: int = setting(1, 1, 65536)
    """Slices to cut the cloud into; more, if one would have more than `max_points`."""
    split: Split = "count"
    """count: equal numbers of points along the longest axis; interval: equal lengths of it; cube: octree cubes."""
    max_points: int = setting(LEVEL_LIMIT, 1, LEVEL_LIMIT)
    """Points of a slice at most."""
    threads: int | None = setting(None, 1, 1024)
    """Threads that code slices; None: one for each processor. The stream does not depend on it."""
    neighbour_boundary: Literal[0, 2, 3, 4, 5, 6, 7, 8] | None = None
    """Neighbours give contexts within cubes of 2^this nodes, 2 to 8; 0: siblings only (fast, for sparse clouds);
    None: 8 if a slice is dense enough for neighbours to tell something, else 0."""
    adjacent_child: bool = True
    """Contexts from the children of coded neighbours."""
    intra_prediction_size: int = setting(6, 0, 21)
    """Nodes with an edge below 2^this are predicted from their 26 neighbours; 0: none."""
    planes: bool | None = None
    """The planar mode and levels that split the longest axes only, for sparse clouds (LiDAR, aerial); several times as
    slow. None: where they make the geometry of a sample at least 3 % smaller."""
    raht_prediction: bool = True
    """Attributes are predicted from the octree level above."""
    rdoq: float = setting(1.0, 0, 100)
    """Rate-distortion optimised quantisation: weight of a bit against the squared error when the encoder drops
    coefficients, 1 as the reference encoder has it; 0: it drops none."""
    attributes: Mapping[str, AttributeSettings] = field(default_factory=dict)
    """Settings of single attributes, by name."""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """Whatever the caller wants to find in `PointCloud.metadata` again (JSON values)."""

    def __post_init__(self) -> None:
        if self.box is not None:
            corners = np.asarray(self.box, np.float64)
            if corners.shape != (2, 3) or not np.isfinite(corners).all() or not (corners[0] <= corners[1]).all():
                raise Conflict("box", f"expected a lowest and a highest corner, found {self.box!r}")
        if not np.isfinite(self.shift).all():
            raise Conflict("shift", f"expected finite numbers, found {self.shift!r}")

    def attribute(self, name: str) -> AttributeSettings:
        """Settings of one attribute. Object ids are lossless if nothing else is said."""
        return self.attributes.get(name, AttributeSettings(lossless=name == "object_id"))
