# SPDX-License-Identifier: Apache-2.0
"""Record3D's .r3d: a zip archive with `metadata` (JSON), rgbd/0.jpg, rgbd/0.depth, rgbd/0.conf.

Depth are float32 metres and confidence uint8 (0 low to 2 high), row by row, each compressed with LZFSE. `K` is written
column by column and belongs to the size w x h; perFrameIntrinsicCoeffs are fx fy cx cy of each frame. `poses` are qx qy
qz qw tx ty tz, camera to world with ARKit's camera axes (y up, z backwards). `dw` and `dh` are the size of depth; until
2022 the app wrote h, w, fps, K and poses alone, so the size is told by how many numbers an image of depth holds, and by
the shape of the colour image, which it shares.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import MissingDependency, SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences.archive import Archive, ArchiveImage
from ggslam.sequences.images import decode_color
from ggslam.sequences.json_files import OPENCV_FROM_OPENGL, camera_of, number_of, numbers_of, parse_object
from ggslam.sequences.lzfse_blocks import END, claimed_bytes
from ggslam.sequences.pose_files import pose_of_numbers, poses_of_frames
from ggslam.sequences.recording import (
    NO_OPTIONS,
    FrameFiles,
    ReadOptions,
    Recording,
    RecordingTuning,
    natural_key,
    nominal_timestamps,
)
from ggslam.system.images import find_damage
from ggslam.system.tuning import Tuning


class Record3dTuning(Tuning):
    """A limit on damaged files."""

    max_image_bytes = 64_000_000
    """Largest decompressed image, in bytes."""


class Record3DFormat:
    """Reads images straight from the archive; unpacks nothing to disk."""

    name = "record3d"
    layout = "one file .r3d of the app Record3D"

    def matches(self, path: Path) -> bool:
        return path.suffix.lower() == ".r3d" and path.is_file()

    def read(self, path: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        archive = Archive(path)
        place = f"{path}, metadata"
        metadata = parse_object(place, archive.read("metadata"))
        colors = sorted((n for n in archive.names if n.startswith("rgbd/") and n.endswith(".jpg")), key=natural_key)
        if not colors:
            raise SequenceError(f"{path}: holds no rgbd/*.jpg")
        if not any(name.endswith(".depth") for name in archive.names):
            raise SequenceError(f"{path}: holds no rgbd/*.depth: a recording without depth cannot be used")
        lzfse_decompress()
        cameras = options.recorded_camera(lambda: _cameras(place, metadata, len(colors))) or [None] * len(colors)
        size = _depth_size(archive, metadata, place, colors)
        files = [_frame(archive, size, name, camera) for name, camera in zip(colors, cameras, strict=True)]
        times, source = _times(place, metadata, len(colors))
        recording = Recording(self.name, path, files, times, 1.0, cameras[0], time_source=source)
        recording.problems = {
            i: f"frame {i}: {files[i].depth} is missing"
            for i, name in enumerate(colors)
            if name.removesuffix(".jpg") + ".depth" not in archive.names
        }
        options.add_truth(recording, lambda: _add_poses(recording, place, metadata))
        return recording


def _depth_size(archive: Archive, metadata: dict[str, Any], place: str, colors: list[str]) -> tuple[int, int]:
    """(rows, columns) of the images of depth: as the metadata tells, else of the first one that can be read."""
    if "dh" in metadata or "dw" in metadata:
        return int(number_of(place, metadata, "dh")), int(number_of(place, metadata, "dw"))
    width, height = number_of(place, metadata, "w"), number_of(place, metadata, "h")
    reason = "none can be read"
    for name in (f"{color.removesuffix('.jpg')}.depth" for color in colors):
        try:
            content, image = archive.read(name), f"{archive.path}, {name}"
            count = (
                len(content if _is_plain(content) else _decompress(image, content, Record3dTuning.max_image_bytes)) // 4
            )
        except SequenceError as error:
            reason = str(error)
            continue
        rows = round((count * height / width) ** 0.5) if width > 0 and height > 0 else 0
        if not 0 < 4 * count <= Record3dTuning.max_image_bytes or rows < 1 or rows * (count // rows) != count:
            reason = (
                f"the {count} numbers of {name} do not make an image with the aspect of the colour image, "
                f"{width:g}x{height:g}"
            )
            break
        return rows, count // rows
    raise SequenceError(f"{place}: entries 'dh' and 'dw' are missing (as in recordings of 2022), and {reason}")


def _is_plain(content: bytes) -> bool:
    """Whether an image is stored as it is: LZFSE begins with the name of its first block."""
    return not content.startswith(b"bvx")


def _frame(archive: Archive, size: tuple[int, int], color: str, camera: Camera | None) -> FrameFiles:
    base = color.removesuffix(".jpg")
    confidence = f"{base}.conf"
    return FrameFiles(
        ArchiveImage(archive, color, _decode_color),
        ArchiveImage(archive, f"{base}.depth", partial(_decode_array, size=size, dtype=np.dtype(np.float32))),
        None,
        ArchiveImage(archive, confidence, partial(_decode_array, size=size, dtype=np.dtype(np.uint8)))
        if confidence in archive.names else None,
        camera,
    )  # fmt: skip


def _decode_color(place: str, content: bytes) -> np.ndarray:
    damage = find_damage(content)
    if damage:
        raise SequenceError(f"{place}: {damage}")
    return decode_color(place, content)


def _decode_array(place: str, content: bytes, *, size: tuple[int, int], dtype: np.dtype) -> np.ndarray:
    """Image [H, W] of LZFSE bytes; bytes of the full length count as not compressed."""
    expected = size[0] * size[1] * dtype.itemsize
    if not 0 < expected <= Record3dTuning.max_image_bytes:
        raise SequenceError(f"{place}: impossible size {size[1]}x{size[0]}")
    raw = content if len(content) == expected else _decompress(place, content, expected)
    if len(raw) != expected:
        raise SequenceError(f"{place}: expected {expected} bytes for {size[1]}x{size[0]} pixels, found {len(raw)}")
    return np.frombuffer(raw, dtype).reshape(size)


def lzfse_decompress() -> Any:
    """The decompressor. Raises MissingDependency without it."""
    try:
        import liblzfse
    except ImportError:
        raise MissingDependency("reading .r3d needs LZFSE: pip install 'ggslam[phone]' (or pyliblzfse)") from None
    return liblzfse.decompress


def _decompress(place: str, content: bytes, most: int) -> bytes:
    decompress = lzfse_decompress()
    # The decompressor grows its memory without end for streams that do not end, and for as much as the others hold.
    if not content.endswith(END):
        raise SequenceError(f"{place}: not an LZFSE stream, or a truncated one ({len(content)} bytes)")
    try:
        claimed = claimed_bytes(content)
        if claimed > most:
            raise ValueError(f"it holds {claimed:,} bytes, at most {most:,} are read")
        return decompress(content)
    except Exception as error:  # the package has its own type of exception; a block that lies ends in MemoryError
        raise SequenceError(f"{place}: LZFSE stream is damaged: {error}") from None


def _cameras(place: str, metadata: dict[str, Any], count: int) -> list[Camera | None]:
    width, height = number_of(place, metadata, "w"), number_of(place, metadata, "h")
    own = metadata.get("perFrameIntrinsicCoeffs")
    if isinstance(own, list) and len(own) >= count:
        values = [numbers_of(place, {"perFrameIntrinsicCoeffs": row}, "perFrameIntrinsicCoeffs", 4) for row in own]
        return [camera_of(place, width, height, *map(float, row)) for row in values[:count]]
    K = numbers_of(place, metadata, "K", 9).reshape(3, 3).T
    camera = camera_of(place, width, height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    return [camera] * count


def _times(place: str, metadata: dict[str, Any], count: int) -> tuple[np.ndarray, str]:
    if isinstance(metadata.get("frameTimestamps"), list) and len(metadata["frameTimestamps"]) >= count:
        return numbers_of(place, metadata, "frameTimestamps")[:count], "metadata, frameTimestamps"
    rate = number_of(place, metadata, "fps") if "fps" in metadata else RecordingTuning.rate_hz
    if rate <= 0:
        raise SequenceError(f"{place}: expected a positive 'fps', found {rate:g}")
    return nominal_timestamps(count, rate), f"{rate:g} frames/s of metadata"


def _add_poses(recording: Recording, place: str, metadata: dict[str, Any]) -> None:
    rows = metadata.get("poses")
    if not isinstance(rows, list) or not rows:
        return

    def pose_of(i: int) -> np.ndarray | None:
        if i >= len(rows):
            return None
        row = numbers_of(f"{place}, poses", {str(i): rows[i]}, str(i), 7)
        return pose_of_numbers(np.concatenate([row[4:], row[:4]])) @ OPENCV_FROM_OPENGL

    poses, problems = poses_of_frames(len(recording.files), pose_of, lambda i: f"{place}, pose {i}")
    recording.take_poses(poses, "metadata, poses (ARKit axes)", problems)
