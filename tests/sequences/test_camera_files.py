# SPDX-License-Identifier: Apache-2.0
"""Calibrations that other programs write, each in its own true format: every number comes out as it was written, and
what cannot be used is refused by name."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import ggslam

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences import open_sequence
from ggslam.sequences.own_camera import read_own_camera
from ggslam.sequences.recording import OwnCamera

FX, FY, CX, CY = 517.306408, 516.469215, 318.643040, 255.313989
FIVE = (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)
EIGHT = (*FIVE, 0.1, 0.02, 0.003)
FOUR = (-0.0133, 0.0165, -0.0083, 0.0012)
CAMERA = Camera(640, 480, FX, FY, CX, CY)
K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])

ORB2 = f"""%YAML:1.0

#--------------------------------------------------------------------------------------------
# Camera Parameters. Adjust them!
#--------------------------------------------------------------------------------------------
Camera.fx: {FX}
Camera.fy: {FY}
Camera.cx: {CX}
Camera.cy: {CY}

Camera.k1: {FIVE[0]}
Camera.k2: {FIVE[1]}
Camera.p1: {FIVE[2]}
Camera.p2: {FIVE[3]}
Camera.k3: {FIVE[4]}

Camera.width: 640
Camera.height: 480
Camera.fps: 30.0
Camera.bf: 40.0
Camera.RGB: 1
ThDepth: 40.0
DepthMapFactor: 5000.0
ORBextractor.nFeatures: 1000
"""
ORB3 = ORB2.replace("Camera.f", "Camera1.f").replace("Camera.c", "Camera1.c").replace("Camera.k", "Camera1.k") \
    .replace("Camera.p", "Camera1.p").replace("DepthMapFactor", "RGBD.DepthMapFactor") + 'Camera.type: "PinHole"\n'
FISHEYE_ORB3 = f"""%YAML:1.0
---
Camera.type: "KannalaBrandt8"
Camera1.fx: {FX}
Camera1.fy: {FY}
Camera1.cx: {CX}
Camera1.cy: {CY}
Camera1.k1: {FOUR[0]}
Camera1.k2: {FOUR[1]}
Camera1.k3: {FOUR[2]}
Camera1.k4: {FOUR[3]}
Camera.width: 640
Camera.height: 480
"""
STELLA = f"""
Camera:
  name: "TUM RGBD 1"
  setup: "RGBD"
  model: "perspective"
  fx: {FX}
  fy: {FY}
  cx: {CX}
  cy: {CY}
  k1: {FIVE[0]}
  k2: {FIVE[1]}
  p1: {FIVE[2]}
  p2: {FIVE[3]}
  k3: {FIVE[4]}
  cols: 640
  rows: 480
  depthmap_factor: 5000
"""
ROS = """image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [{fx}, 0, {cx}, 0, {fy}, {cy}, 0, 0, 1]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {count}
  data: [{values}]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [500, 0, 300, 0, 0, 500, 200, 0, 0, 0, 1, 0]
"""
ECHO = f"""header:
  seq: 0
  frame_id: color_optical
