# SPDX-License-Identifier: Apache-2.0
"""What scripts/tools/fuzz.py reads: each parser of ggslam with small good files for it."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fuzz_states as states
import numpy as np

Maker = Callable[[Path], list[Path]]


@dataclass(frozen=True)
class Target:
    """A parser.

    Attributes:
        name: for tables.
        make: writes good files to a folder.
        read: reads one; raises GgslamError if it is damaged.
        weight: share of the inputs.
    """

    name: str
    make: Maker
    read: Callable[[Path], Any]
    weight: int = 4


def make_corpus(folder: Path, targets: list[Target]) -> dict[str, list[Path]]:
    """Good files of each target."""
    corpus = {}
    for target in targets:
        place = folder / target.name
        place.mkdir(parents=True)
        corpus[target.name] = target.make(place)
        for path in corpus[target.name]:
            target.read(path)  # or the corpus is wrong
    return corpus


def _map() -> Any:
    import torch

    from ggslam.scene.gaussian_map import GaussianMap

    gaussians = GaussianMap(1, 16, with_moments=False)
    rng = np.random.default_rng(0)
    rows = {"means": (20, 3), "quaternions": (20, 4), "log_scales": (20, 3), "opacity_logits": (20,)}
    like = gaussians.take(torch.zeros(0, dtype=torch.long))
    values = {}
    for name, column in like.items():
        shape = rows.get(name, (20, *column.shape[1:]))
        values[name] = torch.from_numpy(rng.normal(size=shape)).to(column.dtype).abs()
    gaussians.append({name: value for name, value in values.items() if "." not in name})
    return gaussians


def _gaussian_plys(folder: Path) -> list[Path]:
    from ggslam.formats.compressed_ply import write_compressed_ply
    from ggslam.formats.gaussian_ply import write_gaussian_ply

    write_gaussian_ply(folder / "map.ply", _map(), extra=("object_id", "identity"))
    write_compressed_ply(folder / "map.compressed.ply", _map())
    return [folder / "map.ply"]


def _clouds(folder: Path) -> list[Path]:
    from ggslam.formats.pcd import pcd_bytes
    from ggslam.formats.ply import write_ply

    rng = np.random.default_rng(0)
    xyz = rng.random((30, 3)).astype(np.float32)
    columns = {name: np.ascontiguousarray(xyz[:, i]) for i, name in enumerate("xyz")}
    rows = np.zeros(30, [(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")])
    for name in "xyz":
        rows[name] = columns[name]
    write_ply(folder / "cloud.ply", {"vertex": rows}, ["made for a test"])
    (folder / "cloud.pcd").write_bytes(pcd_bytes(columns))
    (folder / "packed.pcd").write_bytes(pcd_bytes(columns, compressed=True))
    text = ["ply", "format ascii 1.0", "element vertex 3", *(f"property float {n}" for n in "xyz"),
            "element face 1", "property list uchar int vertex_indices", "end_header"]  # fmt: skip
    (folder / "text.ply").write_text("\n".join([*text, "0 0 0", "1 0 0", "0 1 0", "3 0 1 2", ""]))
    pcd = ["VERSION .7", "FIELDS x y z", "SIZE 4 4 4", "TYPE F F F", "COUNT 1 1 1", "WIDTH 2", "HEIGHT 1",
           "VIEWPOINT 0 0 0 1 0 0 0", "POINTS 2", "DATA ascii", "0 0 0", "1 2 3", ""]  # fmt: skip
    (folder / "text.pcd").write_text("\n".join(pcd))
    return sorted(folder.iterdir())


def _ply_read(path: Path) -> Any:
    from ggslam.formats.ply import read_ply

    return read_ply(path)


def _splats(folder: Path) -> list[Path]:
    from ggslam.formats.splat_formats import write_splats

    names = ("map.ply", "map.compressed.ply", "map.sog", "map.spz", "map.splat", "map.glb", "map.usdc")
    for name in names:
        write_splats(folder / name, _map(), {1: "mug"})
    return [folder / name for name in names]


def _splats_read(path: Path) -> Any:
    from ggslam.formats.splat_formats import read_splats

    return read_splats(path)


def _gaussians_read(path: Path) -> Any:
    from ggslam.formats.gaussian_ply import read_gaussian_ply

    return read_gaussian_ply(path)


def _cloud_read(path: Path) -> Any:
    from ggslam.formats.point_cloud import read_point_cloud

    return read_point_cloud(path)


def _mesh_read(path: Path) -> Any:
    from ggslam.formats.triangle_mesh import read_mesh

    return read_mesh(path)


def _trajectories(folder: Path) -> list[Path]:
    (folder / "tum.txt").write_text("# t\n" + "".join(f"{i}.5 0 0 {i} 0 0 0 1\n" for i in range(9)))
    (folder / "rows.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n" * 5)
    return sorted(folder.iterdir())


def _trajectory_read(path: Path) -> Any:
    from ggslam.formats.trajectory import read_trajectory

    return read_trajectory(path)


def _images(folder: Path) -> list[Path]:
    import cv2

    rng = np.random.default_rng(0)
    cv2.imwrite(str(folder / "color.png"), rng.integers(0, 255, (12, 16, 3)).astype(np.uint8))
    cv2.imwrite(str(folder / "color.jpg"), rng.integers(0, 255, (12, 16, 3)).astype(np.uint8))
    cv2.imwrite(str(folder / "depth.png"), rng.integers(0, 5000, (12, 16)).astype(np.uint16))
    np.save(folder / "depth.npy", rng.random((12, 16)).astype(np.float32))
    return sorted(folder.iterdir())


def _image_read(path: Path) -> Any:
    from ggslam.sequences.images import read_color, read_confidence, read_depth

    if path.suffix == ".npy" or path.stem == "depth":
        return read_depth(path, 1000.0)
    return read_confidence(path) if path.stem == "confidence" else read_color(path)


def _masks(folder: Path) -> list[Path]:
    import cv2

    ids = np.arange(12 * 16, dtype=np.uint16).reshape(12, 16) // 20
    cv2.imwrite(str(folder / "000000.png"), ids)
    return [folder / "000000.png"]


def _mask_read(path: Path) -> Any:
    from ggslam.sequences.mask_images import read_mask_image

    return read_mask_image(path)


def _codes(folder: Path) -> list[Path]:
    import ggslam

    rng = np.random.default_rng(0)
    points = rng.random((300, 3)) * 2
    colors = rng.integers(0, 255, (300, 3)).astype(np.uint8)
    ids = rng.integers(0, 4, 300).astype(np.uint16)
    for name, attributes in (("plain", {}), ("color", {"color": colors}), ("ids", {"color": colors, "object_id": ids})):
        coded = ggslam.encode_cloud(points, attributes)
        (folder / f"{name}.bin").write_bytes(coded.data)
    return sorted(folder.iterdir())


def _code_read(path: Path) -> Any:
    from ggslam.coding.decoder import decode_cloud
    from ggslam.coding.listing import list_units

    data = path.read_bytes()
    list_units(data)
    return decode_cloud(data, 1)


def _octomaps(folder: Path) -> list[Path]:
    from ggslam.volumes.occupancy import OccupancyMap
    from ggslam.volumes.octomap_files import write_octomap

    occupancy = OccupancyMap(0.1)
    points = np.random.default_rng(0).random((200, 3)).astype(np.float32)
    occupancy.insert(points, np.zeros(3))
    for name in ("a.bt", "a.ot"):
        write_octomap(occupancy, folder / name)
    return sorted(folder.iterdir())


def _octomap_read(path: Path) -> Any:
    from ggslam.volumes.octomap_files import read_octomap

    return read_octomap(path)


def _arrays(folder: Path) -> list[Path]:
    np.savez(folder / "a.npz", a=np.arange(30), b=np.eye(3))
    np.savez_compressed(folder / "b.npz", a=np.arange(30), b=np.eye(3))
    return sorted(folder.iterdir())


def _arrays_read(path: Path) -> Any:
    from ggslam.scene.arrays import read_all_arrays

    return read_all_arrays(path, "arrays")


def _array_files(folder: Path) -> list[Path]:
    np.save(folder / "a.npy", np.eye(3))
    return [folder / "a.npy"]


def _array_read(path: Path) -> Any:
    from ggslam.scene.arrays import read_array

    return read_array(path)


def _raw(folder: Path) -> list[Path]:
    np.random.default_rng(0).random((20, 4)).astype(np.float32).tofile(folder / "scan.bin")
    return [folder / "scan.bin"]


def _raw_read(path: Path) -> Any:
    from ggslam.formats.raw_points import read_raw_points

    return read_raw_points(path, 4)


def _configs(folder: Path) -> list[Path]:
    from ggslam.slam.config import Config, save_config

    save_config(Config(), folder / "config.yaml")
    (folder / "few.yaml").write_text("mapping:\n  iterations_per_frame: 3\ntracker: gicp\n")
    return sorted(folder.iterdir())


def _config_read(path: Path) -> Any:
    from ggslam.slam.config import load_config

    return load_config(str(path))


def _tables(folder: Path) -> list[Path]:
    path = folder / "objects.json"
    record = {"id": 1, "name": "mug", "gaussians": 9}
    path.write_text(json.dumps({"objects": [record], "supervision": "masks"}))
    return [path]


def _table_read(path: Path) -> Any:
    from ggslam.errors import FormatError
    from ggslam.objects.table import ObjectTable

    try:
        return ObjectTable.load(path)
    except FormatError:
        if b"gaussians" in path.read_bytes():
            return None
        raise


def _steps(folder: Path) -> list[Path]:
    (folder / "steps.csv").write_text("frame,loss,status\n1,0.5,ok\n2,,lost\n")
    return [folder / "steps.csv"]


def _steps_read(path: Path) -> Any:
    from ggslam.slam.step_log import read_table

    return read_table(path)


def _rows(folder: Path) -> list[Path]:
    import torch

    from ggslam.submaps.gaussian_rows import encode_rows

    (folder / "rows.npz").write_bytes(encode_rows(_map().take(torch.arange(5))))
    return [folder / "rows.npz"]


def _rows_read(path: Path) -> Any:
    from ggslam.submaps.gaussian_rows import decode_rows

    return decode_rows(path.read_bytes(), str(path))


def _user_data(folder: Path) -> list[Path]:
    from ggslam.coding.user_data import write_user_data

    (folder / "unit.bin").write_bytes(write_user_data({"names": ["a"], "tables": {"a": [1, 2, 3]}}))
    return [folder / "unit.bin"]


def _user_data_read(path: Path) -> Any:
    from ggslam.coding.user_data import read_user_data

    return read_user_data(path.read_bytes())


def _stores(folder: Path) -> list[Path]:
    from ggslam.submaps.grid import GridStore, SubmapSettings

    with GridStore.create(folder / "store", SubmapSettings()) as store:
        for x in range(3):
            store.put((x, 0, 0), {"points.pcd": bytes(50), "more": struct.pack("<f", x)})
    return [folder / "store"]


def _store_read(path: Path) -> Any:
    from ggslam.submaps.grid import GridStore

    with GridStore.open(path) as store:
        return [store.get(key, "more") for key in store.cells()]


def _runs(folder: Path) -> list[Path]:
    from ggslam.jobs.run.pipeline import RunRequest, execute
    from ggslam.runs.recordings import SequenceRequest
    from ggslam.synthetic.writer import write_synthetic_sequence

    write_synthetic_sequence(folder / "room", frames=4, width=48, height=36)
    settings = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=1"]
    execute(RunRequest(SequenceRequest(folder / "room"), out=folder / "run", overrides=settings, evaluate=False))
    return [folder / "run"]


def _run_read(path: Path) -> Any:
    from ggslam.runs.folder import RunFolder

    run = RunFolder.open(path)
    run.config(), run.sequence(), run.keyframes(), run.timing(), run.loops(), run.metrics(), run.trajectory()
    return run.segmented_map() if run.has_objects() else run.gaussians()


def _recordings(name: str) -> Maker:
    def make(folder: Path) -> list[Path]:
        from format_makers import MORE_MAKERS
        from tiny_recordings import MAKERS

        place = folder / f"{name}-recording"
        place.mkdir()
        made = {**MAKERS, **MORE_MAKERS}[name](place)
        return [made]

    return make


def _recording_read(path: Path) -> Any:
    from ggslam.errors import SequenceError
    from ggslam.sequences import open_sequence

    sequence = open_sequence(path)
    seen = 0
    for index in range(min(len(sequence), 3)):
        try:
            sequence.frame(index)
            seen += 1
        except SequenceError:
            continue
    return seen


def _rigs(folder: Path) -> list[Path]:
    import yaml
    from tiny_recordings import MAKERS

    place, cameras = folder / "rig", []
    for name, pose, offset in (("folder", np.eye(4), 0.0), ("tum", np.diag([-1.0, 1, -1, 1]), -1000.0)):
        (place / name).mkdir(parents=True)
        made = MAKERS[name](place / name).relative_to(place)
        said = {"name": name, "recording": str(made), "T_rig_camera": pose.reshape(-1).tolist()}
        cameras.append({**said, "time_offset": offset})
    (place / "rig.yaml").write_text(yaml.safe_dump({"cameras": cameras, "tolerance": 0.05}))
    return [place]


def _manifests(folder: Path) -> list[Path]:
    (folder / "batch.yaml").write_text(
        "out: out\noptions: --scale 0.5\nrecordings:\n  - a\n  - path: b\n    name: c\n    options: --stop 20\n"
        "settings:\n  default:\n  slow: --config quality-cpu\nseeds: [0, 1]\n"
    )
    return [folder / "batch.yaml"]


def _manifest_read(path: Path) -> Any:
    from ggslam.jobs.batch.manifest import read_manifest

    return read_manifest(path)


def _containers(folder: Path) -> list[Path]:
    from ggslam.coding.settings import CodecSettings
    from ggslam.runs.folder import RunFolder
    from ggslam.runs.map_container import write_container

    write_container(RunFolder.open(_runs(folder)[0]), folder / "map.ggz", "r03", CodecSettings())
    return [folder / "map.ggz"]


def _container_read(path: Path) -> Any:
    import tempfile

    from ggslam.runs.map_container import read_container

    with tempfile.TemporaryDirectory() as name:
        repaired = Path(name) / path.name
        _repair_container(path, repaired)
        return len(read_container(repaired, Path(name) / "run").gaussians())


def _repair_container(path: Path, out: Path) -> None:
    """Its members' checksums made right, as somebody's who means harm would be."""
    import hashlib
    import zipfile

    try:
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        head = json.loads(members["container.json"])
        for name, said in head["files"].items():
            said.update(bytes=len(members[name]), sha256=hashlib.sha256(members[name]).hexdigest())
    except Exception:  # too damaged for that
        out.write_bytes(path.read_bytes())
        return
    members["container.json"] = json.dumps(head).encode()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


RECORDINGS = ("replica", "tum", "7scenes", "scannet", "folder", "vmap", "icl-nuim", "nerfstudio", "nerfcapture",
              "scannet++", "scannet++ iphone", "record3d", "polycam", "strayscanner",
              "3dscannerapp", "rtabmap", "ros1", "ros2")  # fmt: skip
TARGETS = [
    Target("ply", _clouds_of := lambda folder: [p for p in _clouds(folder) if p.suffix == ".ply"], _ply_read, 8),
    Target("gaussians", _gaussian_plys, _gaussians_read, 6), Target("cloud", _clouds, _cloud_read, 8),
    Target("splats", _splats, _splats_read, 8),
    Target("mesh", _clouds_of, _mesh_read), Target("trajectory", _trajectories, _trajectory_read, 6),
    Target("images", _images, _image_read, 10), Target("masks", _masks, _mask_read, 6),
    Target("gpcc", _codes, _code_read, 10), Target("user-data", _user_data, _user_data_read),
    Target("octomap", _octomaps, _octomap_read, 6), Target("npz", _arrays, _arrays_read, 8),
    Target("npy", _array_files, _array_read), Target("raw", _raw, _raw_read, 2),
    Target("config", _configs, _config_read, 2),
    Target("objects", _tables, _table_read), Target("steps", _steps, _steps_read, 2), Target("rows", _rows, _rows_read),
    Target("store", _stores, _store_read, 2), Target("run", _runs, _run_read, 2),
    Target("rig", _rigs, _recording_read, 2), Target("manifest", _manifests, _manifest_read, 2),
    Target("container", _containers, _container_read, 2),
    Target("checkpoint", states.cut_off_runs, states.read_checkpoint, 2),
    Target("store-parts", states.stores, states.read_store, 3),
    Target("store-index", states.index_scripts, states.read_index_script, 3),
    Target("places", states.part_files("places.npz"), states.read_part("places.npz", states.use_places)),
    Target("surface", states.part_files("points.pcd"), states.read_part("points.pcd", states.use_surface)),
    Target("cells", states.part_files("gaussians.npz"), states.read_part("gaussians.npz", states.use_gaussians)),
    Target("coded-cells", states.coded_cells, states.read_coded_cells),
    Target("visit", states.visit_files, states.read_visit_file),
    Target("store-objects", states.store_objects, states.read_store_objects),
    Target("records", states.records, states.read_record, 6),
    Target("mover-points", states.mover_points, states.read_mover_points),
    Target("verify", states.verified_runs, states.read_verified),
    Target("whole-run", states.whole_runs, states.read_more_of_run),
    Target("tsdf", states.tsdf_files, states.read_tsdf),
    Target("rig-file", states.rig_files, states.read_rig),
    Target("urdf", states.urdf_files, states.read_urdf_file),
    Target("id-table", states.id_tables, states.read_id_table),
    Target("edit-list", states.videos, states.read_edit_list, 2),
    *(Target(name.replace(" ", "-"), _recordings(name), _recording_read, 2) for name in RECORDINGS),
]  # fmt: skip
