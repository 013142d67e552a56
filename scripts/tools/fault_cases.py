# SPDX-License-Identifier: Apache-2.0
"""The faults of fault_table.py: damaged recordings, runs and streams, impossible settings, runs that are cut off."""

from __future__ import annotations

import json
import os
import shutil
import signal
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import fault_disk
import fault_moving
import fault_numbers
import numpy as np
from fault_bench import FEW, Place
from fault_disk import NotHere

__all__ = ["FAULTS", "NotHere"]

Fault = Callable[[Place], None]
Damage = Callable[[Path], object]
AT = 5
"""Frame that is damaged."""
BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


def depth(recording: Path) -> Path:
    return recording / "depth" / f"{AT:06d}.png"


def color(recording: Path) -> Path:
    return recording / "rgb" / f"{AT:06d}.png"


def cut(path: Path, share: float = 0.6) -> None:
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


def replace(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text, (path, old)
    path.write_text(text.replace(old, new, 1))


def noise(image: np.ndarray) -> np.ndarray:
    """An image of the same shape and type that shows nothing."""
    return np.random.default_rng(0).integers(0, np.iinfo(image.dtype).max, image.shape, image.dtype)


def edit_line(path: Path, number: int, change: Callable[[list[str]], list[str]]) -> None:
    lines = path.read_text().splitlines()
    lines[number] = " ".join(change(lines[number].split()))
    path.write_text("\n".join(lines) + "\n")


def camera_value(name: str, value: object) -> Damage:
    def damage(recording: Path) -> None:
        path = recording / "camera.yaml"
        lines = [line for line in path.read_text().splitlines() if not line.startswith(f"{name}:")]
        path.write_text("\n".join([*lines, *([] if value is None else [f"{name}: {value}"])]) + "\n")

    return damage


def camera_text(text: str) -> Damage:
    return lambda recording: (recording / "camera.yaml").write_text(text)


def instead(path: Path, make: Callable[[Path], object]) -> None:
    path.unlink(missing_ok=True)
    make(path)


def images(recording: Path, kind: str, change: Callable[[np.ndarray], np.ndarray], first: int = 0) -> None:
    for path in sorted((recording / kind).iterdir())[first:]:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert image is not None and cv2.imwrite(str(path), change(image))


def png_bomb(path: Path) -> None:
    """60,000 x 60,000 pixels of nothing."""
    head = struct.pack(">IIBBBBB", 60000, 60000, 16, 0, 0, 0, 0)
    path.write_bytes(png_of(head, zlib.compress(b"\0" * 10_000_000, 9)))


def png_of(head: bytes, rows: bytes) -> bytes:
    """A PNG of what its header says and of deflated rows."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def covered(recording: Path) -> None:
    for kind in ("rgb", "depth"):
        paths = sorted((recording / kind).iterdir())
        for path in paths[AT:9]:
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert image is not None and cv2.imwrite(str(path), np.zeros_like(image))


def hangs(recording: Path, kind: str) -> None:
    """From frame `AT` on all images of a kind are that of this frame."""
    paths = sorted((recording / kind).iterdir())
    for path in paths[AT + 1 :]:
        shutil.copy(paths[AT], path)


def keep_frames(recording: Path, count: int) -> None:
    for kind in ("rgb", "depth", "masks"):
        for path in sorted((recording / kind).iterdir())[count:]:
            path.unlink()
    lines = (recording / "poses.txt").read_text().splitlines()
    (recording / "poses.txt").write_text("\n".join(lines[: count + 1]) + "\n")


def repeated(recording: Path) -> None:
    for kind in ("rgb", "depth", "masks"):
        first, *others = sorted((recording / kind).iterdir())
        for path in others:
            shutil.copy(first, path)


def backwards(recording: Path) -> None:
    times = [0.1, 0.0667, 0.0333, 0.0, *(k / 30 for k in range(4, len(list((recording / "rgb").iterdir()))))]
    (recording / "timestamps.txt").write_text("".join(f"{time}\n" for time in times))


def turned_poses(recording: Path) -> None:
    lines = (recording / "poses.txt").read_text().splitlines()
    (recording / "poses.txt").write_text("\n".join([lines[0], *reversed(lines[1:])]) + "\n")


def shifted(recording: Path) -> None:
    paths = sorted((recording / "depth").iterdir())
    data = [path.read_bytes() for path in paths]
    for path, late in zip(paths, data[-4:] + data[:-4], strict=True):
        path.write_bytes(late)


RECORDINGS: dict[str, Damage] = {
    "a depth image is missing": lambda r: depth(r).unlink(),
    "a colour image is missing": lambda r: color(r).unlink(),
    "a PNG is truncated": lambda r: cut(depth(r)),
    "a PNG lacks its last bytes": lambda r: depth(r).write_bytes(depth(r).read_bytes()[:-12]),
    "a bit of a PNG is flipped": lambda r: flip(depth(r)),
    "an image file is empty": lambda r: color(r).write_bytes(b""),
    "an image file is text": lambda r: color(r).write_text("not an image"),
    "a depth image has another size": lambda r: cv2.imwrite(str(depth(r)), np.ones((24, 32), np.uint16)),
    "a depth image has 8 bits": lambda r: cv2.imwrite(str(depth(r)), np.ones((72, 96), np.uint8)),
    "a mask has another shape": lambda r: cv2.imwrite(str(r / "masks" / f"{AT:06d}.png"), np.ones((32, 24), np.uint16)),
    "a mask is truncated": lambda r: cut(r / "masks" / f"{AT:06d}.png"),
    "a mask is missing": lambda r: (r / "masks" / f"{AT:06d}.png").unlink(),
    "a PNG claims 60,000 x 60,000 pixels": lambda r: instead(depth(r), png_bomb),
    "a frame is a pipe": lambda r: instead(depth(r), os.mkfifo),
    "a frame is a link to a device": lambda r: instead(depth(r), lambda path: path.symlink_to("/dev/zero")),
    "a pose is NaN": lambda r: edit_line(r / "poses.txt", AT + 1, lambda w: [w[0], "nan", *w[2:]]),
    "a pose is a complex number": lambda r: edit_line(r / "poses.txt", AT + 1, lambda w: [w[0], "1+2j", *w[2:]]),
    "a pose lacks numbers": lambda r: edit_line(r / "poses.txt", AT + 1, lambda w: w[:4]),
    "time goes backwards": backwards,
    "poses are in the reverse order": turned_poses,
    "colour and depth are out of step": shifted,
    "frames are missing in the middle": lambda r: [p.unlink() for k in ("rgb", "depth", "masks") for p in
                                                   sorted((r / k).iterdir())[4:9]],
    "the lens is covered for four frames": covered,
    "all but two frames show something else": lambda r: [images(r, kind, noise, 2) for kind in ("rgb", "depth")],
    "colour hangs from a frame on": lambda r: hangs(r, "rgb"),
    "depth hangs from a frame on": lambda r: hangs(r, "depth"),
    "all images are noise": lambda r: [images(r, kind, noise) for kind in ("rgb", "depth")],
    "colour alone is noise": lambda r: images(r, "rgb", noise),
    "there is one frame": lambda r: keep_frames(r, 1),
    "all frames are the first one": repeated,
    "there is no depth at all": lambda r: images(r, "depth", np.zeros_like),
    "a wall without texture": lambda r: (images(r, "rgb", lambda i: np.full_like(i, 128)),
                                         images(r, "depth", lambda i: np.full_like(i, 10000))),
    "depth is five times too large": camera_value("depth_scale", 1000),
    "depth is ten times too small": camera_value("depth_scale", 50000),
    "the focal length is twice too long": lambda r: (camera_value("fx", 144.0)(r), camera_value("fy", 144.0)(r)),
    "intrinsics are normalised (fx = 0.75)": lambda r: (camera_value("fx", 0.75)(r), camera_value("fy", 1.0)(r)),
    "the principal point is far outside": camera_value("cx", 1e7),
    "the principal point is outside": camera_value("cx", 144.0),
    "camera.yaml is for images twice as large": lambda r: (camera_value("width", 192)(r),
                                                           camera_value("height", 144)(r)),
    "camera.yaml is for images of another shape": camera_value("height", 54),
    "depth images are cut": lambda r: images(r, "depth", lambda i: i[:, :72]),
    "exposure falls to 0.4 in mid-recording": lambda r: images(r, "rgb", lambda i: (0.4 * i).astype(np.uint8), AT),
    "images are 1 x 1": lambda r: [images(r, k, lambda i: i[:1, :1]) for k in ("rgb", "depth", "masks")],
    "the focal length is missing": camera_value("fx", None),
    "the focal length is NaN": camera_value("fx", ".nan"),
    "the focal length is negative": camera_value("fx", -72),
    "the width is text": camera_value("width", "wide"),
    "the YAML file is a bomb of aliases": camera_text(BOMB),
    "the YAML file is 5000 levels deep": camera_text("[" * 5000 + "]" * 5000),
    "the YAML file names a Python object": camera_text("fx: !!python/object/apply:os.system ['true']\n"),
    "the YAML file holds a date": camera_value("fx", "2024-01-01"),
    "the YAML file is no text": lambda r: (r / "camera.yaml").write_bytes(b"\xff\xfe\x00\x01"),
    "the folder is empty": lambda r: fault_disk.emptied(r),
}  # fmt: skip


OF_TRUE_POSES = {"a pose is NaN", "a pose is a complex number", "a pose lacks numbers",
                 "poses are in the reverse order", "depth is five times too large",
                 "depth is ten times too small"}  # fmt: skip
"""Only a run that is scored reads them."""


def npz_bomb(path: Path) -> None:
    """An array of 4 GB in a file of some MB."""
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000,), }".ljust(117) + b"\n"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open(
        "poses.npy", "w", force_zip64=True
    ) as entry:
        entry.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
        for _ in range(400):
            entry.write(bytes(10_000_000))


def pickled(path: Path) -> None:
    np.savez(path, poses=np.array([{"a": 1}], object), allow_pickle=True)


def marked(run: Path, **entries: object) -> None:
    mark = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps({**mark, **entries}))


def staged(run: Path, stale: str) -> None:
    folder = run / ".staged-1-00000000"
    folder.mkdir()
    (folder / "run.json").write_text((run / "run.json").read_text())
    marked(run, saving={"from": folder.name, "stale": [stale]})


def far_off(path: Path) -> None:
    record = json.loads(path.read_text())
    record["frames"][4]["T_keyframe_camera"][0][3] = 1e5
    path.write_text(json.dumps(record))


def black_picture(path: Path, width: int = 30000, height: int = 29000) -> None:
    """A whole picture of 2.6 GB in 2.5 MB: pieces of zeros are all alike, so one is packed."""
    size, piece = (1 + 3 * width) * height, 1 << 22

    def pack(count: int, way: int) -> bytes:
        packer = zlib.compressobj(9, zlib.DEFLATED, -15)
        return packer.compress(bytes(count)) + packer.flush(way)

    pieces = pack(piece, zlib.Z_FULL_FLUSH) * (size // piece) + pack(size % piece, zlib.Z_FINISH)
    rows = b"\x78\xda" + pieces + struct.pack(">HH", size % 65521, 1)
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(png_of(struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0), rows))


def picture_of_changes(run: Path) -> None:
    """A folder of changes whose picture is a pipe."""
    changes = run.parent / "changes"
    changes.mkdir()
    change = {"kind": "moved", "name": "mug", "confidence": 0.9, "picture": "0.png"}
    (changes / "changes.json").write_text(json.dumps({"changes": [change]}))
    os.mkfifo(changes / "0.png")


def instead_below(path: Path, make: Callable[[Path], object]) -> None:
    path.parent.mkdir(exist_ok=True)
    instead(path, make)


VOLUMES = ("volumes", "RUN", "--esdf", "--voxel", "0.05", "--sequence", "RECORDING")
MESH = ("export", "RUN", "--format", "mesh", "--sequence", "RECORDING", "--out", "a.ply")
"""The frames are elsewhere than when the run was made."""
RUNS: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "the map is cut off": (lambda r: cut(r / "map.ply"), ("export", "RUN", "--out", "a.ply")),
    "the map is missing": (lambda r: (r / "map.ply").unlink(), ("export", "RUN", "--out", "a.ply")),
    "a bit of the map is flipped": (lambda r: flip(r / "map.ply"), ("verify", "RUN")),
    "the map is a pipe": (lambda r: instead(r / "map.ply", os.mkfifo), ("export", "RUN", "--out", "a.ply")),
    "the map is a link out of the run": (
        lambda r: instead(r / "map.ply", lambda p: p.symlink_to("/etc/passwd")), ("export", "RUN", "--out", "a.ply")),
    "the map is another run's": (lambda r: (r / "map.ply").write_bytes((r / "points.ply").read_bytes()),
                                 ("view", "RUN", "--html", "a.html")),
    "run.json is garbage": (lambda r: (r / "run.json").write_text("{"), ("export", "RUN", "--out", "a.ply")),
    "run.json is 100,000 levels deep": (lambda r: (r / "run.json").write_text("[" * 100000), ("verify", "RUN")),
    "run.json would have the parent emptied": (lambda r: staged(r, ".."), ("report", "RUN")),
    "the settings are a bomb": (lambda r: (r / "config.yaml").write_text(BOMB), MESH),
    "a setting is unknown": (lambda r: replace(r / "config.yaml", "seed:", "sede:"),
                             MESH),
    "the trajectory holds NaN": (lambda r: edit_line(r / "trajectory.txt", 3, lambda w: [w[0], "nan", *w[2:]]),
                                 ("export", "RUN", "--out", "a.txt")),
    "the objects are garbage": (lambda r: (r / "objects.json").write_text("[1, 2"),
                                ("edit", "RUN", "--remove", "1", "--out", "b")),
    "an object has control characters": (
        lambda r: replace(r / "objects.json", '"name": "', '"name": "\\u001b[2J'),
        ("edit", "RUN", "--rename", "\x1b[2J", "x", "--out", "b")),
    "the classifier is cut off": (lambda r: cut(r / "classifier.npz"), ("export", "RUN", "--out", "a.ply")),
    "an npz file is a bomb of 4 GB": (lambda r: npz_bomb(r / "places.npz"), ("localize", "RUN", "RECORDING")),
    "an npz file holds pickled objects": (lambda r: pickled(r / "places.npz"), ("localize", "RUN", "RECORDING")),
    "the keyframes are garbage": (lambda r: (r / "keyframes.json").write_text('{"frames": 7}'),
                                  ("export", "RUN", "--format", "colmap", "--out", "c")),
    "the report is a link": (lambda r: instead(r / "report.html", lambda p: p.symlink_to(r.parent / "mine.txt")),
                             ("report", "RUN")),
    "a picture of renders/ has 870 megapixels in 2.5 MB": (
        lambda r: black_picture(r / "renders" / "compare000000.png"), ("report", "RUN")),
    "a picture of renders/ is a pipe": (
        lambda r: instead_below(r / "renders" / "compare000000.png", os.mkfifo), ("report", "RUN")),
    "a picture of changes is a pipe": (picture_of_changes, ("view", "RUN", "--changes", "CHANGES")),
    "a pose is 100 km off": (lambda r: far_off(r / "keyframes.json"), (*VOLUMES, "--out", "v")),
    "an object is asked for that is not there": (lambda r: None, ("edit", "RUN", "--remove", "unicorn", "--out", "b")),
    "no such format": (lambda r: None, ("export", "RUN", "--format", "dwg", "--out", "a")),
}  # fmt: skip


CONSISTENT = {"the trajectory holds NaN", "the objects are garbage", "an object has control characters",
              "the keyframes are garbage", "the classifier is cut off", "an npz file is a bomb of 4 GB",
              "an npz file holds pickled objects", "a pose is 100 km off", "the settings are a bomb"}  # fmt: skip
"""The run's own list says that these files belong to it, as that of a stranger's run would."""


def accept(run: Path) -> None:
    """Writes a run's list of files anew."""
    from ggslam.runs.verification import accept_files

    accept_files(run)


STREAMS: dict[str, Damage] = {
    "a bit of a stream is flipped (G-PCC has no checksums)": flip,
    "a stream is cut off": cut,
    "a stream is empty": lambda path: path.write_bytes(b""),
    "a stream is something else": lambda path: path.write_bytes(b"GIF89a" * 500),
    "a stream is noise": lambda path: path.write_bytes(np.random.default_rng(0).bytes(20000)),
}
CLOUD = "ply\nformat binary_little_endian 1.0\nelement vertex {}\n" + "".join(
    f"property float {axis}\n" for axis in "xyz") + "end_header\n"  # fmt: skip
SETTINGS: dict[str, tuple[str, ...]] = {
    "a setting that does not exist": ("--set", "mapping.iterations=4"),
    "a setting out of range": ("--set", "mapping.iterations_per_frame=-1"),
    "a setting that is no number": ("--set", "seed=many"),
    "no such preset": ("--config", "fastest"),
    "a negative scale": ("--scale", "-0.5"),
    "a run that starts in its own output": ("--map", "OUT"),
    "less memory than the program takes": ("--set", "memory_limit_mb=1"),
}


def damaged_recording(name: str, damage: Damage) -> Fault:
    def happen(place: Place) -> None:
        recording = place.recording()
        damage(recording)
        place.map_recording(recording, *(("--eval",) if name in OF_TRUE_POSES else ()))

    return happen


def damaged_run(name: str, damage: Damage, words: tuple[str, ...]) -> Fault:
    def happen(place: Place) -> None:
        run = place.run()
        (place.folder / "mine.txt").write_text("a file of the user")
        damage(run)
        if name in CONSISTENT:
            accept(run)
        changes = place.folder / "changes"
        known = {"RUN": run, "CHANGES": changes, "RECORDING": place.recording() if "RECORDING" in words else None}
        outputs = [place.folder / w if i and words[i - 1] in ("--out", "--html") else w for i, w in enumerate(words)]
        place.ggslam(*(known.get(str(word), word) for word in outputs))

    return happen


def damaged_stream(damage: Damage) -> Fault:
    def happen(place: Place) -> None:
        stream = place.folder / "points.bin"
        if place.ggslam("encode", place.run(), stream).code:
            raise AssertionError(place.ended[-1].text)
        place.ended.clear()
        damage(stream)
        place.ggslam("decode", stream, place.folder / "points.ply")

    return happen


def wrong_setting(words: tuple[str, ...]) -> Fault:
    def happen(place: Place) -> None:
        place.map_recording(place.recording(), *(place.out if word == "OUT" else word for word in words))

    return happen


def claims_too_much(place: Place) -> None:
    (place.folder / "cloud.ply").write_bytes(CLOUD.format(10**12).encode() + bytes(1200))
    place.ggslam("encode", place.folder / "cloud.ply", place.folder / "a.bin", "--voxel", "0.01")


def holds_nothing_finite(place: Place) -> None:
    points = np.full((100, 3), np.nan, np.float32)
    (place.folder / "cloud.ply").write_bytes(CLOUD.format(100).encode() + points.tobytes())
    place.ggslam("encode", place.folder / "cloud.ply", place.folder / "a.bin", "--voxel", "0.01")


def no_recording(place: Place) -> None:
    place.map_recording(place.folder / "nowhere")


def cut_off(number: signal.Signals) -> Fault:
    """A run that is ended by a signal and resumed."""

    def happen(place: Place) -> None:
        def stop(frame: int) -> None:
            if frame == 8:
                os.kill(os.getpid(), number)

        place.map_recording(place.recording(), "--checkpoint-every", "3", after=stop)
        place.ggslam("run", "--resume", place.out)

    return happen


def damaged_checkpoint(place: Place) -> None:
    place.map_recording(
        place.recording(), "--checkpoint-every", "3", after=lambda k: os.kill(os.getpid(), 9) if k == 8 else None
    )
    flip(sorted((place.out / "checkpoints").glob("state-*.bin"))[-1])
    place.ggslam("run", "--resume", place.out)


def killed_while_overwriting(place: Place) -> None:
    recording = place.recording()
    place.map_recording(recording, "--stop", "6")
    place.map_recording(
        recording, "--overwrite", "--checkpoint-every", "3", after=lambda k: os.kill(os.getpid(), 9) if k == 8 else None
    )
    if place.ggslam("export", place.out, "--out", place.folder / "old.ply").code == 0:
        place.keep("the run before")


def piped_checkpoint(place: Place) -> None:
    place.map_recording(
        place.recording(), "--checkpoint-every", "3", after=lambda k: os.kill(os.getpid(), 9) if k == 8 else None
    )
    for state in (place.out / "checkpoints").glob("state-*.bin"):
        instead(state, os.mkfifo)
    place.keep("the checkpoints, which are pipes")
    place.ggslam("run", "--resume", place.out)


def piped_part(place: Place) -> None:
    store = place.folder / "store"
    if place.ggslam("submaps", place.run(), "--out", store).code:
        raise AssertionError(place.ended[-1].text)
    place.ended.clear()
    instead(sorted(store.rglob("gaussians.npz"))[0], os.mkfifo)
    place.ggslam("export", store, "--format", "streamed-sog", "--out", place.folder / "sog")


def full_memory(place: Place) -> None:
    """A file of 64 MB, and 48 MB that are left."""
    (place.folder / "map.splat").write_bytes(bytes(64 << 20))
    place.ggslam("export", place.folder / "map.splat", "--out", place.folder / "a.ply", memory=48 << 20)


def larger_than_memory(place: Place) -> None:
    path = place.folder / "disk" / "map.splat"  # nobody adds up what is there
    path.parent.mkdir()
    with path.open("wb") as file:
        file.truncate(1 << 42)
    place.ggslam("export", path, "--out", place.folder / "a.ply")


def out_is_there(place: Place) -> None:
    place.out = place.run()
    place.map_recording(place.recording())


def out_is_a_file(place: Place) -> None:
    place.out.write_text("mine")
    place.map_recording(place.recording())


FAULTS: dict[str, Fault] = {
    "there is no such recording": no_recording,
    **{name: damaged_recording(name, damage) for name, damage in RECORDINGS.items()},
    **{name: damaged_run(name, *fault) for name, fault in RUNS.items()},
    **{name: damaged_stream(damage) for name, damage in STREAMS.items()},
    "a PLY claims 10^12 points": claims_too_much,
    "a cloud holds nothing but NaN": holds_nothing_finite,
    **{name: wrong_setting(words) for name, words in SETTINGS.items()},
    "Ctrl-C, then resumed": cut_off(signal.SIGINT),
    "SIGTERM, then resumed": cut_off(signal.SIGTERM),
    "SIGHUP (a dropped connection), then resumed": cut_off(signal.SIGHUP),
    "kill -9, then resumed": cut_off(signal.SIGKILL),
    "kill -9 and a damaged checkpoint, then resumed": damaged_checkpoint,
    "the checkpoints are pipes": piped_checkpoint,
    "a part of a store is a pipe": piped_part,
    "memory is full while a small file is read": full_memory,
    "a file claims 4 TB": larger_than_memory,
    "kill -9 of a run that overwrites another": killed_while_overwriting,
    "there is a run at --out": out_is_there,
    "--out is a file": out_is_a_file,
    **fault_numbers.FAULTS,
    **fault_disk.FAULTS,
    **fault_moving.FAULTS,
}
assert len(FAULTS) >= 60 and FEW
