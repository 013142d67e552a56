# SPDX-License-Identifier: Apache-2.0
"""Makes the clip of the README: a map grows from a recording, shows its objects, and loses them one after another.

ggslam synth demo/room
python scripts/tools/make_clip.py demo/room assets/clip.gif
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from ggslam.jobs.edit.edits import Edit, edit_run
from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.objects.rendered_ids import object_ids
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import Gaussians
from ggslam.reporting.pictures import color_of_ids, color_to_uint8
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.sequences import open_sequence
from ggslam.slam.result import StepReport
from ggslam.slam.slam import Slam

GONE = ("fruit,fruit bowl", "mug", "book pile", "cushion", "vase", "picture")
WIDTH, HEIGHT = 400, 300


class Film:
    """Frames of the clip: the map from one place, with what the camera sees in a corner while there is something."""

    def __init__(self, camera: Camera, T_camera_world: np.ndarray) -> None:
        self.camera, self.T_camera_world = camera, T_camera_world
        self.rasterizer = CpuRasterizer()
        self.images: list[np.ndarray] = []
        self.times: list[int] = []

    def show(self, image: np.ndarray, caption: str, milliseconds: int = 100) -> None:
        """Adds an image with a caption."""
        image = np.array(image, order="C")
        cv2.rectangle(image, (0, HEIGHT - 22), (WIDTH, HEIGHT), (0, 0, 0), -1)
        cv2.putText(image, caption, (6, HEIGHT - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
        self.images.append(image)
        self.times.append(milliseconds)

    def render(self, gaussians: Gaussians) -> np.ndarray:
        """The map from the clip's place, uint8 [H, W, 3]."""
        return color_to_uint8(self.rasterizer.forward(gaussians, self.camera, self.T_camera_world).image.numpy())

    def follow(self, slam: Slam, frame: Frame, step: StepReport) -> None:
        """Adds the map as it is after a frame, and the frame in the corner."""
        image = np.array(self.render(slam.map), order="C")
        small = cv2.resize(frame.color, (120, 90), interpolation=cv2.INTER_AREA)
        image[6:96, 6:126] = small
        cv2.rectangle(image, (5, 5), (126, 96), (255, 255, 255), 1)
        self.show(image, f"frame {frame.index + 1}: {step.gaussians:,} Gaussians, two CPU cores")

    def save(self, path: Path) -> None:
        """Writes the GIF; all frames share one palette, so that what stands still costs nothing."""
        sample = np.concatenate(self.images[:: max(1, len(self.images) // 12)])
        palette = Image.fromarray(sample).quantize(256, method=Image.Quantize.MEDIANCUT)
        frames = [Image.fromarray(i).quantize(palette=palette, dither=Image.Dither.NONE) for i in self.images]
        frames[0].save(path, save_all=True, append_images=frames[1:], duration=self.times, loop=0, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--remove", nargs="*", default=GONE, help="names of the objects, in their order")
    arguments = parser.parse_args()

    sequence = open_sequence(arguments.recording)
    assert sequence.ground_truth is not None, "the place to look from is told by the recording's poses"
    poses = inverse(sequence.ground_truth[0]) @ sequence.ground_truth
    back = np.eye(4)
    back[2, 3] = -0.7  # metres behind the camera
    place = poses[len(poses) // 2] @ back
    camera = replace(sequence.camera.resize(WIDTH, HEIGHT), fx=0.62 * WIDTH, fy=0.62 * WIDTH)
    film = Film(camera, inverse(place))
    with tempfile.TemporaryDirectory() as name:
        run = Path(name) / "run"
        request = RunRequest(SequenceRequest(arguments.recording), out=run, evaluate=False)
        outcome = execute(request, follower=film.follow)
        if outcome.error is not None:
            raise outcome.error
        show_objects(film, outcome.folder)
        remove_objects(film, outcome.folder, arguments.remove, Path(name))
    film.save(arguments.out)
    print(f"wrote {arguments.out}: {len(film.images)} frames, {arguments.out.stat().st_size / 1e6:.2f} MB")


def show_objects(film: Film, folder: RunFolder) -> None:
    """Blends the map into the colours of its objects and back."""
    segmented = folder.segmented_map()
    view = film.rasterizer.forward(segmented.gaussians, film.camera, film.T_camera_world)
    plain = color_to_uint8(view.image.numpy())
    ids = object_ids(film.rasterizer, view, segmented)
    colors = color_of_ids(ids, segmented.table.palette(), outlines=True)
    colors = np.where(view.alpha.numpy()[..., None] > 0.5, colors, plain)
    count = len(segmented.table.objects)
    film.show(plain, "trained while tracking", 600)
    for share in (0.25, 0.5, 0.75):
        film.show(mix(plain, colors, share), f"{count} objects, learned with the map")
    film.show(colors, f"{count} objects, learned with the map", 1600)
    film.show(mix(plain, colors, 0.5), f"{count} objects, learned with the map")


def mix(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    """`share` of b, the rest of a."""
    return ((1 - share) * a + share * b).astype(np.uint8)


def remove_objects(film: Film, folder: RunFolder, names: tuple[str, ...], scratch: Path) -> None:
    """One edit after another, each of the run that the one before left."""
    before = film.render(folder.gaussians())
    for number, name in enumerate(names):
        outcome = edit_run(folder, [Edit("remove", name)], scratch / f"edit{number}", inpainting=True)
        folder = outcome.folder
        after = film.render(folder.gaussians())
        film.show(mix(before, after, 0.5), f"ggslam edit RUN --remove '{name}' --inpaint")
        film.show(after, f"ggslam edit RUN --remove '{name}' --inpaint", 900)
        before = after
    film.times[-1] = 2500


if __name__ == "__main__":
    main()
