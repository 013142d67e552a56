# SPDX-License-Identifier: Apache-2.0
"""A folder of colour images beside one of depth images: which belong together, by name, number or time."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.association import pair_images
from ggslam.sequences.recording import image_files, last_number
from ggslam.sequences.stamps import times_of_names
from ggslam.system.plurals import plural, quantity

OF_NAMES = "names of the images"
"""Where times come from, for reports."""
DEPTH_SUFFIXES = (".png", ".npy")


@dataclass(frozen=True)
class ImagePairs:
    """Images of frames.

    Attributes:
        colors, depths: one each a frame; a depth image may be missing where names or numbers pair them.
        times: float64 [n], seconds, by the names of the colour images; None: they are no times.
        delays: float64 [n], seconds by which depth is later, where pairs are by time; else None.
        warnings: what was left out.
    """

    colors: list[Path]
    depths: list[Path]
    times: np.ndarray | None = None
    delays: np.ndarray | None = None
    warnings: list[str] = field(default_factory=list)


def depth_images(folder: Path) -> list[Path]:
    """Depth images directly in a folder, in natural order."""
    return image_files(folder, DEPTH_SUFFIXES)


def pair_folders(place: Path, color_folder: Path, depth_folder: Path) -> ImagePairs:
    """Colour images with their depth images: of the same name; of the nearest time, where names are times of both that
    differ; else of the same number.

    Raises:
        SequenceError: a folder holds no images, or none belong together.
    """
    colors, depths = image_files(color_folder), depth_images(depth_folder)
    if not colors:
        raise SequenceError(f"{color_folder}: no images")
    if not depths:
        raise SequenceError(f"{depth_folder}: no PNG or .npy images{_other_file(depth_folder)}")
    times, depth_times = times_of_names(colors), times_of_names(depths)
    by_name = {path.stem: path for path in depths}
    if times is not None and depth_times is not None and not all(color.stem in by_name for color in colors):
        return _by_time(place, colors, times, depths, depth_times)
    found: list[Path | None] = [by_name.get(color.stem) for color in colors]
    if not any(found):
        by_number = {last_number(path.stem): path for path in depths}
        by_number.pop(None, None)
        found = [by_number.get(last_number(color.stem)) for color in colors]
    if not any(found):
        raise SequenceError(
            f"{place}: colour and depth images have neither names nor numbers in common ({colors[0].name}, "
            f"{depths[0].name})"
        )
    suffix = depths[0].suffix
    whole = [path or depth_folder / f"{color.stem}{suffix}" for path, color in zip(found, colors, strict=True)]
    return ImagePairs(colors, whole, times, None, _without_color(depth_folder, depths, whole))


def _by_time(
    place: Path, colors: list[Path], times: np.ndarray, depths: list[Path], depth_times: np.ndarray
) -> ImagePairs:
    names = (colors[0].parent.name, depths[0].parent.name)
    pairs, warnings = pair_images(place, times, depth_times, names, few=0.0)
    pairs.sort(key=lambda pair: times[pair[0]])
    first, second = [i for i, _ in pairs], [j for _, j in pairs]
    chosen = times[first]
    return ImagePairs(
        [colors[i] for i in first], [depths[j] for j in second], chosen, depth_times[second] - chosen, warnings
    )


def _without_color(folder: Path, depths: list[Path], used: list[Path]) -> list[str]:
    """A warning if there are depth images whose colour image is missing."""
    taken = set(used)
    unused = [path.name for path in depths if path not in taken]
    if not unused:
        return []
    have, are = plural(len(unused), "has", "have"), plural(len(unused), "is", "are")
    what = quantity(len(unused), "image")
    return [f"{folder}: {what} {have} no colour image and {are} left out; the first: {unused[0]}"]


def _other_file(folder: Path) -> str:
    other = next((path.name for path in sorted(folder.iterdir()) if path.is_file()), None) if folder.is_dir() else None
    return "" if other is None else f", found {other}"
