# SPDX-License-Identifier: Apache-2.0
"""Writes cells with random content until it is killed, noting what it begins and what is done."""

from __future__ import annotations

import json
import random
import sys
import zlib
from pathlib import Path

from ggslam.submaps.cell_records import CellWrite
from ggslam.submaps.grid import GridStore

PARTS = ("points.pcd", "gaussians.npz", "features.npz", "places.npz")


def main(folder: Path, log: Path, seed: int) -> None:
    generator = random.Random(seed)
    with log.open("a") as file:

        def note(*values: object) -> None:
            file.write(json.dumps(values) + "\n")
            file.flush()

        note("opening")
        store = GridStore.open(folder, write=True)
        while True:
            keys = [(key, 0, -key) for key in generator.sample(range(12), generator.choice((1, 1, 1, 4)))]
            if generator.random() < 0.1:
                note("begin", {str(keys[0][0]): {}})
                store.remove(keys[0])
                note("done")
                continue
            contents = [
                {name: generator.randbytes(generator.randrange(60_000)) for name in generator.sample(PARTS, 2)}
                for _ in keys
            ]
            sums = [{name: zlib.crc32(data) for name, data in parts.items()} for parts in contents]
            note("begin", {str(key[0]): values for key, values in zip(keys, sums, strict=True)})
            store.put_cells([CellWrite(key, parts) for key, parts in zip(keys, contents, strict=True)])
            note("done")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
