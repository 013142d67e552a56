# SPDX-License-Identifier: Apache-2.0
"""Photometric alignment of frames to the map: at the end of a run where depth is noisy, and throughout where depth is
further off than its own noise shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any

import cv2
import numpy as np

from ggslam.errors import FormatError
from ggslam.mapping.comparing_mapper import ComparingMapper
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe
from ggslam.mapping.mapper import Mapper
from ggslam.mapping.settings import ViewAlignmentSettings
from ggslam.mapping.view_alignment import AlignmentTuning, PosePrior, align_view, grey_of, misfit
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, orthonormalize, separation
from ggslam.slam.frame_poses import FramePoses
from ggslam.slam.result import TrackedFrame
from ggslam.system.array_forms import Form
from ggslam.system.savable import savable
from ggslam.system.side_thread import SideThread
from ggslam.system.tuning import Tuning
from ggslam.tracking.tracker import TrackerState, TrackingResult, TrackingStatus


class ColorPoseTuning(Tuning):
    """Alignment of frames to the map by colour."""

    undecided_frames = 32
    """Frames at the start whose images are kept before it is known whether they will be aligned."""
    kept_bytes = 1 << 26
    """Most bytes of coded images kept for the alignment at the end. Later frames keep the tracker's pose."""
    kept_bytes_paged = 1 << 23
    """The same limit, in bytes, where the memory of the run is limited."""
    jpeg_quality = 90
    """JPEG quality of kept images, of 100: 21 KB at 320x240 instead of 77 KB uncoded."""
    last_blurs = (0.7,)
    """Blurs of the alignment at the end, in pixels, one pass each. Its start is close, so one pass suffices."""
    last_points = 3000
    """Most points of a frame in the alignment at the end."""
    last_iterations = 4
    """Iterations of the alignment at the end."""
    report_every = 20
    """Aligned frames between two reports of progress."""
    farthest = 10.0
    """Farthest pose that is believed, in `farthest_sigmas`. Beyond 1 it has to fit the image clearly better."""
    convincing = 0.87
    """Grey difference, as a share of that at the tracked pose, below which a pose fits clearly better."""
    keyframe_better = 0.97
    """The same below which a keyframe moves by a map that was trained little."""
    enough_steps = 10.0
    """Steps per keyframe from which a map is trained enough to tell keyframes' poses. One trained less repeats the
    errors of poses that it was made with."""
    hidden_margin_pixels = 9
    """Side, in pixels, of the square by which masks of hidden surfaces are dilated. Odd."""


_Coded = Annotated[np.ndarray, Form("u1", None)]
_Kept = tuple[int, float, _Coded, _Coded]