height: 480
width: 640
distortion_model: rational_polynomial
D: [{", ".join(map(str, EIGHT))}]
K: [{FX}, 0.0, {CX}, 0.0, {FY}, {CY}, 0.0, 0.0, 1.0]
P: [500.0, 0.0, 300.0, 0.0, 0.0, 500.0, 200.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
---
"""
KALIBR = """cam0:
  cam_overlaps: []
  camera_model: {camera}
  distortion_coeffs: [{values}]
  distortion_model: {model}
  intrinsics: [{numbers}]
  resolution: [640, 480]
  rostopic: /camera/color/image_raw
"""
EUROC = f"""%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
rate_hz: 20
resolution: [640, 480]
camera_model: pinhole
intrinsics: [{FX}, {FY}, {CX}, {CY}] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [{", ".join(map(str, FIVE[:4]))}]
"""


def ros(model: str, values: tuple[float, ...]) -> str:
    words = {"fx": FX, "fy": FY, "cx": CX, "cy": CY, "model": model, "count": len(values)}
    return ROS.format(**words, values=", ".join(map(str, values)))


def kalibr(camera: str = "pinhole", model: str = "radtan", values: tuple[float, ...] = FIVE[:4]) -> str:
    numbers = f"{FX}, {FY}, {CX}, {CY}"
    return KALIBR.format(camera=camera, model=model, values=", ".join(map(str, values)), numbers=numbers)


def colmap(model: str, *numbers: float) -> str:
    head = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    return f"{head}# Number of cameras: 1\n1 {model} 640 480 {' '.join(map(str, numbers))}\n"


OPEN3D = json.dumps({"width": 640, "height": 480, "intrinsic_matrix": K.T.ravel().tolist()})
VIEW = json.dumps({
    "class_name": "PinholeCameraParameters", "extrinsic": np.eye(4).ravel().tolist(), "version_major": 1,
    "intrinsic": {"width": 640, "height": 480, "intrinsic_matrix": K.T.ravel().tolist()},
})  # fmt: skip
CORNER = (CX + 0.5, CY + 0.5)
"""What COLMAP calls the principal point: it counts from the image's corner, not from the first pixel's centre."""
SQUARE = Camera(640, 480, FX, FX, CX, CY)

CASES: dict[str, tuple[str, str, Camera, tuple[float, ...], bool, float | None]] = {
    "orb-slam2": ("TUM1.yaml", ORB2, CAMERA, FIVE, False, 5000.0),
    "orb-slam3": ("cam.yaml", ORB3, CAMERA, FIVE, False, 5000.0),
    "orb-slam3 fisheye": ("cam.yaml", FISHEYE_ORB3, CAMERA, FOUR, True, None),
    "stella": ("cam.yaml", STELLA, CAMERA, FIVE, False, 5000.0),
    "ros plumb_bob": ("ost.yaml", ros("plumb_bob", FIVE), CAMERA, FIVE, False, None),
    "ros rational": ("ost.yaml", ros("rational_polynomial", EIGHT), CAMERA, EIGHT, False, None),
    "ros equidistant": ("ost.yaml", ros("equidistant", FOUR), CAMERA, FOUR, True, None),
    "ros unknown, but none": ("ost.yaml", ros("fov", (0.0,)), CAMERA, (), False, None),
    "ros topic echo": ("info.yaml", ECHO, CAMERA, EIGHT, False, None),
    "kalibr radtan": ("camchain.yaml", kalibr(), CAMERA, FIVE[:4], False, None),
    "kalibr equidistant": ("camchain.yaml", kalibr(model="equidistant", values=FOUR), CAMERA, FOUR, True, None),
    "kalibr none": ("camchain.yaml", kalibr(model="none", values=()), CAMERA, (), False, None),
    "euroc": ("sensor.yaml", EUROC, CAMERA, FIVE[:4], False, None),
    "open3d": ("intrinsic.json", OPEN3D, CAMERA, (), False, None),
    "open3d view": ("view.json", VIEW, CAMERA, (), False, None),
    "open3d by rows": ("i.json", OPEN3D.replace(str(K.T.ravel().tolist()), str(K.ravel().tolist())), CAMERA, (), False,
                       None),
    "replica": ("cam_params.json", json.dumps({"camera": {"w": 640, "h": 480, "fx": FX, "fy": FY, "cx": CX, "cy": CY,
                                                          "scale": 6553.5}}), CAMERA, (), False, 6553.5),
    "realsense": ("rs.json", json.dumps({"width": 640, "height": 480, "fx": FX, "fy": FY, "ppx": CX, "ppy": CY,
                                         "model": "Inverse Brown Conrady", "coeffs": [0.0] * 5}), CAMERA, (), False,
                  None),
    "colmap simple pinhole": ("cameras.txt", colmap("SIMPLE_PINHOLE", FX, *CORNER), SQUARE, (), False, None),
    "colmap pinhole": ("cameras.txt", colmap("PINHOLE", FX, FY, *CORNER), CAMERA, (), False, None),
    "colmap simple radial": ("cameras.txt", colmap("SIMPLE_RADIAL", FX, *CORNER, 0.1), SQUARE, (0.1, 0, 0, 0, 0), False,
                             None),
    "colmap radial": ("cameras.txt", colmap("RADIAL", FX, *CORNER, 0.1, -0.2), SQUARE, (0.1, -0.2, 0, 0, 0), False,
                      None),
    "colmap opencv": ("cameras.txt", colmap("OPENCV", FX, FY, *CORNER, *FIVE[:4]), CAMERA, (*FIVE[:4], 0), False, None),
    "colmap full opencv": ("cameras.txt", colmap("FULL_OPENCV", FX, FY, *CORNER, *EIGHT), CAMERA, EIGHT, False, None),
    "colmap fisheye": ("cameras.txt", colmap("OPENCV_FISHEYE", FX, FY, *CORNER, *FOUR), CAMERA, FOUR, True, None),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_every_number_comes_out_as_it_was_written(tmp_path: Path, name: str) -> None:
    file, text, camera, distortion, fisheye, scale = CASES[name]
    (tmp_path / file).write_text(text)
    own = read(tmp_path / file)
    assert own.camera is not None and own.calibration is None
    assert (own.camera.width, own.camera.height) == (640, 480)
    np.testing.assert_allclose(own.camera.matrix(), camera.matrix(), rtol=1e-12)
    assert (() if own.distortion is None else tuple(own.distortion)) == distortion
    assert own.fisheye is fisheye and own.depth_scale == scale


def read(path: Path) -> OwnCamera:
    own = read_own_camera(path, None)
    assert own is not None
    return own


@pytest.mark.parametrize(
    "text",
    [f"{FX} 0 {CX}\n0 {FY} {CY}\n0 0 1\n", f"{FX},0,{CX},0\n0,{FY},{CY},0\n0,0,1,0\n0,0,0,1\n", f"{FX} {FY} {CX} {CY}",
     f"# fx fy cx cy\n{FX} {FY} {CX} {CY}\n", f"[[{FX}, 0, {CX}],\n [0, {FY}, {CY}],\n [0, 0, 1]]\n",
     f"{FX} 0 0\n0 {FY} 0\n{CX} {CY} 1\n"],
)  # fmt: skip
def test_a_matrix_alone_is_for_the_images_as_they_are(tmp_path: Path, text: str) -> None:
    (tmp_path / "K.txt").write_text(text)
    own = read(tmp_path / "K.txt")
    assert own.camera is None and own.calibration == (FX, FY, CX, CY) and own.distortion is None


def test_what_opencv_writes_is_what_opencv_reads(tmp_path: Path) -> None:
    """Another reader of FileStorage, on a file that its writer made."""
    path = tmp_path / "calibration.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", 640), ("image_height", 480)):
        storage.write(name, value)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", np.array([EIGHT]))
    storage.release()
    assert "!!opencv-matrix" in path.read_text()
    own, opened = read(path), cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert own.camera is not None and own.distortion is not None
    np.testing.assert_array_equal(own.camera.matrix(), opened.getNode("camera_matrix").mat())
    np.testing.assert_array_equal(own.distortion, opened.getNode("distortion_coefficients").mat().ravel())
    (tmp_path / "orb.yaml").write_text(ORB2)  # which OpenCV reads, too
    orb = cv2.FileStorage(str(tmp_path / "orb.yaml"), cv2.FILE_STORAGE_READ)
    found = read(tmp_path / "orb.yaml").camera
    assert found is not None
    names = ("fx", "fy", "cx", "cy")
    assert [getattr(found, name) for name in names] == [orb.getNode(f"Camera.{name}").real() for name in names]


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("ost.yaml", ros("thin_prism", FOUR), "thin_prism"),
        ("camchain.yaml", kalibr(model="fov", values=(0.9,)), "fov"),
        ("camchain.yaml", kalibr(camera="omni"), "cam0.*omni"),
        ("camchain.yaml", kalibr() + kalibr().replace("cam0", "cam1"), "cam0, cam1"),
        ("cameras.txt", colmap("THIN_PRISM_FISHEYE", *[1.0] * 12), "THIN_PRISM_FISHEYE"),
        ("cameras.txt", colmap("PINHOLE", FX, FY, *CORNER) + "2 PINHOLE 640 480 1 1 1 1\n", r"\b2\b"),
        ("cameras.txt", colmap("PINHOLE", FX, FY), "PINHOLE"),
        ("rs.json", CASES["realsense"][1].replace("[0.0, 0.0, 0.0, 0.0, 0.0]", "[0.1, 0, 0, 0, 0]"),
         "Inverse Brown Conrady"),
        ("K.txt", f"{FX} 5.0 {CX}\n0 {FY} {CY}\n0 0 1\n", "skew .5."),
        ("K.txt", f"-{FX} 0 {CX}\n0 {FY} {CY}\n0 0 1\n", "focal"),
        ("K.txt", "1 2 3 4 5 6\n", r"\b6\b"),
        ("K.txt", "hello\n", "hello"),
        ("ost.yaml", ros("plumb_bob", FIVE).replace("cols: 5", "cols: 4"), "1 x 4.*5"),
        ("ost.yaml", ros("plumb_bob", (0.1, 0.2, 0.3)), "plumb_bob.*distortion.*3"),
        ("info.yaml", ECHO.replace("  width: 0", "  width: 320").replace("  x_offset: 0", "  x_offset: 9"), "roi"),
        ("orb.yaml", ORB2.replace("Camera.cy", "Camera.zy"), "'cy'"),
        ("orb.yaml", STELLA.replace("perspective", "equirectangular"), "equirectangular"),
        ("d.yaml", "width: 640\nheight: 480\nfx: 1\nfy: 1\ncx: 1\ncy: 1\nT_color_depth: [1]\n",
         "T_color_depth.*`depth_camera`"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_refused_by_name(tmp_path: Path, file: str, text: str, message: str) -> None:
    (tmp_path / file).write_text(text)
    with pytest.raises(SequenceError, match=message) as caught:
        read(tmp_path / file)
    assert file in str(caught.value) and "\n" not in str(caught.value)


def test_other_sizes_are_scaled_or_refused(make: Callable[[str], Path], tmp_path: Path) -> None:
    """Images are 32x24: a camera of 640x480 is brought to them, pixel centres and all; one of 640x360 is refused."""
    folder, path = make("folder"), tmp_path / "ost.yaml"
    path.write_text(ros("plumb_bob", (0.0,) * 5))
    sequence = open_sequence(folder, camera=path)
    expected = (FX / 20, FY / 20, (CX + 0.5) / 20 - 0.5, (CY + 0.5) / 20 - 0.5)
    c = sequence.camera
    np.testing.assert_allclose((c.fx, c.fy, c.cx, c.cy), expected, rtol=1e-12)
    assert sequence.camera_source.endswith(", scaled from 640x480 to images of 32x24")
    path.write_text(path.read_text().replace("image_height: 480", "image_height: 360"))
    with pytest.raises(SequenceError, match="32x24.*640x360"):
        open_sequence(folder, camera=path)


def test_their_distortion_is_undone(make: Callable[[str], Path], tmp_path: Path) -> None:
    """The same map of pixels as of OpenCV for the same coefficients."""
    folder, path = make("folder"), tmp_path / "ost.yaml"
    picture = np.random.default_rng(0).integers(0, 256, (24, 32, 3)).astype(np.uint8)
    assert cv2.imwrite(str(folder / "rgb" / "0.png"), picture)
    path.write_text(ros("plumb_bob", FIVE))
    sequence = open_sequence(folder, camera=path)
    K = sequence.camera.matrix()
    maps = cv2.initUndistortRectifyMap(K, np.array(FIVE), np.eye(3), K, (32, 24), cv2.CV_32FC1)
    wanted = cv2.remap(picture, *maps[:2], interpolation=cv2.INTER_LINEAR)[..., ::-1]
    assert np.array_equal(sequence.frame(0).color, wanted) and sequence.lens == "5 distortion coefficients undone"


def test_a_depth_camera_by_another_programs_file(make: Callable[[str], Path], tmp_path: Path) -> None:
    """Intrinsics as ROS writes them, and T_color_depth beside: depth is registered as by our own file."""
    folder, T = make("folder"), "T_color_depth: [1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
    theirs, ours = tmp_path / "ros.yaml", tmp_path / "ours.yaml"
    theirs.write_text(ros("plumb_bob", (0.0,) * 5))
    with pytest.raises(SequenceError, match=r"ros\.yaml.*T_color_depth"):
        open_sequence(folder, depth_camera=theirs)
    theirs.write_text(ros("plumb_bob", (0.0,) * 5) + T)
    ours.write_text(f"width: 640\nheight: 480\nfx: {FX}\nfy: {FY}\ncx: {CX}\ncy: {CY}\n{T}")
    depths = [open_sequence(folder, depth_camera=path).frame(2).depth for path in (theirs, ours)]
    assert np.array_equal(*depths) and (depths[0] > 0).mean() > 0.5


def test_a_depth_scale_that_contradicts_the_recording_is_said(make: Callable[[str], Path], tmp_path: Path) -> None:
    path = tmp_path / "orb.yaml"
    path.write_text(ORB2)
    same = make("folder")  # 5000 units a metre, too
    assert open_sequence(same, camera=path).warnings == []
    other = make("scannet")
    sequence = open_sequence(other, camera=path)
    assert sequence.depth_scale == 5000
    assert any(re.search(r"orb\.yaml .*\b5000 .*\(scannet\) 1000: 5000\b", text)
               for text in sequence.warnings)  # fmt: skip
    told = open_sequence(other, camera=path, depth_scale=1000)
    assert told.depth_scale == 1000 and not any("depth units" in text for text in told.warnings)
    (same / "camera.yaml").write_text((same / "camera.yaml").read_text().replace("5000", "1000"))
    assert re.search(r"\b5000 depth units .*\(folder\) 1000\b", open_sequence(same, camera=path).warnings[0])


@pytest.mark.parametrize("name", ["orb-slam2", "ros plumb_bob", "open3d", "colmap opencv"])
def test_a_file_in_the_folder_is_found(make: Callable[[str], Path], name: str) -> None:
    folder = make("folder")
    (folder / "camera.yaml").unlink()
    suffix = Path(CASES[name][0]).suffix
    file = {".yaml": "calibration.yaml", ".json": "intrinsic.json", ".txt": "cameras.txt"}[suffix]
    (folder / file).write_text(CASES[name][1])
    sequence = open_sequence(folder, depth_scale=5000)
    assert sequence.camera_source == f"{file}, scaled from 640x480 to images of 32x24"
    assert sequence.native_camera == CASES[name][2].resize(32, 24)
    (folder / "poses.txt").unlink()
    rate = "30 frames/s of calibration.yaml" if name == "orb-slam2" else "nominal 30 frames/s"
    assert open_sequence(folder, depth_scale=5000).time_source == rate
    (folder / "K.txt").write_text("1 1 1 1")
    with pytest.raises(SequenceError, match=rf"{file}.*`camera`"):
        open_sequence(folder, depth_scale=5000)
    assert open_sequence(folder, depth_scale=5000, intrinsics="30 31 15 11").camera.fx == 30


def test_a_file_in_a_folder_like_tums_goes_before_the_default(make: Callable[[str], Path]) -> None:
    folder = make("tum").rename(make("folder").parent / "walk")
    assert open_sequence(folder).camera.fx == pytest.approx(525 * 32 / 640)
    (folder / "K.txt").write_text("30 0 15\n0 31 11\n0 0 1\n")
    sequence = open_sequence(folder)
    assert sequence.native_camera == Camera(32, 24, 30, 31, 15, 11) and sequence.camera_source == "K.txt"
    assert sequence.warnings == []


FIELD = ("K.txt", "open3d.json", "orb.yaml", "ros.yaml", "ros_opencv.yaml")


@pytest.mark.parametrize("file", FIELD)
def test_files_from_the_field(shared_data: Path, file: str) -> None:
    recordings = shared_data / "field" / "recordings"
    if not recordings.is_dir():
        pytest.skip(f"no recordings from the field at {recordings}")
    path = recordings / "calibrations" / file
    told = ggslam("inspect", recordings / "no_yaml", "--format", "folder", "--depth-scale", 5000, "--camera", path)
    assert "160x120, fx 120.00 fy 120.00 cx 79.50 cy 59.50" in told.stdout
    refused = ggslam("inspect", recordings / "no_yaml", "--camera", recordings / "calibrations" / "d435_0.015.yaml")
    assert refused.returncode == 2 and "give it as --depth-camera" in refused.stderr
