# SPDX-License-Identifier: Apache-2.0
"""The splats of a run as a page reads them."""

from __future__ import annotations

from typing import Any

import numpy as np

from ggslam.jobs.view.viewed_run import ViewedRun
from ggslam.scene.gaussian_map import SH_C0
from ggslam.viewer.packed_splats import SCALES, pack_splats
from ggslam.viewer.splats import colors_to_uint8


def packed_rows(model: ViewedRun, rows: np.ndarray) -> tuple[dict[str, Any], bytes]:
    """Header and bytes of some of a map's Gaussians; see `unpackSplats` in viewer/static/unpack.js.

    Args:
        model: the run.
        rows: int [N], rising.
    """
    g = model.gaussians()
    owners = g.object_id.numpy()[rows].astype(np.uint16)
    colors = colors_to_uint8(0.5 + SH_C0 * g.sh.numpy()[rows, 0])
    identity = model.identity_colors(rows)
    seen = model.viewed_sides(rows)
    packed, low, high = pack_splats(g, rows, colors, owners, identity, seen)
    header = {"count": len(rows), "low": low, "high": high, "scales": SCALES, "identity": identity is not None}
    header["seen"] = seen is not None
    return header, packed
