# SPDX-License-Identifier: Apache-2.0
"""Masks of any kind: how they are stored, found, folded to ids, and what happens when they are damaged or absent."""

from __future__ import annotations

import itertools
import json
import logging
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggslam.errors import SequenceError
from ggslam.sequences import Sequence, inspect_sequence, open_sequence
from ggslam.sequences.mask_images import read_mask_image
from ggslam.sequences.masks import MaskReader

Make = Callable[[str], Path]
WIDTH, HEIGHT, FRAMES = 32, 24, 5
LONG_IDS = [7, 70_000, 9_000_001, 16_000_000, 123_456]
"""One a frame, in an order that is not sorted."""


def write_rgb(path: Path, codes: np.ndarray) -> None:
    """DEVA's coding of long ids: id = R + 256 G + 65536 B."""
    path.parent.mkdir(parents=True, exist_ok=True)
    channels = [(codes >> shift & 255).astype(np.uint8) for shift in (16, 8, 0)]  # OpenCV writes blue first
    assert cv2.imwrite(str(path), np.stack(channels, -1))


def write_grey(path: Path, ids: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), ids)


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")


def write_packed(path: Path, values: np.ndarray, bits: int, palette: np.ndarray | None = None) -> None:
    """A PNG of `bits` per pixel, built by hand: grey, or indices of a palette uint8 [n, 3] (RGB)."""
    height, width = values.shape
    packed = np.packbits(np.unpackbits(values.astype(np.uint8)[..., None], axis=2)[..., -bits:].reshape(height, -1), 1)
    rows = b"".join(b"\0" + row.tobytes() for row in packed)
    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([bits, 0 if palette is None else 3, 0, 0, 0])
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    if palette is not None:
        chunks[1:1] = [(b"PLTE", palette.tobytes()), (b"tRNS", b"\0")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(png_chunk(*chunk) for chunk in chunks))


