# SPDX-License-Identifier: Apache-2.0
"""Codes a cloud again and again, for benchmarks that let versions of ggslam take turns: each in a process of its own.

    PYTHONPATH=CHECKOUT python scripts/benchmarks/gpcc_worker.py CLOUD.npz QP

For every line of the input it encodes and decodes once, on one core, and prints seconds of the processor: encoding,
decoding, each in user mode and altogether; and the bytes of the stream.
"""

from __future__ import annotations

import dataclasses
import resource
import sys

import numpy as np

from ggslam.coding import CodecSettings, decode_cloud, encode_cloud


def processor_time() -> np.ndarray:
    """Seconds so far, in user mode and altogether."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return np.array([used.ru_utime, used.ru_utime + used.ru_stime])


def main() -> None:
    """Takes turns until the input ends."""
    source = np.load(sys.argv[1])
    grid, colors = source["grid"], {"color": source["colors"]}
    names = {field.name for field in dataclasses.fields(CodecSettings)}  # earlier versions call threads workers
    settings = CodecSettings(qp=int(sys.argv[2]), **{name: 1 for name in ("threads", "workers") if name in names})
    print("ready", flush=True)
    for _ in sys.stdin:
        start = processor_time()
        data = encode_cloud(grid, colors, settings).data
        middle = processor_time()
        decode_cloud(data, 1)
        end = processor_time()
        print(*(middle - start), *(end - middle), len(data), flush=True)


if __name__ == "__main__":
    main()
