# SPDX-License-Identifier: Apache-2.0
"""Files that ROS's map_server reads: an image of cells, and a yaml that tells where it lies.

The map's frame is that of the cells' plane: x and y along its axes, in metres from its origin. The image's upper row
has the largest y; the yaml's `origin` is the lower left corner of the lower left pixel. A pixel x stands for p =
(255 - x) / 255. In the mode trinary a cell is occupied above `occupied_thresh`, free below `free_thresh` and else
unknown; in the mode scale what is between is 0 to 100 in proportion, and transparent pixels are unknown.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import cv2
import numpy as np

from ggslam.driving.bands import BandMap
from ggslam.driving.inflation import LETHAL_COST, UNKNOWN_COST
from ggslam.system.atomic import write_bytes, write_text
from ggslam.volumes.cell_grid import SlicePlane

OCCUPIED: Final = 0
"""Grey of an occupied cell in a trinary map."""
FREE: Final = 254
"""Grey of a free cell there."""
UNKNOWN: Final = 205
"""Grey of an unknown cell there: p = 0.19608, just above `free_thresh`."""
_TRINARY: Final = ("trinary", 0.65, 0.196)
_SCALE: Final = ("scale", 0.995, 0.005)
"""Mode, `occupied_thresh` and `free_thresh`."""


def trinary_pixels(band: BandMap) -> np.ndarray:
    """A band as a ROS map: uint8 [H, W], 0 occupied, 254 free, 205 unknown."""
    return np.where(band.occupied, OCCUPIED, np.where(band.free, FREE, UNKNOWN)).astype(np.uint8)


def occupancy_of_cost(cost: np.ndarray) -> np.ndarray:
    """Costs uint8 [H, W] as values of a nav_msgs/OccupancyGrid, int8: 0 to 100, -1 unknown. nav2's static layer
    (`trinary_costmap: false`) makes of them int(2.54 value): costs come back within 3, lethal ones exactly."""
    value = np.clip(np.rint(cost / (LETHAL_COST / 100)), np.where(cost > 0, 1, 0), 99)
    return np.where(cost == UNKNOWN_COST, -1, np.where(cost == LETHAL_COST, 100, value)).astype(np.int8)


def scale_pixels(values: np.ndarray) -> np.ndarray:
    """Values of an occupancy grid [H, W], -1 to 100, as an image of the mode scale: uint8 [H, W, 4], RGBA. map_server
    reads each value back as it is: 255 greys are more than two for each."""
    _, most, least = _SCALE
    p = np.where(values == 0, 0.0, np.where(values == 100, 1.0, least + values / 100 * (most - least)))
    known = values >= 0
    grey = np.where(known, np.rint(255 * (1 - p)), 128).astype(np.uint8)
    return np.dstack([grey, grey, grey, np.where(known, 255, 0).astype(np.uint8)])


def write_map(band: BandMap, path: str | Path) -> tuple[Path, Path]:
    """Writes a map of the mode trinary: `path` with the endings .pgm (binary) and .yaml.

    Returns:
        The two files.

    Raises:
        RunFolderError: a file cannot be written.
    """
    pixels = trinary_pixels(band)
    image = _beside(path, ".pgm")
    write_bytes(image, f"P5\n{pixels.shape[1]} {pixels.shape[0]}\n255\n".encode() + pixels.tobytes())
    return image, _describe(path, image, band.plane, band.resolution, *_TRINARY)


def write_costmap(band: BandMap, cost: np.ndarray, path: str | Path) -> tuple[Path, Path]:
    """Writes costs uint8 [H, W] of a band as a map of the mode scale: `path` with the endings .png and .yaml.

    Returns:
        The two files.

    Raises:
        RunFolderError: a file cannot be written.
    """
    rgba = scale_pixels(occupancy_of_cost(cost))
    image = _beside(path, ".png")
    write_bytes(image, cv2.imencode(".png", rgba[..., [2, 1, 0, 3]])[1].tobytes())
    return image, _describe(path, image, band.plane, band.resolution, *_SCALE)


def _beside(path: str | Path, ending: str) -> Path:
    return Path(path).with_name(Path(path).name + ending)


def _describe(
    path: str | Path, image: Path, plane: SlicePlane, resolution: float, mode: str, occupied: float, free: float
) -> Path:
    x, y = plane.low
    description = _beside(path, ".yaml")
    write_text(
        description,
        f"image: {image.name}\nmode: {mode}\nresolution: {resolution:.6g}\norigin: [{x:.6f}, {y:.6f}, 0.0]\n"
        f"negate: 0\noccupied_thresh: {occupied:g}\nfree_thresh: {free:g}\n",
    )
    return description
