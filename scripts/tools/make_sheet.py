# SPDX-License-Identifier: Apache-2.0
"""Puts pictures into one: rows of equal height, each as wide as the sheet.

python scripts/tools/make_sheet.py docs/pictures/objects.jpg --width 960 --row a.png b.png c.png --row d.png e.png f.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

JPEG_QUALITY = 88


def row_of(pictures: list[np.ndarray], width: int, gap: int) -> np.ndarray:
    """Pictures of any sizes at one height, `width` pixels together."""
    room = width - gap * (len(pictures) - 1)
    height = room / sum(p.shape[1] / p.shape[0] for p in pictures)
    edges = np.round(np.cumsum([0, *(height * p.shape[1] / p.shape[0] for p in pictures)])).astype(int)
    parts = []
    for number, picture in enumerate(pictures):
        size = (int(edges[number + 1] - edges[number]), round(height))
        shrinks = size[0] < picture.shape[1]
        parts.append(cv2.resize(picture, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC))
        parts.append(np.full((size[1], gap, 3), 255, np.uint8))
    return np.concatenate(parts[:-1], 1)


def main() -> None:
    """Makes a sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--width", type=int, default=960)
    parser.add_argument("--gap", type=int, default=0, help="white pixels between pictures")
    parser.add_argument("--crop", help="X Y W H of every picture, as shares of it", nargs=4, type=float)
    parser.add_argument("--row", nargs="+", action="append", required=True, type=Path)
    args = parser.parse_args()
    rows: list[np.ndarray] = []
    for paths in args.row:
        pictures = [cv2.imread(str(path), cv2.IMREAD_COLOR) for path in paths]
        missing = [str(path) for path, picture in zip(paths, pictures, strict=True) if picture is None]
        if missing:
            raise SystemExit(f"cannot read {', '.join(missing)}")
        if args.crop:
            x, y, w, h = args.crop
            pictures = [p[round(y * p.shape[0]) : round((y + h) * p.shape[0]),
                          round(x * p.shape[1]) : round((x + w) * p.shape[1])] for p in pictures]  # fmt: skip
        rows += [row_of(pictures, args.width, args.gap), np.full((args.gap, args.width, 3), 255, np.uint8)]
    sheet = np.concatenate(rows[:-1] if args.gap else rows)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(args.out), sheet, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    print(f"wrote {args.out}: {sheet.shape[1]}x{sheet.shape[0]}")


if __name__ == "__main__":
    main()
