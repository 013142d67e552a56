# SPDX-License-Identifier: Apache-2.0
"""Coloured clouds: every common way to store them is read, what is written is read back, damaged files are refused."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
import torch

from ggslam.errors import FormatError
from ggslam.formats import lzf
from ggslam.formats.cloud_files import read_cloud_file
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.formats.pcd import parse_pcd, pcd_bytes
from ggslam.formats.ply import write_ply
from ggslam.formats.point_cloud import read_point_cloud, write_point_cloud
from ggslam.formats.point_ply import write_points
from ggslam.formats.point_sampling import VoxelCloud
from ggslam.scene.gaussian_map import GaussianMap

POINTS = np.array([[0.5, -1.25, 2.0], [3.0, 4.5, -6.75], [7.125, 8.0, 9.0]])
COLORS = np.array([[255, 0, 51], [0, 102, 255], [7, 8, 9]], np.uint8)
LABELS = np.array([-1, 0, 70_000], np.int32)


def ply_text(encoding: str, color: tuple[str, ...], color_type: str) -> str:
    names = "".join(f"property {color_type} {name}\n" for name in color)
    normals = "".join(f"property float n{axis}\n" for axis in "xyz")
    return (
        f"ply\nformat {encoding} 1.0\nelement vertex 3\nproperty double x\nproperty double y\nproperty double z\n"
        f"{normals}{names}property int label\nend_header\n"
    )


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(
    ("names", "color_type", "code", "scale"),
    [
        (("red", "green", "blue"), "uchar", "u1", 1),
        (("r", "g", "b"), "float", "f4", 1 / 255),
        (("diffuse_red", "diffuse_green", "diffuse_blue"), "double", "f8", 1 / 255),
        (("Red", "Green", "Blue"), "float", "f4", 1),
        (("red", "green", "blue"), "ushort", "u2", 257),
    ],
)
def test_every_kind_of_ply(
    tmp_path: Path, encoding: str, names: tuple[str, ...], color_type: str, code: str, scale: float
) -> None:
    order = ">" if "big" in encoding else "<"
    fields = [(n, order + "f8") for n in "xyz"] + [(f"n{n}", order + "f4") for n in "xyz"]
    rows = np.zeros(3, [*fields, *((n, order + code) for n in names), ("label", order + "i4")])
    for axis, name in enumerate("xyz"):
        rows[name] = POINTS[:, axis]
    for channel, name in enumerate(names):
        rows[name] = COLORS[:, channel] * float(scale)
    rows["label"] = LABELS
    path = tmp_path / "a.ply"
    body = rows.tobytes()
    if encoding == "ascii":
        body = "\n".join(" ".join(repr(value.item()) for value in row) for row in rows).encode()
    path.write_bytes(ply_text(encoding, names, color_type).encode() + body)
    cloud = read_point_cloud(path)
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_array_equal(cloud.colors, COLORS)
    assert list(cloud.labels) == ["label"] and cloud.labels["label"].tolist() == LABELS.tolist()
    assert cloud.left_out == ("nx", "ny", "nz") and cloud.grid is None


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32])
@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_what_is_written_is_read_back(tmp_path: Path, dtype: type, suffix: str) -> None:
    path, points = tmp_path / f"a{suffix}", POINTS.astype(dtype)
    velocity = np.array([[1, -2], [3, 4], [5, 6]], np.int64)
    attributes = {"color": COLORS, "object_id": LABELS, "velocity": velocity, "kind": np.array([1, 2, 3], np.uint16)}
    write_point_cloud(path, points, attributes, ["made here"] if suffix == ".ply" else ())
    cloud = read_point_cloud(path)
    np.testing.assert_array_equal(cloud.points, points)
    np.testing.assert_array_equal(cloud.colors, COLORS)
    assert cloud.labels["object_id"].tolist() == LABELS.tolist() and cloud.labels["kind"].tolist() == [1, 2, 3]
    assert cloud.labels["velocity_1"].tolist() == [-2, 4, 6] and cloud.left_out == ()
    with pytest.raises(FormatError, match="32 bits"):
        write_point_cloud(path, points, {"label": np.array([0, 0, 1 << 40])})


def lzf_compressed(data: bytes) -> bytes:
    """A plain compressor: the longest match that begins at the last place with the same three bytes."""
    out, literals, places, at = bytearray(), bytearray(), {}, 0

    def flush() -> None:
        for start in range(0, len(literals), 32):
            part = literals[start : start + 32]
            out.extend(bytes([len(part) - 1]) + part)
        literals.clear()

    while at < len(data):
        key, found = data[at : at + 3], places.get(data[at : at + 3])
        places[key] = at
        if found is None or len(key) < 3 or at - found > 1 << 13:
            literals.append(data[at])
            at += 1
            continue
        length = 3
        while length < 264 and at + length < len(data) and data[found + length] == data[at + length]:
            length += 1
        flush()
        distance = at - found - 1
        if length - 2 < 7:
            out.append((length - 2) << 5 | distance >> 8)
        else:
            out.extend([7 << 5 | distance >> 8, length - 9])
        out.append(distance & 255)
        at += length
    flush()
    return bytes(out)


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("packed", ["F", "U"])
def test_every_kind_of_pcd(tmp_path: Path, encoding: str, packed: str) -> None:
    bits = (COLORS.astype(np.uint32) << [16, 8, 0]).sum(1, dtype=np.uint32)
    rows = np.zeros(4, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("pad", "u1", (4,)), ("rgb", "<u4"), ("id", "<i2")])
    for axis, name in enumerate("xyz"):
        rows[name] = [*POINTS[:, axis], np.nan]
    rows["rgb"], rows["id"] = [*bits, 0], [-5, 6, 7, 8]
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ rgb id\nSIZE 4 4 4 1 4 2\n"
        f"TYPE F F F U {packed} I\nCOUNT 1 1 1 4 1 1\nWIDTH 2\nHEIGHT 2\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4\nDATA {encoding}\n"
    )
    body = rows.tobytes()
    if encoding == "binary_compressed":
        columns = b"".join(rows[name].tobytes() for name in rows.dtype.names or ())
        squeezed = lzf_compressed(columns)
        body = np.array([len(squeezed), len(columns)], "<u4").tobytes() + squeezed
    elif encoding == "ascii":
        rgb = [np.format_float_scientific(v) for v in rows["rgb"].view(np.float32)] if packed == "F" else rows["rgb"]
        lines = [f"{r['x']} {r['y']} {r['z']} 0 0 0 0 {v} {r['id']}" for r, v in zip(rows, rgb, strict=True)]
        body = "\n".join(lines).encode()
    path = tmp_path / "a.pcd"
    path.write_bytes(header.encode() + body)
    cloud = read_point_cloud(path)
    np.testing.assert_array_equal(cloud.points, POINTS)  # the pixel without a position is gone
    np.testing.assert_array_equal(cloud.colors, COLORS)
    assert cloud.labels["id"].tolist() == [-5, 6, 7]
    for length in range(len(header) + len(body) - (3 if encoding == "ascii" else 0)):
        path.write_bytes((header.encode() + body)[:length])
        with pytest.raises(FormatError, match=r"a\.pcd"):
            read_point_cloud(path)


def test_lzf_inverts_a_compressor_and_refuses_damage() -> None:
    generator = np.random.default_rng(0)
    for data in (
        b"", b"a", b"a" * 1000, b"abc" * 5000, bytes(generator.integers(0, 256, 3000, np.uint8)),
        bytes(generator.integers(0, 3, 20_000, np.uint8)), bytes(9000) + b"x" + bytes(9000),
    ):  # fmt: skip
        packed = lzf_compressed(data)
        assert lzf.decompress(packed, len(data)) == data
        for size in (len(data) + 1, len(data) - 1, 1 << 40):
            with pytest.raises(ValueError, match="compressed"):
                lzf.decompress(packed, size)
    assert lzf.decompress(b"\x02abc\xe0\x00\x02", 12) == b"abcabcabcabc"  # the source reaches into the copy
    with pytest.raises(ValueError, match="before the data"):
        lzf.decompress(b"\x00a\x20\x05", 4)
    for _ in range(300):  # whatever the bytes, a plain error or exactly the wanted size
        noise = bytes(generator.integers(0, 256, 40, np.uint8))
        with contextlib.suppress(ValueError):
            assert len(lzf.decompress(noise, 60)) == 60


def lzf_expanded(packed: bytes) -> bytes:
    """A plain decompressor, byte by byte."""
    out, at = bytearray(), 0
    while at < len(packed):
        control, at = packed[at], at + 1
        if control < 32:
            out, at = out + packed[at : at + control + 1], at + control + 1
            continue
        length = control >> 5
        if length == 7:
            length, at = 7 + packed[at], at + 1
        distance, at = ((control & 31) << 8) + packed[at] + 1, at + 1
        for _ in range(length + 2):
            out.append(out[-distance])
    return bytes(out)


def test_lzf_compresses_into_what_anyone_expands() -> None:
    generator = np.random.default_rng(0)
    for data in (
        b"", b"a", b"ab", b"aaa", b"a" * 1000, b"abc" * 5000, bytes(generator.integers(0, 256, 3000, np.uint8)),
        bytes(generator.integers(0, 3, 20_000, np.uint8)), bytes(9000) + b"x" + bytes(9000),
        *(bytes(generator.integers(0, 2, n, np.uint8)) * 3 for n in range(1, 300)),
        bytes(generator.integers(0, 256, 8192, np.uint8)) * 2, bytes(generator.integers(0, 256, 8193, np.uint8)) * 2,
    ):  # fmt: skip
        packed = lzf.compress(data)
        assert lzf_expanded(packed) == data == lzf.decompress(packed, len(data))
        assert len(packed) <= len(data) + len(data) // 32 + 1
    assert len(lzf.compress(b"abc" * 5000)) < 200
    block = bytes(generator.integers(0, 256, 8192, np.uint8))
    assert len(lzf.compress(block * 2)) < 9000  # 8192 bytes back is the farthest that can be said


@pytest.mark.parametrize("compressed", [False, True])
def test_fields_of_several_numbers_and_compression(compressed: bool) -> None:
    columns = {
        "x": np.arange(3000, dtype=np.float32), "color": np.tile(COLORS, (1000, 1)), "far": np.arange(3000) * 1e9,
        "big": np.arange(3000, dtype=">i4"),
    }  # fmt: skip
    data = pcd_bytes(columns, compressed)
    assert (b"DATA binary_compressed" in data) == compressed and b"COUNT 1 3 1 1" in data
    rows = parse_pcd(data, "a.pcd")
    for name, values in columns.items():
        np.testing.assert_array_equal(rows[name], values)
    assert compressed == (len(data) < len(pcd_bytes(columns)))
    noise = {"x": np.random.default_rng(0).integers(0, 1 << 63, 500)}
    assert pcd_bytes(noise, compressed) == pcd_bytes(noise)  # what does not shrink is written as it is
    assert len(parse_pcd(pcd_bytes({"x": np.empty(0)}, compressed), "a.pcd")) == 0


def test_gaussian_maps_give_their_colours_and_object_ids(tmp_path: Path) -> None:
    gaussians = GaussianMap(1)
    gaussians.insert(
        torch.tensor(POINTS, dtype=torch.float32), torch.ones(3, 4), torch.zeros(3, 3), torch.zeros(3),
        torch.tensor(COLORS / 255.0, dtype=torch.float32), object_id=torch.tensor([3, 0, 9]),
    )  # fmt: skip
    write_gaussian_ply(tmp_path / "map.ply", gaussians, extra=("object_id",))
    cloud = read_point_cloud(tmp_path / "map.ply")
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_array_equal(cloud.colors, COLORS)
    assert cloud.labels["object_id"].tolist() == [3, 0, 9] and "opacity" in cloud.left_out


def test_voxel_clouds_know_their_grid(tmp_path: Path) -> None:
    grid = np.array([[0, 3, 5], [1, 0, 70], [900, 2, 0]], np.int32)
    written = VoxelCloud(grid, COLORS, np.array([1, 0, 2], np.int32), 0.01, np.array([-1.23, 0.5, 2.0]))
    write_points(tmp_path, written)
    for name in ("points.ply", "points_grid.ply"):
        cloud = read_point_cloud(tmp_path / name)
        np.testing.assert_array_equal(cloud.grid, grid)
        np.testing.assert_array_equal(cloud.points, written.points)
        assert cloud.voxel_size == 0.01 and cloud.labels["object_id"].tolist() == [1, 0, 2]


def vertices(**columns: list[float]) -> np.ndarray:
    count = len(next(iter(columns.values())))
    rows = np.zeros(count, [(name, "f4") for name in columns])
    for name, values in columns.items():
        rows[name] = values
    return rows


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        (vertices(x=[1], y=[2]), "missing z"),
        (vertices(x=[1, 2], y=[1, float("nan")], z=[float("inf"), 2]), "\\b2 points.*position"),
        (vertices(x=[], y=[], z=[]), "no points"),
        (vertices(x=[1], y=[1], z=[1], red=[0], green=[-3], blue=[0]), "0 to 255"),
        (vertices(x=[1], y=[1], z=[1], red=[0], green=[float("inf")], blue=[0]), "colour of point 0"),
    ],
)
def test_impossible_clouds_are_refused(tmp_path: Path, rows: np.ndarray, reason: str) -> None:
    write_ply(tmp_path / "bad.ply", {"vertex": rows})
    with pytest.raises(FormatError, match=rf"bad\.ply.*{reason}"):
        read_point_cloud(tmp_path / "bad.ply")


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("POINTS 1", "POINTS 1000000000000", "claims"),
        ("WIDTH 1", "WIDTH one", "damaged"),
        ("SIZE 4 4 4", "SIZE 4 4", "differ in length"),
        ("SIZE 4 4 4", "SIZE 4 4 2", "size 2"),
        ("FIELDS x y z", "FIELDS x y y", "declared twice"),
        ("FIELDS x y z", "FIELDS x y w", "missing z"),
        ("TYPE F F F\n", "", "TYPE"),
        ("DATA ascii", "DATA letters", "expected ascii"),
        ("VERSION", "VARSION", "PCD"),
        ("1 2 3", "1 2 x", "x"),
    ],
)
def test_damaged_pcd_headers_are_refused(tmp_path: Path, old: str, new: str, reason: str) -> None:
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    text = f"{head}WIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n1 2 3\n"
    (tmp_path / "bad.pcd").write_text(text)
    assert read_point_cloud(tmp_path / "bad.pcd").points.tolist() == [[1, 2, 3]]
    (tmp_path / "bad.pcd").write_text(text.replace(old, new))
    with pytest.raises(FormatError, match=reason):
        read_point_cloud(tmp_path / "bad.pcd")


def test_padding_of_no_bytes(tmp_path: Path) -> None:
    """As drivers of LiDARs write it: fields called _ whose COUNT is 0."""
    rows = np.zeros(3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("pad", "u1", (4,)), ("intensity", "<f4"),
                        ("ring", "u1"), ("range", "<u4"), ("end", "u1", (15,))])  # fmt: skip
    for axis, name in enumerate("xyz"):
        rows[name] = POINTS[:, axis]
    rows["intensity"], rows["ring"], rows["range"], rows["pad"] = [0, 1, 2], [7, 8, 9], [1, 1 << 31, 5], 200
    head = (
        "VERSION 0.7\nFIELDS x y z _ intensity ring _ range _\nSIZE 4 4 4 1 4 1 1 4 1\nTYPE F F F U F U U U U\n"
        "COUNT 1 1 1 4 1 1 0 1 15\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA "
    )
    for encoding, body in (
        ("binary", rows.tobytes()),
        ("ascii", b"\n".join(" ".join(str(v) for v in [r["x"], r["y"], r["z"], *r["pad"], r["intensity"], r["ring"],
                                                       r["range"], *r["end"]]).encode() for r in rows)),
    ):  # fmt: skip
        (tmp_path / "a.pcd").write_bytes(f"{head}{encoding}\n".encode() + body)
        cloud = read_point_cloud(tmp_path / "a.pcd")
        np.testing.assert_array_equal(cloud.points, POINTS)
        assert cloud.reflectance is not None and cloud.reflectance.tolist() == [0, 1, 2]
        assert cloud.labels["ring"].tolist() == [7, 8, 9] and cloud.labels["range"].tolist() == [1, 1 << 31, 5]
    (tmp_path / "a.pcd").write_bytes(head.replace("1 1 1 4 1 1 0 1 15", "0 0 0 0 0 0 0 0 0").encode() + b"binary\n")
    with pytest.raises(FormatError, match=r"a\.pcd.*COUNT"):
        read_point_cloud(tmp_path / "a.pcd")


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_capital_letters(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    write_point_cloud(path, POINTS, {"label": np.array([1, 2, 3])})
    path.write_bytes(path.read_bytes().replace(b" x y z", b" X Y Z").replace(b"double x", b"double X")
                     .replace(b"float64 x", b"float64 X").replace(b"float64 y", b"float64 Y")
                     .replace(b"float64 z", b"float64 Z"))  # fmt: skip
    assert b"X" in path.read_bytes()[:400]
    np.testing.assert_array_equal(read_point_cloud(path).points, POINTS)


@pytest.mark.parametrize(("name", "code"), [("int64", "<i8"), ("ulong", "<u8")])
def test_numbers_of_eight_bytes(tmp_path: Path, name: str, code: str) -> None:
    rows = np.zeros(3, [("x", "<f4"), ("t", code), ("y", "<f4"), ("z", "<f4")])
    for axis, axis_name in enumerate("xyz"):
        rows[axis_name] = POINTS[:, axis]
    rows["t"] = [1, 1_700_000_000_123_456_789, 3]
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty {name} t\n"
    text = f"{head}property float y\nproperty float z\nend_header\n".encode()
    (tmp_path / "a.ply").write_bytes(text + rows.tobytes())
    cloud = read_point_cloud(tmp_path / "a.ply")
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.labels["t"].tolist() == [1, 1_700_000_000_123_456_789, 3]


def cloud_files(folder: Path, points: np.ndarray) -> list[Path]:
    """The same points [N, 3] in files of every kind that is read."""
    rows = np.zeros(len(points), [(name, "<f4") for name in "xyz"])
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    text = "\n".join(" ".join(str(v) for v in row) for row in points.tolist()).encode()
    declared = "".join(f"property float {name}\n" for name in "xyz")
    files = {"a.npy": b"", "a.bin": points.astype("<f4").tobytes()}
    for encoding, body in (("ascii", text), ("binary_little_endian", rows.tobytes()),
                           ("binary_big_endian", rows.astype([(n, ">f4") for n in "xyz"]).tobytes())):  # fmt: skip
        head = f"ply\nformat {encoding} 1.0\nelement vertex {len(points)}\n{declared}end_header\n"
        files[f"{encoding}.ply"] = head.encode() + body
    columns = {name: points[:, axis].astype("<f4") for axis, name in enumerate("xyz")}
    squeezed = pcd_bytes(columns, compressed=True)
    plain = pcd_bytes(columns)
    files |= {"binary.pcd": plain, "compressed.pcd": squeezed,
              "ascii.pcd": plain[: plain.index(b"DATA")] + b"DATA ascii\n" + text}  # fmt: skip
    assert b"binary_compressed" in squeezed
    for name, content in files.items():
        (folder / name).write_bytes(content)
    np.save(folder / "a.npy", points)
    return [folder / name for name in files]


def test_points_without_a_position_are_left_out_by_every_reader(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rng = np.random.default_rng(0)
    points = np.repeat(rng.normal(size=(100, 3)), 5, axis=0).astype(np.float32).astype(np.float64)
    gone = np.sort(rng.choice(500, 72, replace=False))
    points[gone[:40]] = np.nan
    points[gone[40:60], 1] = np.inf
    points[gone[60:], 2] = -np.inf
    kept = np.delete(points, gone, axis=0)
    for path in cloud_files(tmp_path, points):
        caplog.clear()
        cloud = read_cloud_file(path, columns=3)
        np.testing.assert_array_equal(cloud.points, kept, err_msg=path.name)
        assert cloud.nowhere == 72, path
        assert [record.getMessage() for record in caplog.records] == [
            f"warning: {path}: left out 72 of 500 points that have no position (not a number)"
        ]
    caplog.clear()
    assert read_cloud_file(tmp_path / "binary.pcd", tell=False).nowhere == 72 and not caplog.records
    for path in cloud_files(tmp_path, np.full((200, 3), np.nan)):
        with pytest.raises(FormatError, match=r"\b200 points.*position"):
            read_cloud_file(path, columns=3)


def test_colours_and_ids_stay_with_their_points(tmp_path: Path) -> None:
    points = np.array([[1, 2, 3], [np.nan, 0, 0], [4, 5, 6]], np.float32)
    for name in ("a.ply", "a.pcd"):
        write_point_cloud(tmp_path / name, points, {"color": COLORS, "object_id": LABELS})
        cloud = read_point_cloud(tmp_path / name)
        assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]] and cloud.nowhere == 1
        np.testing.assert_array_equal(cloud.colors, COLORS[[0, 2]])
        assert cloud.labels["object_id"].tolist() == LABELS[[0, 2]].tolist()


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("1 2 3\n")
    with pytest.raises(FormatError, match=r"a\.txt.*PLY.*PCD"):
        read_point_cloud(tmp_path / "a.txt")
    with pytest.raises(FormatError, match=r"none\.ply.*missing"):
        read_point_cloud(tmp_path / "none.ply")


def test_real_clouds(shared_data: Path) -> None:
    folder = shared_data / "clouds"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    aerial = read_point_cloud(folder / "b9_training.ply")
    assert len(aerial) == 22_300 and aerial.colors is not None and aerial.colors.std() > 5 and "label" in aerial.labels
    statue = read_point_cloud(folder / "angel.ply")
    assert len(statue) == 71_359 and statue.colors is not None and statue.colors.std() > 5
    scan = read_point_cloud(folder / "scan_pair" / "source.ply")
    assert scan.colors is None and scan.left_out == ()
    assert scan.reflectance_name == "scalar_intensity" and scan.reflectance is not None and scan.reflectance.std() > 5