def half(value: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    """The right half has the value, int64 [H, W]."""
    image = np.zeros((size[1], size[0]), np.int64)
    image[:, size[0] // 2 :] = value
    return image


def deva_folder(folder: Path, ids: list[int] = LONG_IDS, listed: list[int] | None = None) -> Path:
    """Annotations/ as stock DEVA writes them, with pred.json one up if `listed` is given."""
    for i, value in enumerate(ids):
        write_rgb(folder / "Annotations" / f"frame{i:06d}.png", half(value))
    if listed is not None:
        frames = [{"file_name": f"frame{i:06d}.jpg", "segments_info": [{"id": v, "category_id": 1, "score": 0.9}]}
                  for i, v in enumerate(listed)]  # fmt: skip
        (folder / "pred.json").write_text(json.dumps({"annotations": frames}))
    return folder


def ids_of(sequence: Sequence, index: int) -> list[int]:
    mask = sequence.frame(index).mask
    assert mask is not None and mask.dtype == np.uint16 and mask.shape == (HEIGHT, WIDTH)
    return [int(i) for i in np.unique(mask)]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_grey(make: Make, tmp_path: Path, dtype: type) -> None:
    largest = np.iinfo(dtype).max
    for i in range(FRAMES):
        write_grey(tmp_path / "m" / f"frame{i:06d}.png", half(largest - i).astype(dtype))
    sequence = open_sequence(make("replica"), masks=tmp_path / "m")
    assert [ids_of(sequence, i) for i in range(FRAMES)] == [[0, largest - i] for i in range(FRAMES)]
    assert sequence.mask_kinds() == {"grey": FRAMES} and sequence.warnings == []


@pytest.mark.parametrize("bits", [1, 2, 4, 8])
@pytest.mark.parametrize("coloured", [True, False])
def test_packed_values_are_the_ids(tmp_path: Path, bits: int, coloured: bool) -> None:
    """Palette indices are ids, even of two equal colours; grey values of few bits are not stretched."""
    rng = np.random.default_rng(bits)
    values = rng.integers(0, 2**bits, (HEIGHT, WIDTH))
    palette = rng.integers(0, 256, (2**bits, 3)).astype(np.uint8)
    palette[-1] = palette[0]
    path = tmp_path / "mask.png"
    write_packed(path, values, bits, palette if coloured else None)
    if coloured:  # what OpenCV makes of it: the colours
        np.testing.assert_array_equal(cv2.imread(str(path)), palette[values][..., ::-1])
    image = read_mask_image(path)
    assert image.kind == ("palette" if coloured else "grey")
    np.testing.assert_array_equal(image.codes, values)


def test_palette_recording(make: Make, tmp_path: Path) -> None:
    palette = np.random.default_rng(0).integers(0, 256, (256, 3)).astype(np.uint8)
    for i in range(FRAMES):
        write_packed(tmp_path / f"frame{i:06d}.png", half(200 + i), 8, palette)
    sequence = open_sequence(make("replica"), masks=tmp_path)
    assert ids_of(sequence, 3) == [0, 203] and sequence.mask_kinds() == {"palette": FRAMES}


@pytest.mark.parametrize("listed", [None, LONG_IDS])
def test_long_ids_are_folded_in_their_order(make: Make, tmp_path: Path, listed: list[int] | None) -> None:
    folder, masks = make("replica"), deva_folder(tmp_path / "deva", listed=listed)
    expected = [[0, sorted(LONG_IDS).index(value) + 1] for value in LONG_IDS]
    for order in itertools.islice(itertools.permutations(range(FRAMES)), 0, 120, 17):  # whatever is read first
        sequence = open_sequence(folder, masks=masks)
        assert {i: ids_of(sequence, i) for i in order} == dict(enumerate(expected))
    part = open_sequence(folder, masks=masks, start=3)  # whatever is selected
    assert [ids_of(part, i) for i in range(2)] == expected[3:]
    assert part.mask_kinds() == {"RGB-coded": 2}


def test_short_rgb_ids_stay(make: Make, tmp_path: Path) -> None:
    masks = deva_folder(tmp_path / "deva", [300, 40_000, 65_535, 1, 2])
    sequence = open_sequence(make("replica"), masks=masks)
    assert [ids_of(sequence, i)[1] for i in range(FRAMES)] == [300, 40_000, 65_535, 1, 2]


def test_grey_ids_stored_as_rgb(make: Make, tmp_path: Path) -> None:
    for i in range(FRAMES):
        write_rgb(tmp_path / "m" / f"frame{i:06d}.png", half(9 + i) * 65793)
    sequence = open_sequence(make("replica"), masks=tmp_path / "m")
    assert [ids_of(sequence, i)[1] for i in range(FRAMES)] == [9, 10, 11, 12, 13]
    assert sequence.mask_kinds() == {"grey in RGB": FRAMES}


@pytest.mark.parametrize("listed", [False, True])
def test_equal_channels_among_coded_masks_are_a_code(make: Make, tmp_path: Path, listed: bool) -> None:
    """A frame in which the only instance has the colour (5, 5, 5) is no frame of grey ids."""
    values = [70_000, 5 * 65793, 5, 70_000, 5 * 65793]
    sequence = open_sequence(make("replica"), masks=deva_folder(tmp_path / "d", values, values if listed else None))
    assert [ids_of(sequence, i)[1] for i in range(FRAMES)] == [2, 3, 1, 2, 3]


def test_segments_that_pred_json_does_not_list(make: Make, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    masks = deva_folder(tmp_path / "deva", listed=LONG_IDS[:4])
    mixed = half(LONG_IDS[0])
    mixed[0, 0] = 99_999
    write_rgb(masks / "Annotations" / "frame000000.png", mixed)
    sequence = open_sequence(make("replica"), masks=masks)
    with caplog.at_level(logging.WARNING):
        mask = sequence.frame(0).mask
    assert mask is not None and mask[0, 0] == 0 and mask[0, -1] == 1
    assert "pred.json does not list count as unlabelled" in caplog.text
    with pytest.raises(SequenceError, match=r"frame000004\.png: not one of its ids is listed in .*pred\.json"):
        sequence.frame(4)


@pytest.mark.parametrize("content", ["{", "[]", '{"annotations": [{"file_name": "x"}]}', '{"annotations": []}'])
def test_useless_pred_json(make: Make, tmp_path: Path, content: str, caplog: pytest.LogCaptureFixture) -> None:
    masks = deva_folder(tmp_path / "deva")
    (masks / "Annotations" / "pred.json").write_text(content)
    with caplog.at_level(logging.WARNING):
        assert ids_of(open_sequence(make("replica"), masks=masks), 3) == [0, 5]
    assert "pred.json is not used" in caplog.text


@pytest.mark.parametrize("long", [False, True])
def test_thousand_ids(make: Make, tmp_path: Path, long: bool) -> None:
    values = np.random.default_rng(0).permutation(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) + 233  # 768 a frame
    for i in range(FRAMES):
        ids = (values + 58 * i) % 1000 + 1
        path = tmp_path / "m" / f"frame{i:06d}.png"
        if long:
            write_rgb(path, ids * 16_001)
        else:
            write_grey(path, ids.astype(np.uint16))
    sequence = open_sequence(make("replica"), masks=tmp_path / "m")
    masks = [frame.mask for frame in sequence.stream()]
    for i, mask in enumerate(masks):
        np.testing.assert_array_equal(mask, (values + 58 * i) % 1000 + 1)
    assert len(np.unique(masks)) == 1000


def test_more_ids_than_fit(make: Make, tmp_path: Path) -> None:
    """Pictures in place of masks; not forgiven, whatever is done about bad frames."""
    masks = tmp_path / "m"
    for i in range(FRAMES):
        write_rgb(masks / f"frame{i:06d}.png", np.arange(i * 20_000, (i + 1) * 20_000).reshape(100, 200) * 3)
    for policy in ("error", "skip"):
        sequence = open_sequence(make("replica"), masks=masks, on_bad_frame=policy)  # type: ignore[arg-type]
        with pytest.raises(SequenceError, match=rf"{masks}: expected at most 65535 different ids, found 99999"):
            sequence.frame(2)
        shutil.rmtree(tmp_path / "replica")


@pytest.mark.parametrize("value", [0, 65_535])
def test_empty_mask_and_mask_of_one_id(make: Make, tmp_path: Path, value: int) -> None:
    write_grey(tmp_path / "m" / "frame000000.png", np.full((HEIGHT, WIDTH), value, np.uint16))
    write_rgb(tmp_path / "rgb" / "frame000000.png", np.full((HEIGHT, WIDTH), value))
    folder = make("replica")
    for masks in ("m", "rgb"):
        assert ids_of(open_sequence(folder, masks=tmp_path / masks), 0) == [value]


def test_other_size(make: Make, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Nearest pixel, said once."""
    for i in range(FRAMES):
        ids = np.arange(12 * 16, dtype=np.uint16).reshape(12, 16)
        write_grey(tmp_path / "m" / f"frame{i:06d}.png", ids)
    sequence = open_sequence(make("replica"), masks=tmp_path / "m")
    with caplog.at_level(logging.WARNING):
        masks = [frame.mask for frame in sequence.stream()]
    np.testing.assert_array_equal(masks[4], ids.repeat(2, 0).repeat(2, 1))
    (record,) = caplog.records
    assert "are 16x12, the images 32x24: resampled to the nearest pixel" in record.getMessage()


def test_other_aspect(make: Make, tmp_path: Path) -> None:
    write_grey(tmp_path / "m" / "frame000000.png", half(3, (24, 24)).astype(np.uint8))
    sequence = open_sequence(make("replica"), masks=tmp_path / "m")
    with pytest.raises(SequenceError, match=r"frame000000\.png: mask is 24x24, expected 32x24"):
        sequence.frame(0)


def test_missing_mask(make: Make) -> None:
    folder = make("replica")
    for i in (1, 4):
        (folder / "semantic_instance" / f"semantic_instance_{i}.png").unlink()
    sequence = open_sequence(folder)
    assert [frame.mask is None for frame in sequence.stream()] == [False, True, False, False, True]
    assert "2 of 5 frames have no mask" in sequence.warnings
    assert "1 of 2 frames has no mask" in open_sequence(folder, start=3).warnings
    assert open_sequence(folder, start=2, stop=4).warnings == []
    none = open_sequence(folder, start=4)
    assert not none.has_masks and "1 of 1 frames has no mask" in none.warnings
    assert open_sequence(make("tum")).warnings == []  # no masks at all is nothing to warn of


def damage(folder: Path, kind: str) -> str:
    path = folder / "semantic_instance" / "semantic_instance_3.png"
    if kind == "truncated":
        path.write_bytes(path.read_bytes()[:-9])
        return r"semantic_instance_3\.png: PNG is truncated"
    if kind == "empty file":
        path.write_bytes(b"")
        return r"semantic_instance_3\.png: file is empty"
    if kind == "jpeg":
        path.write_bytes(cv2.imencode(".jpg", half(3).astype(np.uint8))[1].tobytes())
        return r"semantic_instance_3\.png: expected a PNG mask"
    picture = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    picture[:5, :5, 3] = 128
    assert cv2.imwrite(str(path), picture if kind == "transparent" else picture[..., :3].astype(np.uint16))
    return r"semantic_instance_3\.png: expected .*" + ("transparent" if kind == "transparent" else "16-bit")


@pytest.mark.parametrize("lazy", [False, True])
@pytest.mark.parametrize("kind", ["truncated", "empty file", "jpeg", "transparent", "16-bit colours"])
def test_damaged_mask(make: Make, kind: str, lazy: bool) -> None:
    folder = make("replica")
    message = damage(folder, kind)
    with pytest.raises(SequenceError, match=message):
        for frame in open_sequence(folder).stream(masks="lazy" if lazy else True):
            frame.load_mask()
    sequence = open_sequence(folder, on_bad_frame="skip")
    frames = list(sequence.stream(masks="lazy" if lazy else True))
    assert [frame.load_mask() is None for frame in frames] == [False, False, False, True, False]
    assert sequence.skipped_frames == [] and list(sequence.mask_problems) == [3]
    with pytest.raises(SequenceError, match=message):
        raise SequenceError(sequence.mask_problems[3])
    assert len(list(open_sequence(folder).stream(masks=False))) == 5


@pytest.mark.parametrize("name", ["replica", "7scenes", "scannet", "folder"])
def test_lazy_equals_eager(make: Make, name: str) -> None:
    sequence = open_sequence(make(name), scale=0.5)
    eager, lazy = list(sequence.stream()), list(sequence.stream(masks="lazy"))
    for a, b in zip(eager, lazy, strict=True):
        assert b.mask is None and a.mask_loader is None and a.mask is not None
        np.testing.assert_array_equal(a.mask, b.load_mask())
        np.testing.assert_array_equal(a.mask, a.load_mask())
    for frame in sequence.stream(masks=False):
        assert frame.mask is None and frame.mask_loader is None and frame.load_mask() is None


def test_unshared_masks_differ_where_things_share_a_pixel_alone(make: Make) -> None:
    sequence = open_sequence(make("replica"), scale=0.5)
    for a, b in zip(sequence.stream(), sequence.stream(masks="unshared"), strict=True):
        assert a.mask is not None and b.mask is not None and (b.mask == 0).any()
        np.testing.assert_array_equal(np.where(b.mask > 0, a.mask, 0), b.mask)


def test_lazy_without_masks(make: Make) -> None:
    assert open_sequence(make("tum")).frame(0, masks="lazy").load_mask() is None


@pytest.mark.parametrize(
    "layout",
    [
        "{number}.png", "mask_{number:03d}.png", "frame{number:06d}.png",
        "semantic_instance/semantic_instance_{number}.png",
        "Annotations/frame{number:06d}.png", "Annotations/video/frame{number:06d}.png", "instance-filt/{number}.png",
    ],
)  # fmt: skip
def test_where_masks_are_found(make: Make, tmp_path: Path, layout: str) -> None:
    folder = make("replica")
    for i in range(FRAMES):
        write_grey(tmp_path / "m" / layout.format(number=i), half(50 + i).astype(np.uint8))
    sequence = open_sequence(folder, masks=tmp_path / "m")
    assert [ids_of(sequence, i)[1] for i in range(FRAMES)] == [50, 51, 52, 53, 54]
    assert sequence.instance_names == {}  # they named other ids


def test_masks_among_images_of_the_same_name(make: Make) -> None:
    """A 7-Scenes folder as masks: not its colour images."""
    folder = make("7scenes")
    sequence = open_sequence(folder, masks=folder)
    assert [ids_of(sequence, i)[1] for i in range(FRAMES)] == [1, 2, 3, 4, 5]


def test_own_masks_given_by_name_keep_their_names(make: Make) -> None:
    folder = make("replica")
    assert open_sequence(folder, masks=folder).instance_names == {1: "floor"}


def test_two_masks_of_one_number(make: Make, tmp_path: Path) -> None:
    for name in ("a_1", "b_1"):
        write_grey(tmp_path / "m" / f"{name}.png", half(1).astype(np.uint8))
    with pytest.raises(SequenceError, match=r"a_1\.png and b_1\.png both have the number of frame000001\.jpg"):
        open_sequence(make("replica"), masks=tmp_path / "m")


@pytest.mark.parametrize("names", [["instance-filt"], ["instance"], ["instance", "instance-filt"]])
def test_scannet_folders(make: Make, names: list[str]) -> None:
    folder = make("scannet")
    kept = folder / "instance-filt"
    if "instance" in names:
        for path in kept.iterdir():
            write_grey(folder / "frames" / "instance" / path.name, half(77, (64, 48)).astype(np.uint8))
    if "instance-filt" not in names:
        shutil.rmtree(kept)
    assert ids_of(open_sequence(folder), 0)[1] == (1 if "instance-filt" in names else 77)


def test_inspection_tells_the_kind(make: Make, tmp_path: Path) -> None:
    folder = make("replica")
    assert inspect_sequence(open_sequence(folder)).mask_kinds == {"grey": 5}
    damage(folder, "empty file")
    assert inspect_sequence(open_sequence(folder)).mask_kinds == {"grey": 4, "unreadable": 1}
    masks = deva_folder(tmp_path / "deva", listed=LONG_IDS)
    assert inspect_sequence(open_sequence(folder, masks=masks)).mask_kinds == {"RGB-coded": 5}
    shutil.rmtree(folder / "semantic_instance")
    assert inspect_sequence(open_sequence(folder)).mask_kinds == {}


def test_reader_from_several_threads(tmp_path: Path) -> None:
    from concurrent.futures import ThreadPoolExecutor

    deva_folder(tmp_path)
    files = sorted((tmp_path / "Annotations").iterdir())
    with ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            reader = MaskReader(files)
            masks = list(pool.map(reader.read, files))
            assert [int(mask.max()) for mask in masks] == [1, 2, 4, 5, 3]