@savable(not_saved="mapper poses state coder", growing="images", save="state_to_save")
@dataclass
class ColorPoses:
    """Aligns located frames to the map as it is, where that is due, and to the map as it is at the end.

    Args:
        mapper: whose map it is.
        poses: of the frames so far.
        state: of the tracker, which knows how much noise its images hide.

    Attributes:
        images: of frames that were located and are no keyframes: their number among all frames, their median depth in
            metres, their grey values as a JPEG file, and as a PNG file where they do not show the map, uint8 arrays; an
            empty one: nowhere.
        held_bytes: what they take.
        active: whether frames may be aligned.
        live: whether another thread trains the map meanwhile, so that frames can be aligned at the end only.
        coder: codes the image that is kept next, which joins `images` when the next one comes or they are needed.
    """

    mapper: Mapper
    poses: FramePoses
    state: TrackerState
    images: list[_Kept] = field(default_factory=list)
    held_bytes: int = 0
    active: bool = field(init=False)
    live: bool = False
    coder: SideThread[_Kept] = field(default_factory=lambda: SideThread("images"))

    def __post_init__(self) -> None:
        self.active = isinstance(self.mapper, ComparingMapper) and self.mapper.settings.view_alignment.enabled

    def align(self, frame: Frame, found: TrackingResult) -> TrackingResult:
        """What the tracker found, with the pose by colour where depth hides its errors and that does not contradict
        it."""
        if found.status in (TrackingStatus.LOST, TrackingStatus.FIRST) or not self.active or self.live:
            return found
        if found.still:
            return found
        if not self._is_due or not self.mapper.keyframes:
            return found
        # The map is where its keyframes are by now, the tracker's surface where they were when they came.
        keyframe, T_world_anchor = self.poses.anchor
        T_map_world = self.mapper.keyframes[keyframe].T_world_camera @ inverse(T_world_anchor)
        start, settings = T_map_world @ found.T_world_camera, self.mapper.settings.view_alignment
        hidden = _find_hidden(frame.moving, frame.valid)
        T = self._pose(grey_of(frame.color), start, found.median_depth_m, hidden, settings)
        return found if T is None else replace(found, T_world_camera=orthonormalize(inverse(T_map_world) @ T))

    def note(self, frame: Frame, found: TrackingResult) -> None:
        """Keeps the image of the frame that `poses` took last, and that is no keyframe, if it is to be aligned at the
        end and there is memory for it."""
        if not self.active or found.still or found.status in (TrackingStatus.LOST, TrackingStatus.FIRST):
            return
        self._take_coded()
        number, depth = len(self.poses.frames) - 1, found.median_depth_m
        if number >= ColorPoseTuning.undecided_frames and not self._tells_more(depth):
            return
        if self.held_bytes >= (
            ColorPoseTuning.kept_bytes if self.mapper.residency is None else ColorPoseTuning.kept_bytes_paged
        ):
            return
        self.coder.start(partial(_code, number, depth, frame.color, frame.moving, frame.valid))

    def _take_coded(self) -> None:
        """What `coder` was asked for joins the images."""
        if self.coder.is_asked:
            self.images.append(self.coder.take())
            self.held_bytes += self.images[-1][2].nbytes + self.images[-1][3].nbytes

    def state_to_save(self) -> dict[str, Any]:
        """What is saved."""
        self._take_coded()
        return vars(self)

    def align_last(self, report: Callable[[], None] = lambda: None) -> None:
        """Aligns the frames whose images were kept to the map as it is now; `report` is called now and then."""
        if not self.active:
            return
        self._take_coded()
        aligned, due = {}, [image for image in self.images if self._tells_more(image[1])]
        for numbers in self.mapper.stages() if due else ():
            together = set(numbers)
            for number, depth, coded, mask in due:
                if self.poses.frames[number].keyframe not in together:
                    continue
                grey = self._decode(coded).astype(np.float32) / 255
                hidden = self._decode(mask) > 0 if len(mask) else None
                aligned[number] = self._align_frame(number, depth, grey, hidden)
                if len(aligned) % ColorPoseTuning.report_every == 0:
                    report()
        for number, frame in aligned.items():  # all or none: `report` may end the run
            self.poses.frames[number] = frame

    def align_keyframes(self) -> None:
        """Aligns all keyframes but the one that defines the world to the map as it is now, where colour tells more than
        depth: they were placed one after the other, and those that came early see the least of what the others agree
        on."""
        if not (self.active and self.mapper.settings.pose_refinement.enabled):
            return
        steps = np.mean([keyframe.iterations for keyframe in self.mapper.keyframes] or [0])
        is_trained = self._is_due or steps >= ColorPoseTuning.enough_steps
        better = float("inf") if is_trained else ColorPoseTuning.keyframe_better
        for numbers in self.mapper.stages():
            for keyframe in (self.mapper.keyframes[number] for number in numbers):
                known = keyframe.depth_m()
                if keyframe.frame_index == FROM_EARLIER_RUN or keyframe.instant is not None or not known.any():
                    continue  # keyframes of a rig stay as the rig has them
                if self.mapper.is_world(keyframe):
                    continue
                depth = float(np.median(known[known > 0]))
                if self._tells_more(depth, self.mapper.settings.view_alignment.keyframe_noise):
                    self._align_keyframe(keyframe, depth, better)

    def _align_keyframe(self, keyframe: Keyframe, depth: float, better: float) -> None:
        """Aligns a keyframe with this median depth, in metres; `better` as in `_pose`."""
        hidden = _find_hidden(None, self.mapper.valid_of(keyframe))
        settings, blurs = self.mapper.settings.view_alignment, AlignmentTuning.blurs[-1:]
        T = self._pose(grey_of(keyframe.color), keyframe.T_world_camera, depth, hidden, settings, blurs, better)
        if T is not None:
            keyframe.T_camera_world = inverse(orthonormalize(T))

    def check(self) -> None:
        """Raises FormatError if what is kept cannot be of this run: it may have come out of a file."""
        for kept in self.images:
            number, depth, *coded = kept if isinstance(kept, (tuple, list)) and len(kept) == 4 else (-1, 0.0)
            known = isinstance(number, int) and 0 <= number < len(self.poses.frames) and isinstance(depth, float)
            if not known or any(not isinstance(a, np.ndarray) or a.dtype != np.uint8 or a.ndim != 1 for a in coded):
                raise FormatError("images for the alignment at the end: one does not belong to this recording")
            if not len(coded[0]):
                raise FormatError("images for the alignment at the end: one is empty")

    def _decode(self, coded: np.ndarray) -> np.ndarray:
        """A kept image, uint8 [H, W]."""
        image, camera = cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), self.state.camera
        if image is None or image.shape != (camera.height, camera.width):  # out of a checkpoint that was tampered with
            raise FormatError("images for the alignment at the end: one does not belong to this recording")
        return image

    @property
    def _is_due(self) -> bool:
        return self.state.residuals.hidden >= self.mapper.settings.view_alignment.hidden_noise

    def _tells_more(self, depth: float, least: float | None = None) -> bool:
        """Whether colour tells a pose better than depth with the noise at a distance in metres: it is at least so many
        pixels wide; None: as for frames after the last one."""
        if self._is_due:
            return True
        noise, camera = self.state.noise, self.state.camera
        least = self.mapper.settings.view_alignment.last_noise if least is None else least
        return noise is not None and depth > 0 and noise.in_pixels(depth, camera.fx) >= least

    def _align_frame(self, number: int, depth: float, grey: np.ndarray, hidden: np.ndarray | None) -> TrackedFrame:
        """A frame with its pose as of the finished map."""
        frame, settings = self.poses.frames[number], self.mapper.settings.view_alignment
        T_world_keyframe = self.mapper.keyframes[frame.keyframe].T_world_camera
        last = replace(
            settings,
            points=min(ColorPoseTuning.last_points, settings.points),
            iterations=ColorPoseTuning.last_iterations,
        )
        T = self._pose(
            grey, T_world_keyframe @ frame.T_keyframe_camera, depth, hidden, last, ColorPoseTuning.last_blurs
        )
        if T is None:
            return frame
        return replace(frame, T_keyframe_camera=orthonormalize(inverse(T_world_keyframe) @ T))

    def _pose(
        self, grey: np.ndarray, T_world_camera: np.ndarray, median_depth: float, hidden: np.ndarray | None,
        settings: ViewAlignmentSettings, blurs: Sequence[float] = AlignmentTuning.blurs,
        better: float = float("inf"),
    ) -> np.ndarray | None:  # fmt: skip
        """T_world_camera [4, 4] by colour, from one near by; None if there is none that can be believed, or none whose
        grey difference is less than a share `better` of that at the one near by."""
        camera, T_camera_world = self.state.camera, inverse(T_world_camera)
        assert isinstance(self.mapper, ComparingMapper)
        view = self.mapper.render_view(camera, T_camera_world)
        depth, alpha = view.expected_depth.numpy(), view.alpha.numpy()
        if hidden is not None:
            alpha = np.where(hidden, np.float32(0), alpha)
        rendered = grey_of(np.ascontiguousarray(view.image.numpy().clip(0, 1).transpose(1, 2, 0)))
        if self.state.noise is None or median_depth <= 0:
            return None
        sigma = self.state.noise.sigma(median_depth)
        # Where depth hides its errors, a pose that it gave says nothing.
        trust = None if self._is_due else PosePrior(sigma, sigma / median_depth)
        T = align_view(grey, rendered, depth, alpha, camera, settings, blurs, trust)
        if T is None:
            return None
        found = inverse(T @ T_camera_world)
        moved, turned = separation(found, T_world_camera)
        limit = settings.farthest_sigmas * sigma
        way = max(moved, np.radians(turned) * median_depth)
        if way > ColorPoseTuning.farthest * limit:
            return None
        if way > limit:
            better = min(better, ColorPoseTuning.convincing)
        if better == float("inf"):
            return found
        before, after = (misfit(grey, rendered, depth, alpha, camera, settings, pose) for pose in (np.eye(4), T))
        return found if after < better * before else None


def _code(
    number: int, depth: float, color: np.ndarray, moving: np.ndarray | None, valid: np.ndarray | None
) -> _Kept:
    """What is kept of a frame with a median depth, metres: an element of `ColorPoses.images`."""
    grey, hidden = grey_of(color), _find_hidden(moving, valid)
    quality = [cv2.IMWRITE_JPEG_QUALITY, ColorPoseTuning.jpeg_quality]
    coded = cv2.imencode(".jpg", np.rint(255 * grey).astype(np.uint8), quality)[1]
    mask = np.zeros(0, np.uint8) if hidden is None else cv2.imencode(".png", hidden.view(np.uint8))[1]
    return number, depth, coded.reshape(-1), mask.reshape(-1)


def _find_hidden(moving: np.ndarray | None, valid: np.ndarray | None) -> np.ndarray | None:
    """Where an image does not show the map, bool [H, W]: something moves there, or is fixed to the camera, or there is
    no image (see `Frame`); None: nowhere. What is beside it is not trusted either."""
    hidden = moving
    if valid is not None:
        hidden = ~valid if hidden is None else hidden | ~valid
    if hidden is None or not hidden.any():
        return None
    side = ColorPoseTuning.hidden_margin_pixels
    return cv2.dilate(hidden.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
