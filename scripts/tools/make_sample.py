# SPDX-License-Identifier: Apache-2.0
"""Makes the sample recording that the repository carries: the generated room in Replica's layout, small and exact.

python scripts/tools/make_sample.py assets/sample
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import cv2
import numpy as np

from ggslam.sequences import open_sequence
from ggslam.sequences.formats.replica import DEFAULT_DEPTH_SCALE
from ggslam.synthetic.writer import write_synthetic_sequence

FRAMES = 24
QUALITY = 90
"""Of the colour images, as JPEG counts it."""


def write_sample(folder: Path) -> None:
    """Writes the first frames of the generated room with their masks, poses and camera."""
    (folder / "results").mkdir(parents=True, exist_ok=True)
    (folder / "semantic_instance").mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as made:
        sequence = open_sequence(write_synthetic_sequence(Path(made) / "room", frames=FRAMES, noise=False))
        poses = []
        for index, frame in enumerate(sequence):
            name = f"{index:06d}"
            color = cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR)
            cv2.imwrite(str(folder / f"results/frame{name}.jpg"), color, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
            depth = np.rint(frame.depth * DEFAULT_DEPTH_SCALE).astype(np.uint16)
            cv2.imwrite(str(folder / f"results/depth{name}.png"), depth, [cv2.IMWRITE_PNG_COMPRESSION, 9])
            cv2.imwrite(str(folder / f"semantic_instance/semantic_instance_{index}.png"), frame.mask.astype(np.uint16))
            poses.append(" ".join(f"{value:.9f}" for value in frame.T_world_camera.ravel()))
    (folder / "traj.txt").write_text("\n".join(poses) + "\n")
    camera = sequence.camera
    numbers = {"w": camera.width, "h": camera.height, **{key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy")}}
    names = {str(number): name for number, name in sequence.instance_names.items()}
    content = {"camera": {**numbers, "scale": DEFAULT_DEPTH_SCALE}, "instances": names}
    (folder / "cam_params.json").write_text(json.dumps(content, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where to write it")
    write_sample(parser.parse_args().folder)


if __name__ == "__main__":
    main()
