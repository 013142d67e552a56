# SPDX-License-Identifier: Apache-2.0
"""Small recordings in the true format of phones' apps, data sets with JSON, and ROS. Each is written without the
reader's code; depth of frame i is 1 + i/10 m, its colour (10 i, 100, 200), its pose `pose(i)`."""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tiny_recordings import FRAMES, HEIGHT, WIDTH, pose, rows, write_color, write_depth, write_mask

FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])


def opengl(i: int) -> np.ndarray:
    """The pose with OpenGL's camera axes: y and z of the camera turned round."""
    return pose(i) @ FLIP_YZ


def quaternion_xyzw(T: np.ndarray) -> list[float]:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(T[:3, :3]).as_quat().tolist()


def color_bgr(i: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    image = np.empty((size[1], size[0], 3), np.uint8)
    image[:] = (200, 100, 10 * i)
    return image


def depth_mm(i: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    image = np.full((size[1], size[0]), 1000 + 100 * i, np.uint16)
    image[0, 0] = 0
    return image


def confidence(size: tuple[int, int] = (WIDTH, HEIGHT), levels: tuple[int, int, int] = (0, 1, 2)) -> np.ndarray:
    """High, but the first column low and the second medium."""
    image = np.full((size[1], size[0]), levels[2], np.uint8)
    image[:, 0], image[:, 1] = levels[0], levels[1]
    return image


def make_vmap(folder: Path) -> Path:
    root = folder / "imap" / "00"
    for i in range(FRAMES):
        write_color(root / "rgb" / f"rgb_{i}.png", i, (60, 34))
        write_depth(root / "depth" / f"depth_{i}.png", i, 1000, (60, 34))
        write_mask(root / "semantic_instance" / f"semantic_instance_{i}.png", i, (60, 34), np.uint16)
    (root / "traj_w_c.txt").write_text(rows([pose(i) for i in range(FRAMES)]))
    return folder


def make_icl_nuim(folder: Path) -> Path:
    """Frames are numbered from 1; poses are those of a camera with y up in a world with y up."""
    flip_y = np.diag([1.0, -1.0, 1.0, 1.0])
    associations = truth = ""
    for i in range(FRAMES):
        write_color(folder / "rgb" / f"{i + 1}.png", i)
        write_depth(folder / "depth" / f"{i + 1}.png", i, 5000)
        associations += f"{i + 1} depth/{i + 1}.png {i + 1} rgb/{i + 1}.png\n"
        T = flip_y @ pose(i) @ flip_y
        truth += f"{i + 1} " + " ".join(f"{x:.9f}" for x in (*T[:3, 3], *quaternion_xyzw(T))) + "\n"
    (folder / "associations.txt").write_text(associations)
    (folder / "livingRoom0n.gt.freiburg").write_text(truth)
    return folder


def transforms(folder: Path, depth_key: str = "depth_file_path", **entries: Any) -> dict[str, Any]:
    frames = [
        {"file_path": f"images/{i}.png", depth_key: f"depth/{i}.png", "transform_matrix": opengl(i).tolist()}
        for i in range(FRAMES)
    ]
    intrinsics = {"fl_x": 30.0, "fl_y": 31.0, "cx": 15.5, "cy": 11.5, "w": WIDTH, "h": HEIGHT}
    return {**intrinsics, "camera_model": "OPENCV", **entries, "frames": frames}


def make_nerfstudio(folder: Path) -> Path:
    for i in range(FRAMES):
        write_color(folder / "images" / f"{i}.png", i)
        write_depth(folder / "depth" / f"{i}.png", i, 1000)
    (folder / "transforms.json").write_text(json.dumps(transforms(folder)))
    return folder


def make_nerfcapture(folder: Path) -> Path:
    """Names without suffix for colour, its own unit of depth, intrinsics in every frame."""
    content = transforms(folder, "depth_path", integer_depth_scale=10.0 / 65535)
    for i, frame in enumerate(content["frames"]):
        write_color(folder / "images" / f"{i}.png", i)
        write_depth(folder / "images" / f"{i}.depth.png", i, 6553.5)
        frame |= {key: content[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
        frame |= {"file_path": f"images/{i}", "depth_path": f"images/{i}.depth.png"}
    kept = {"integer_depth_scale", "frames"}
    (folder / "transforms.json").write_text(json.dumps({k: v for k, v in content.items() if k in kept}))
    return folder


def make_scannetpp_dslr(folder: Path) -> Path:
    root = folder / "dslr"
    content = transforms(folder)
    for i, frame in enumerate(content["frames"]):
        write_color(root / "undistorted_images" / f"DSC0{i}.JPG", i)
        write_depth(root / "undistorted_depths" / f"DSC0{i}.png", i, 1000)
        del frame["depth_file_path"]
        frame |= {"file_path": f"DSC0{i}.JPG", "is_bad": False}
    content["test_frames"] = [content["frames"].pop()]
    content["frames"].append({**content["frames"][0], "file_path": "DSC09.JPG", "is_bad": True})
    (root / "nerfstudio").mkdir()
    (root / "nerfstudio" / "transforms_undistorted.json").write_text(json.dumps(content))
    return folder


def make_scannetpp_iphone(folder: Path) -> Path:
    root, frames = folder / "iphone", {}
    for i in range(FRAMES):
        write_color(root / "rgb" / f"frame_{10 * i:06d}.jpg", i, (64, 48))
        write_depth(root / "depth" / f"frame_{10 * i:06d}.png", i, 1000)
        K = [[1800.0, 0, 959.5], [0, 1800.0, 719.5], [0, 0, 1]]
        frames[f"frame_{10 * i:06d}"] = {"aligned_pose": pose(i).tolist(), "intrinsic": K, "timestamp": 5.0 + i / 6}
    (root / "pose_intrinsic_imu.json").write_text(json.dumps(frames))
    return folder


def make_record3d(folder: Path, compress: bool = True) -> Path:
    """Colour of twice the size of depth, LZFSE as the app writes it, or bytes as they are."""
    path = folder / "walk.r3d"
    pack: Callable[[bytes], bytes] = bytes
    if compress:
        pack = pytest.importorskip("liblzfse").compress
    metadata = {
        "w": 64, "h": 48, "dw": WIDTH, "dh": HEIGHT, "fps": 60, "K": [60.0, 0, 0, 0, 62.0, 0, 31.5, 23.5, 1],
        "poses": [[*quaternion_xyzw(opengl(i)), *opengl(i)[:3, 3]] for i in range(FRAMES)],
        "frameTimestamps": [100 + i / 60 for i in range(FRAMES)],
    }  # fmt: skip
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(metadata))
        for i in range(FRAMES):
            archive.writestr(f"rgbd/{i}.jpg", cv2.imencode(".jpg", color_bgr(i, (64, 48)))[1].tobytes())
            depth = depth_mm(i).astype(np.float32) / 1000
            depth[0, 0] = np.nan
            archive.writestr(f"rgbd/{i}.depth", pack(depth.tobytes()))
            archive.writestr(f"rgbd/{i}.conf", pack(confidence().tobytes()))
    return path


def make_polycam(folder: Path) -> Path:
    root = folder / "keyframes"
    for i in range(FRAMES):
        name = f"{1000 + i}"
        write_color(root / "images" / f"{name}.jpg", i, (64, 48))
        write_depth(root / "depth" / f"{name}.png", i, 1000)
        (root / "confidence").mkdir(exist_ok=True)
        assert cv2.imwrite(str(root / "confidence" / f"{name}.png"), confidence(levels=(0, 54, 255)))
        camera = {"fx": 60.0, "fy": 62.0, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48, "blur_score": 90.0}
        camera |= {f"t_{r}{c}": float(opengl(i)[r, c]) for r in range(3) for c in range(4)}
        (root / "cameras").mkdir(exist_ok=True)
        (root / "cameras" / f"{name}.json").write_text(json.dumps(camera))
    (folder / "mesh_info.json").write_text("{}")
    return folder


def write_video(path: Path, frames: list[np.ndarray]) -> None:
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 60, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()


def make_stray(folder: Path) -> Path:
    write_video(folder / "rgb.mp4", [color_bgr(i, (128, 96)) for i in range(FRAMES)])
    table = "timestamp, frame, x, y, z, qx, qy, qz, qw\n"
    (folder / "confidence").mkdir()
    for i in range(FRAMES):
        write_depth(folder / "depth" / f"{i:06d}.png", i, 1000)
        assert cv2.imwrite(str(folder / "confidence" / f"{i:06d}.png"), confidence())
        numbers = ", ".join(f"{x:.9f}" for x in (*pose(i)[:3, 3], *quaternion_xyzw(pose(i))))
        table += f"{7 + i / 60:.6f}, {i:06d}, {numbers}\n"
    (folder / "odometry.csv").write_text(table)
    (folder / "camera_matrix.csv").write_text("120, 0, 63.5\n0, 124, 47.5\n0, 0, 1\n")
    return folder


def make_scanner_app(folder: Path) -> Path:
    """3D Scanner App with colour of every frame; poses and intrinsics row by row."""
    for i in range(FRAMES):
        write_color(folder / f"frame_{i:05d}.jpg", i, (128, 96))
        write_depth(folder / f"depth_{i:05d}.png", i, 1000)
        assert cv2.imwrite(str(folder / f"conf_{i:05d}.png"), confidence())
        content = {
            "cameraPoseARFrame": opengl(i).ravel().tolist(), "frame_index": i, "time": 7 + i / 60,
            "intrinsics": [120.0, 0, 63.5, 0, 124.0, 47.5, 0, 0, 1],
        }  # fmt: skip
        (folder / f"frame_{i:05d}.json").write_text(json.dumps(content))
    (folder / "info.json").write_text("{}")
    return folder


def make_rtabmap(folder: Path, prefix: str = "", T_robot_camera: np.ndarray | None = None) -> Path:
    """Node ids are 2, 3, 5, 6, 8; poses bear ids, in another order; with a `T_robot_camera` they are the robot's."""
    lines = ["#timestamp x y z qx qy qz qw id"]
    for i, node in enumerate((2, 3, 5, 6, 8)):
        write_color(folder / f"{prefix}rgb" / f"{node}.png", i)
        write_depth(folder / f"{prefix}depth" / f"{node}.png", i, 1000)
        file = folder / f"{prefix}calib" / f"{node}.yaml"
        file.parent.mkdir(exist_ok=True)
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
        storage.write("camera_name", str(node))
        storage.write("image_width", WIDTH)
        storage.write("image_height", HEIGHT)
        storage.write("camera_matrix", np.array([[30.0, 0, 15], [0, 31, 11], [0, 0, 1]]))
        storage.write("distortion_model", "plumb_bob")
        storage.write("distortion_coefficients", np.zeros((1, 5)))
        if T_robot_camera is not None:
            storage.write("local_transform", np.ascontiguousarray(T_robot_camera[:3]))
        storage.release()
        T = pose(i) if T_robot_camera is None else pose(i) @ np.linalg.inv(T_robot_camera)
        numbers = (1000 + node / 30, *T[:3, 3], *quaternion_xyzw(T))
        lines.insert(1, " ".join(f"{x:.9f}" for x in numbers) + f" {node}")
    (folder / f"{prefix}poses.txt").write_text("\n".join(lines) + "\n")
    return folder


class BagMessages:
    """Messages in the layout of realsense-ros; colour and depth compressed or raw, depth in millimetres or metres."""

    def __init__(self, ros2: bool, compressed: bool, metres: bool) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.ros2, self.compressed, self.metres = ros2, compressed, metres
        self.store = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
        self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
        self.types: Any = {name.split("/")[-1]: kind for name, kind in self.store.types.items()}
        self.types["Time"] = self.store.types["builtin_interfaces/msg/Time"]  # there is a std_msgs/Time too

    def header(self, time: float, frame: str) -> Any:
        stamp = self.types["Time"](sec=int(time), nanosec=round(time % 1 * 1e9))
        return self.types["Header"](**({} if self.ros2 else {"seq": 0}), stamp=stamp, frame_id=frame)

    def image(self, time: float, frame: str, encoding: str, pixels: np.ndarray, form: str, head: bytes = b"") -> Any:
        if self.compressed:
            data = np.frombuffer(head + cv2.imencode(".png", pixels)[1].tobytes(), np.uint8)
            return self.types["CompressedImage"](header=self.header(time, frame), format=form, data=data)
        return self.types["Image"](
            header=self.header(time, frame), height=pixels.shape[0], width=pixels.shape[1], encoding=encoding,
            is_bigendian=0, step=pixels.strides[0], data=np.frombuffer(pixels.tobytes(), np.uint8),
        )  # fmt: skip

    def depth(self, i: int, time: float, frame: str) -> Any:
        raw: np.ndarray = depth_mm(i)
        head = b"\0" * 12
        if self.metres and self.compressed:  # A / depth + B, as compressed_depth_image_transport writes it
            a, b = 101.0 * 100, 1 - 101.0 * 100 / 10
            with np.errstate(divide="ignore"):
                raw = np.where(raw > 0, a / (raw / 1000) + b, 0).astype(np.uint16)
            head = struct.pack("<iff", 1, a, b)
        elif self.metres:
            raw = np.where(raw > 0, raw / 1000, np.nan).astype(np.float32)
        kind = "32FC1" if self.metres else "16UC1"
        return self.image(time, frame, kind, raw, f"{kind}; compressedDepth png", head)

    def info(self, frame: str, d: tuple[float, ...], model: str) -> Any:
        names = ("d", "k", "r", "p") if self.ros2 else ("D", "K", "R", "P")
        K = np.array([30.0, 0, 15, 0, 31, 11, 0, 0, 1])
        matrices = (np.array(d, float), K, np.eye(3).ravel(), np.insert(K, [3, 6, 9], 0))
        roi = self.types["RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self.types["CameraInfo"](
            header=self.header(1, frame), height=HEIGHT, width=WIDTH, distortion_model=model,
            **dict(zip(names, matrices, strict=True)), binning_x=0, binning_y=0, roi=roi,
        )  # fmt: skip

    def posed(self, i: int, time: float) -> Any:
        T, q = pose(i), quaternion_xyzw(pose(i))
        at = self.types["Pose"](
            position=self.types["Point"](x=T[0, 3], y=T[1, 3], z=T[2, 3]),
            orientation=self.types["Quaternion"](x=q[0], y=q[1], z=q[2], w=q[3]),
        )
        return self.types["PoseStamped"](header=self.header(time, "map"), pose=at)

    def link(self, frame: str, child: str) -> Any:
        """The child's place in the frame: 5 cm along x."""
        transform = self.types["Transform"](
            translation=self.types["Vector3"](x=0.05, y=0.0, z=0.0),
            rotation=self.types["Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        )
        stamped = self.types["TransformStamped"]
        link = stamped(header=self.header(999.9, frame), child_frame_id=child, transform=transform)
        return self.types["TFMessage"](transforms=[link])

    def raw(self, kind: str, message: Any) -> Any:
        return self.store.serialize_cdr(message, kind) if self.ros2 else self.store.serialize_ros1(message, kind)


def write_bag(
    path: Path, ros2: bool, compressed: bool = False, metres: bool = False, registered: bool = True,
    count: int = FRAMES, d: tuple[float, ...] = (), model: str = "plumb_bob",
) -> Path:  # fmt: skip
    """A bag in the layout of realsense-ros: colour, depth 5 ms later, camera_info, poses on a topic of their own."""
    writer_module = pytest.importorskip("rosbags.rosbag2" if ros2 else "rosbags.rosbag1")
    messages = BagMessages(ros2, compressed, metres)
    writer = writer_module.Writer(path, version=9) if ros2 else writer_module.Writer(path)
    base = "/camera/aligned_depth_to_color" if registered else "/camera/depth"
    frame_of_depth = "color_optical" if registered else "depth_optical"
    images, suffix = ("CompressedImage", "/compressed") if compressed else ("Image", "")
    depth_topic = f"{base}/image_raw" + ("/compressedDepth" if compressed else "")
    sent: list[tuple[str, str, float, Any]] = [
        ("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", 999.9, messages.info("color_optical", d, model)),
        (f"{base}/camera_info", "sensor_msgs/msg/CameraInfo", 999.9, messages.info(frame_of_depth, d, model)),
    ]
    if not registered:
        sent.append(("/tf_static", "tf2_msgs/msg/TFMessage", 999.9, messages.link("depth_optical", "color_optical")))
    for i in range(count):
        time = 1000 + i / 30
        picture = messages.image(time, "color_optical", "bgr8", color_bgr(i), "bgr8; png compressed bgr8")
        depth = messages.depth(i, time + 0.005, frame_of_depth)
        sent.append((f"/camera/color/image_raw{suffix}", f"sensor_msgs/msg/{images}", time, picture))
        sent.append((depth_topic, f"sensor_msgs/msg/{images}", time + 0.005, depth))
        sent.append(("/poses", "geometry_msgs/msg/PoseStamped", time, messages.posed(i, time)))
    with writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=messages.store) for topic, kind, _, _ in sent
            if not any(topic == other.topic for other in writer.connections)
        }  # fmt: skip
        for topic, kind, time, message in sent:
            writer.write(connections[topic], round((time + 0.2) * 1e9), messages.raw(kind, message))
    return path


MORE_MAKERS: dict[str, Callable[[Path], Path]] = {
    "vmap": make_vmap, "icl-nuim": make_icl_nuim, "nerfstudio": make_nerfstudio, "nerfcapture": make_nerfcapture,
    "scannet++": make_scannetpp_dslr, "scannet++ iphone": make_scannetpp_iphone, "record3d": make_record3d,
    "polycam": make_polycam, "strayscanner": make_stray, "3dscannerapp": make_scanner_app,
    "rtabmap": make_rtabmap,
    "ros1": lambda folder: write_bag(folder / "walk.bag", False),
    "ros2": lambda folder: write_bag(folder / "walk", True),
}  # fmt: skip
