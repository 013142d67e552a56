# SPDX-License-Identifier: Apache-2.0
"""Bringing the colour, depth and mask image of a frame onto one pixel grid of one undistorted pinhole camera."""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences.json_files import camera_of
from ggslam.sequences.orientation import QUARTER_TURNS, orientation_of
from ggslam.sequences.orientation import WORDS as ORIENTATIONS
from ggslam.sequences.recording import FrameFiles, ImageFile, Recording
from ggslam.sequences.registration import DepthRegistration, undistorted_rays
from ggslam.sequences.resampling import resize_color, resize_depth, resize_mask
from ggslam.sequences.upsampling import upsample_depth
from ggslam.sequences.valid_pixels import within_source
from ggslam.system.tuning import Tuning


class GridTuning(Tuning):
    """When depth is brought to colour's pixels, and colour is made smaller."""

    finer = 2.5
    """Columns of colour, in columns of depth, from which depth is brought to colour."""
    usual_pixels = 640 * 480
    """Pixels of an image that two processors map at usual speed; finer colour is scaled to it."""
    aspect = 0.01
    """Relative difference of width/height up to which two sizes are of one view (1296x968, 640x480: 0.4 %)."""
    far_m = np.float32(1e4)
    """Depth in metres that stands for "nothing measured" while pixels are brought to another image."""



Size = tuple[int, int]
"""(width, height) in pixels."""


def image_size(image: np.ndarray) -> Size:
    """(width, height) of an image [H, W, ...]."""
    return image.shape[1], image.shape[0]


def same_aspect(a: Size, b: Size) -> bool:
    """Whether two sizes can be the same view at different resolution."""
    return abs(a[0] * b[1] - a[1] * b[0]) <= GridTuning.aspect * a[0] * b[1]


def _text(size: Size) -> str:
    return f"{size[0]}x{size[1]}"


