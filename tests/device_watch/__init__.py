# SPDX-License-Identifier: Apache-2.0
"""Finds, without a GPU, what would go wrong or take long with tensors on one: host and device tensors in one operation,
host addresses given to kernels, and waits of the host for the device.

    with DeviceWatch() as watch:
        rasterizer = CudaRasterizer(library=watch.library)   # or Slam(camera, replace(config, device="cuda"))
        ...
    assert watch.waits == []

Within the watch, `device="cuda"` makes a tensor that says it is there while its data are in host memory; operations
run on the CPU, and kernels in their emulation. What is recorded:

    waits      operations for which the host would wait until the device has done all that it was given
    uploads    copies from host memory; `blocking` unless they are asynchronous and from page-locked memory
    downloads  asynchronous copies to page-locked memory, which holds garbage until the host has waited for them
    calls      functions of the kernels' library
    kept       tensors whose memory is kept for work on a stream (record_stream)

What raises: `DeviceMixing` as said; `UnorderedWork` where two streams use the same memory, one of them to write, and
neither is sure to be first (calls of the kernels' library count as writing to all that they are given);
NotImplementedError for operations on uint16 that torch may not have on a device; whatever torch itself refuses for
tensors there, such as `.numpy()`.
Not modelled: CUDA graphs (the emulation has them), memory that is used again too early, autograd, operations that
torch has for one of both only. Threads are watched if they are started within.
"""

from device_watch.records import DeviceMixing, Record, UnorderedWork
from device_watch.tensors import DEVICE, DeviceTensor
from device_watch.watch import DeviceWatch

__all__ = ["DEVICE", "DeviceMixing", "DeviceTensor", "DeviceWatch", "Record", "UnorderedWork"]
