# SPDX-License-Identifier: Apache-2.0
"""Object ids of the pixels of a rendered view of a segmented map."""

from __future__ import annotations

import numpy as np

from ggslam.objects.segmented_map import SegmentedMap
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.labels import label_image, vote_label_image
from ggslam.rendering.types import RenderBuffers


def object_ids(rasterizer: CpuRasterizer, view: RenderBuffers, segmented: SegmentedMap) -> np.ndarray:
    """Object ids uint16 [H, W] of the view that was rendered last: by the classifier, or where it has no classes by the
    weights of the Gaussians' own ids."""
    if len(segmented.classifier) and view.features is not None:
        return label_image(view.features, view.alpha, segmented.classifier, only_ids=True)[0]
    return vote_label_image(rasterizer, view, segmented.gaussians.object_id.numpy().astype(np.uint16))