class ImageGeometry:
    """Turns the images of one recording, as stored, into images of `camera`.

    Colour and depth of different resolution are brought to the smaller one (to the depth image's when it has its own
    intrinsics), unless colour is much finer: then depth is brought to colour, see `upsampling`. Depth of another camera
    is registered to the colour image, at about its own resolution; lens distortion is undone, frames with intrinsics of
    their own are brought to those of the recording, and the result is scaled down.

    Attributes:
        camera: intrinsics of the images that come out.
        native_camera: the same before scaling.
        usual: scale of one to the other that is usual: 1, of much finer colour what leaves `GridTuning.usual_pixels`.
        scale: of `camera` to that of usual size.
        finer: whether depth is brought to finer colour.
        valid: bool [H, W], where images of `camera` show something; None: everywhere.
        color_size, depth_size: sizes (width, height) that every stored image must have.
    """

    def __init__(
        self, recording: Recording, files: FrameFiles, color_size: Size, depth_size: Size, scale: float | None
    ) -> None:
        if recording.depth_camera is None and not same_aspect(color_size, depth_size):
            found = f"{files.depth}: depth is {_text(depth_size)}, but colour {files.color.name} is {_text(color_size)}"
            raise SequenceError(f"{found}: {_why_other_aspect(recording, files, color_size, depth_size)}")
        self.color_size, self.depth_size = color_size, depth_size
        self._common = color_camera = _color_camera(recording, color_size, files.color)
        self._warp: np.ndarray | None = None
        self._seen: np.ndarray | None = None
        self._registration: DepthRegistration | None = None
        self.finer = False
        if recording.depth_camera is not None:
            self.native_camera = self._register(recording, depth_size, files)
        elif recording.depth_calibration is not None:
            self.native_camera = camera_of(recording.path, *depth_size, *recording.depth_calibration)
            self._align_color(color_camera.resize(*depth_size))
        else:
            self.finer = color_size[0] >= GridTuning.finer * depth_size[0]
            size = color_size if self.finer else min(color_size, depth_size, key=lambda s: s[0] * s[1])
            self.native_camera = color_camera.resize(*size)
        most = GridTuning.usual_pixels / (self.native_camera.width * self.native_camera.height)
        self.usual: float = min(1.0, most**0.5) if self.finer else 1.0
        self.scale: float = 1.0 if scale is None else scale
        if self.scale * self.usual > 1 + 1e-6:
            raise SequenceError(f"`scale`: expected a number above 0 and at most {1 / self.usual:g}, found {scale}")
        self.camera = self.native_camera.scale(self.scale * self.usual)
        # Finer colour is brought to its last size first: it may have many times as many pixels.
        self._work = self.camera if self.finer else self.native_camera
        self._maps = _undistortion(self._work, recording.distortion, recording.fisheye)
        self._filled = False
        self.valid: np.ndarray | None = self._valid()

    def _valid(self, filled: np.ndarray | None = None) -> np.ndarray | None:
        """Pixels of `camera` that show something; `filled`: bool, pixels of `_work` that do not."""
        valid = np.ones((self._work.height, self._work.width), bool) if self._seen is None else self._seen.copy()
        if filled is not None:
            valid &= ~filled
        if self._maps is not None:
            if not valid.all():
                valid = cv2.remap(valid.astype(np.uint8), *self._maps, interpolation=cv2.INTER_NEAREST) > 0
            valid &= within_source(*self._maps)
        if valid.all():
            return None
        size = (self.camera.width, self.camera.height)
        return cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 1 - 1e-3

    def leave_out(self, fill: np.ndarray) -> None:
        """Pixels of the stored colour images, bool [H, W], show nothing: nor does depth count there."""
        around = cv2.dilate(fill.astype(np.uint8), np.ones((3, 3), np.uint8))  # compression bleeds
        size = (self._work.width, self._work.height)
        filled = cv2.resize(around.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 1e-3
        self._filled, self.valid = True, self._valid(filled)

    def _register(self, recording: Recording, depth_size: Size, files: FrameFiles) -> Camera:
        """Prepares registration of depth; returns the colour camera at about the depth image's resolution."""
        assert recording.depth_camera is not None
        stated = recording.depth_camera.camera
        if not same_aspect((stated.width, stated.height), depth_size):
            raise SequenceError(
                f"{files.depth}: depth is {_text(depth_size)}, but the calibration of the depth camera is for "
                f"{stated.width}x{stated.height}"
            )
        native = self._common.scale(min(1.0, stated.resize(*depth_size).fx / self._common.fx))
        self._registration = DepthRegistration(recording.depth_camera, depth_size, native)
        return native

    def _align_color(self, color_camera: Camera) -> None:
        """Prepares the affine map from depth pixels to colour pixels of the same size; none if it moves nothing."""
        c, d = color_camera, self.native_camera
        ax, ay = c.fx / d.fx, c.fy / d.fy
        warp = np.array([[ax, 0.0, c.cx - ax * d.cx], [0.0, ay, c.cy - ay * d.cy]])
        u = warp[0, 0] * np.arange(d.width) + warp[0, 2]
        v = warp[1, 1] * np.arange(d.height) + warp[1, 2]
        if max(np.abs(u - np.arange(d.width)).max(), np.abs(v - np.arange(d.height)).max()) < 0.1:
            return
        inside_u, inside_v = (u > -0.5) & (u < d.width - 0.5), (v > -0.5) & (v < d.height - 0.5)
        self._warp, self._seen = warp, inside_v[:, None] & inside_u[None, :]

    def check(self, color: np.ndarray, depth: np.ndarray, files: FrameFiles) -> None:
        """Raises SequenceError when the images of a frame have another size than those of the first frame."""
        for kind, path, image, expected in (
            ("colour", files.color, color, self.color_size),
            ("depth", files.depth, depth, self.depth_size),
        ):
            found = image_size(image)
            if found != expected:
                raise SequenceError(
                    f"{path}: expected {kind} of {_text(expected)} as in the first frame, found {_text(found)}"
                )

    def steady(self, image: np.ndarray, files: FrameFiles, flags: int) -> np.ndarray:
        """Image as stored -> the same with the recording's intrinsics, if the frame has its own.

        Args:
            image: [H, W, ...] colour, depth or ids.
            files: the frame.
            flags: OpenCV's interpolation.
        """
        if files.camera is None:
            return image
        size = image_size(image)
        own, common = files.camera.resize(*size), self._common.resize(*size)
        ax, ay = own.fx / common.fx, own.fy / common.fy
        warp = np.array([[ax, 0.0, own.cx - ax * common.cx], [0.0, ay, own.cy - ay * common.cy]])
        corner = warp @ (size[0] - 1, size[1] - 1, 1)
        if max(np.abs(warp[:, 2]).max(), np.abs(corner - (size[0] - 1, size[1] - 1)).max()) < 0.25:
            return image
        return cv2.warpAffine(image, warp, size, flags=flags | cv2.WARP_INVERSE_MAP)

    def color(self, color: np.ndarray) -> np.ndarray:
        """Colour uint8 [H, W, 3] as stored -> image of `camera`."""
        native, size = (self._work.width, self._work.height), (self.camera.width, self.camera.height)
        if self._warp is None and self._maps is None:
            return resize_color(color, *size)
        color = resize_color(color, *native)
        if self._warp is not None:
            color = cv2.warpAffine(color, self._warp, native, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        if self._maps is not None:
            color = cv2.remap(color, *self._maps, interpolation=cv2.INTER_LINEAR)
        return resize_color(color, *size)

    def depth(self, depth: np.ndarray, color: np.ndarray) -> np.ndarray:
        """Depth float32 [H, W] metres as stored, with the colour image as stored -> image of `camera`."""
        found = self._depth_on_color(depth, color) if self.finer else self._depth_of_camera(depth)
        return np.where(self.valid, found, np.float32(0)) if self._filled and self.valid is not None else found

    def no_return(
        self, found: np.ndarray, stored: np.ndarray, depth: np.ndarray, color: np.ndarray, files: FrameFiles
    ) -> np.ndarray:
        """Where the sensor found nothing, bool [H, W] as stored -> bool [H, W] of `camera`: where depth is very far if
        it is taken to be so there.

        Args:
            found: as stored.
            stored: depth as stored, metres.
            depth: of `camera`, made of it.
            color: steadied colour.
            files: the frame.
        """
        far = self.steady(np.where(found, GridTuning.far_m, stored), files, cv2.INTER_NEAREST)
        return (depth == 0) & (self.depth(far, color) > GridTuning.far_m / 2)

    def _depth_of_camera(self, depth: np.ndarray) -> np.ndarray:
        if self._registration is not None:
            return resize_depth(self._registration(depth), self.camera.width, self.camera.height)
        depth = resize_depth(depth, self.native_camera.width, self.native_camera.height)
        if self._seen is not None:
            depth = np.where(self._seen, depth, np.float32(0))  # no colour there
        if self._maps is not None:
            depth = cv2.remap(depth, *self._maps, interpolation=cv2.INTER_NEAREST)
        return resize_depth(depth, self.camera.width, self.camera.height)

    def _depth_on_color(self, depth: np.ndarray, color: np.ndarray) -> np.ndarray:
        """Depth on the pixels of finer colour."""
        width, height = self.camera.width, self.camera.height
        if width < depth.shape[1] or height < depth.shape[0]:
            depth = resize_depth(depth, width, height)
        else:
            depth = upsample_depth(depth, resize_color(color, width, height))
        return depth if self._maps is None else cv2.remap(depth, *self._maps, interpolation=cv2.INTER_NEAREST)

    def mask(self, mask: np.ndarray, shared: bool = True) -> np.ndarray:
        """Ids uint16 [H, W] as stored, on the colour image -> image of `camera`; without `shared` those of its pixels
        have none that several things have like shares of."""
        native = (self._work.width, self._work.height)
        mask = resize_mask(mask, *native, shared)
        if self._warp is not None:
            mask = cv2.warpAffine(mask, self._warp, native, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)
        if self._maps is not None:
            mask = cv2.remap(mask, *self._maps, interpolation=cv2.INTER_NEAREST)
        return resize_mask(mask, self.camera.width, self.camera.height, shared)


def _why_other_aspect(recording: Recording, files: FrameFiles, color_size: Size, depth_size: Size) -> str:
    """What may be the matter with colour and depth of such sizes, and what to do about it."""
    if same_aspect(color_size, (depth_size[1], depth_size[0])):
        tag = orientation_of(files.color)
        if tag in QUARTER_TURNS and not recording.upright:
            return f"colour is stored {ORIENTATIONS[tag]} (orientation tag {tag}); try `upright`"
        return "one of them is stored turned by 90 degrees; turn it back, so that both show the same view"
    return (
        "not the same view at another resolution (the calibration of a depth camera beside the colour camera would "
        "tell how they belong together)"
    )


def rays_of_depth(recording: Recording, files: FrameFiles, color_size: Size, depth_size: Size) -> np.ndarray:
    """Viewing rays with z = 1 of the depth image of a frame as stored, float32 [H, W, 3]."""
    beside = recording.depth_camera
    if beside is not None:
        return undistorted_rays(beside.camera.resize(*depth_size), beside.distortion, beside.fisheye)
    if recording.depth_calibration is not None:
        camera = Camera(*depth_size, *recording.depth_calibration)
    else:
        camera = (files.camera or _color_camera(recording, color_size, files.color)).resize(*depth_size)
    return undistorted_rays(camera, recording.distortion, recording.fisheye)


def _source(recording: Recording) -> str:
    """Where the intrinsics come from, for errors."""
    source = recording.camera_source
    return source if source.startswith("`") else f"{recording.path}, {source}" if source else str(recording.path)


def _color_camera(recording: Recording, color_size: Size, color_file: ImageFile) -> Camera:
    if recording.camera is None:
        if recording.calibration is None:
            raise SequenceError(f"{recording.path}: no intrinsics")
        return camera_of(_source(recording), *color_size, *recording.calibration)
    stated = (recording.camera.width, recording.camera.height)
    if not same_aspect(stated, color_size):
        place = f" ({recording.camera_source})" if recording.camera_source else ""
        raise SequenceError(
            f"{color_file}: image is {_text(color_size)}, but the intrinsics of the recording are for {_text(stated)}"
            f"{place}: not the same view; give those of these images with `camera` or `intrinsics`"
        )
    return recording.camera.resize(*color_size)


def _undistortion(
    camera: Camera, distortion: np.ndarray | None, fisheye: bool
) -> tuple[np.ndarray, np.ndarray] | None:
    if distortion is None or not np.any(distortion):
        return None
    K, size, coefficients = camera.matrix(), (camera.width, camera.height), np.asarray(distortion, float)
    make = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    maps = make(K, coefficients, np.eye(3), K, size, cv2.CV_32FC1)
    return maps[0], maps[1]
