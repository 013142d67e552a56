# SPDX-License-Identifier: Apache-2.0
"""The tool that finds waits and mixing of host and device tensors, and what it finds in rendering and training."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch
from device_watch import DEVICE, DeviceMixing, DeviceTensor, DeviceWatch, UnorderedWork
from device_watch.order import WorkOrder

from ggslam.cuda.streams import SideStream
from ggslam.mapping.cuda.class_learning import ClassKernels
from ggslam.mapping.cuda.class_table import CudaClassTable
from ggslam.mapping.cuda.keyframe_states import KeyframeStates
from ggslam.mapping.cuda.losses import CudaImageLoss
from ggslam.mapping.losses import LossTarget
from ggslam.mapping.settings import LossSettings
from ggslam.rendering.adam import ADAM_GROUPS, AdamSettings
from ggslam.rendering.cuda import CudaRasterizer
from ggslam.rendering.exposure import identity_exposure
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap


@pytest.fixture
def watch() -> Iterator[DeviceWatch]:
    with DeviceWatch() as watch:
        yield watch


def ramp(*shape: int) -> torch.Tensor:
    return torch.arange(float(np.prod(shape)), device="cuda").view(shape)


WAITS: dict[str, tuple[str, Callable[[torch.Tensor], object]]] = {
    "item": ("_local_scalar_dense", lambda x: x[0, 0].item()),
    "float": ("_local_scalar_dense", lambda x: float(x.sum())),
    "bool": ("_local_scalar_dense", lambda x: bool((x > 3).any())),
    "slice": ("_local_scalar_dense", lambda x: x[: (x[0] > 0).sum()]),
    "tolist": ("tolist", lambda x: x.tolist()),
    "cpu": ("to", lambda x: x.cpu()),
    "to": ("to", lambda x: x.to("cpu", torch.float64)),
    "copy to host": ("copy_", lambda x: torch.empty(4, 3).copy_(x)),
    "copy to pageable memory": ("copy_", lambda x: torch.empty(4, 3).copy_(x, non_blocking=True)),
    "nonzero": ("nonzero", lambda x: x.nonzero()),
    "where": ("nonzero", lambda x: torch.where(x > 3)),
    "masked_select": ("masked_select", lambda x: x.masked_select(x > 3)),
    "mask": ("index", lambda x: x[x > 3]),
    "mask of rows": ("index", lambda x: x[x[:, 0] > 3]),
    "put by mask": ("index_put_", lambda x: x.__setitem__(x > 3, x[x > 3] * 2)),
    "unique": ("_unique2", lambda x: torch.unique(x)),
    "bincount": ("bincount", lambda x: torch.bincount(x.long().view(-1))),
    "repeats": ("repeat_interleave", lambda x: x[0].repeat_interleave(x[0].long())),
    "equal": ("equal", lambda x: torch.equal(x, x)),
    "isin": ("isin", lambda x: torch.isin(x, ramp(30))),
    "inverse": ("_linalg_check_errors", lambda x: torch.linalg.inv(torch.eye(3, device="cuda"))),
    "eigenvalues": ("_linalg_eigh", lambda x: torch.linalg.eigh(torch.eye(3, device="cuda"))),
    "synchronize": ("torch.cuda.synchronize", lambda x: torch.cuda.synchronize()),
    "event": ("Event.synchronize", lambda x: torch.cuda.current_stream().record_event().synchronize()),
}


@pytest.mark.parametrize("case", WAITS)
def test_waits_are_found(watch: DeviceWatch, case: str) -> None:
    operation, run = WAITS[case]
    x = ramp(4, 3)
    assert not watch.waits
    run(x)
    assert operation in {wait.operation for wait in watch.waits}
    assert all(wait.where.startswith("test_device_watch.py:") for wait in watch.waits)


def test_the_same_on_the_host_is_no_wait(watch: DeviceWatch) -> None:
    x = torch.arange(12.0).view(4, 3)
    for name in ("item", "bool", "tolist", "cpu", "nonzero", "mask", "unique", "inverse", "equal"):
        if name != "inverse":
            WAITS[name][1](x)
    x.numpy()[0, 0] = 5
    torch.linalg.inv(torch.eye(3))
    assert not watch.waits and not watch.uploads and x[0, 0] == 5


def test_work_on_the_device_is_no_wait(watch: DeviceWatch) -> None:
    x = ramp(4, 3)
    y = torch.where(x > 3, x * 2, 0.0).sum(0)
    x[1:] = 0.5
    x[x > 3] = 7.0
    x[torch.tensor([0], device="cuda")] = y
    watch.forget()
    x.index_add_(0, torch.arange(2, device="cuda"), torch.ones(2, 3, device="cuda"))
    z = torch.cat([x, torch.zeros_like(x)]).clamp_(max=3).double()
    z = z.mT @ torch.ones(8, 1, dtype=torch.double, device=DEVICE)
    torch.sort(x.view(-1), stable=True), x.cumsum(0), x.repeat_interleave(2, 0), x.split(2), x.masked_fill(x > 1, 2)
    torch.rand(3, device="cuda", generator=torch.Generator(device="cuda").manual_seed(1))
    assert not watch.waits and not watch.uploads
    assert isinstance(z, DeviceTensor) and z.is_cuda and z.device == DEVICE and z.dtype == torch.float64
    assert not isinstance(x.cpu(), DeviceTensor) and len(watch.waits) == 1


def test_results_are_right_and_views_share_memory(watch: DeviceWatch) -> None:
    x = ramp(4, 3)
    row = x[1]
    row.mul_(10).add_(1)
    x[2, 0] = -1
    expected = np.arange(12.0).reshape(4, 3)
    expected[1] = expected[1] * 10 + 1
    expected[2, 0] = -1
    assert watch.read(x).tolist() == expected.tolist()
    assert row.data_ptr() == x.data_ptr() + 12 and isinstance(row.add_(0), DeviceTensor)


UPLOADS: dict[str, Callable[[torch.Tensor], object]] = {
    "to": lambda x: torch.ones(2).to("cuda"),
    "cuda": lambda x: torch.ones(2).cuda(),
    "numpy": lambda x: torch.from_numpy(np.ones(2, np.float32)).to(x.device, non_blocking=True),
    "tensor": lambda x: torch.tensor([1.0, 2.0], device="cuda"),
    "as_tensor": lambda x: torch.as_tensor(np.ones(2, np.float32), device="cuda"),
    "copy": lambda x: x[0, :2].copy_(torch.ones(2)),
    "assignment": lambda x: x.__setitem__((0, slice(2)), torch.ones(2)),
    "new_tensor": lambda x: x.new_tensor([1.0, 2.0]),
}


@pytest.mark.parametrize("case", UPLOADS)
def test_uploads_are_found(watch: DeviceWatch, case: str) -> None:
    x = ramp(4, 3)
    UPLOADS[case](x)
    assert [(upload.bytes, upload.blocking) for upload in watch.uploads] == [(8, True)] and not watch.waits


def test_indices_and_numbers_of_the_host_are_uploads(watch: DeviceWatch) -> None:
    x = ramp(4, 3)
    x[[0, 2]]
    x[torch.tensor([0, 2])]
    x[0, 0] = 0.5  # one number: torch copies it
    assert [upload.bytes for upload in watch.uploads] == [16, 16, 4]


def test_asynchronous_uploads_from_page_locked_memory_do_not_block(watch: DeviceWatch) -> None:
    source = torch.ones(2).pin_memory()
    assert source.is_pinned() and not torch.ones(2).is_pinned() and torch.empty(2, pin_memory=True).is_pinned()
    source.to("cuda", non_blocking=True)
    source.to("cuda")
    assert [upload.blocking for upload in watch.uploads] == [False, True]


def test_asynchronous_downloads_arrive_with_a_wait(watch: DeviceWatch) -> None:
    x, target = ramp(3), torch.empty(3, pin_memory=True)
    target.copy_(x, non_blocking=True)
    other = x.to("cpu", non_blocking=True)
    before = torch.cuda.Event()
    before.record()
    third = x.to("cpu", non_blocking=True)
    x += 1
    assert len(watch.downloads) == 3 and not watch.waits
    assert target.isnan().all() and other.isnan().all()
    before.synchronize()
    assert target.tolist() == other.tolist() == [0, 1, 2] and third.isnan().all()
    torch.cuda.synchronize()
    assert third.tolist() == [0, 1, 2] and len(watch.waits) == 2


MIXED: dict[str, Callable[[torch.Tensor, torch.Tensor], object]] = {
    "add": lambda x, y: x + y,
    "in place": lambda x, y: x.mul_(y),
    "into host memory": lambda x, y: y.add_(x.sum()),
    "cat": lambda x, y: torch.cat([x, y]),
    "matmul": lambda x, y: x.T @ y,
    "where": lambda x, y: torch.where(x > 1, x, y),
    "index_select": lambda x, y: x.index_select(0, torch.tensor([0])),
    "put": lambda x, y: x.__setitem__(torch.tensor([0, 1], device="cuda"), y[:2]),
    "generator": lambda x, y: torch.rand(3, device="cuda", generator=torch.Generator()),
    "generator of the device": lambda x, y: torch.rand(3, generator=torch.Generator("cuda")),
    "another device": lambda x, y: torch.zeros(3, device="cuda:1"),
}


@pytest.mark.parametrize("case", MIXED)
def test_mixing_is_refused(watch: DeviceWatch, case: str) -> None:
    x, y = ramp(4, 3), torch.ones(4, 3)
    with pytest.raises(DeviceMixing):
        MIXED[case](x, y)


def test_numbers_of_the_host_may_be_mixed(watch: DeviceWatch) -> None:
    x = ramp(4, 3)
    assert (x * torch.tensor(2.0)).is_cuda and x.fill_(torch.tensor(3.0)).is_cuda
    assert x.masked_fill(x > 1, torch.tensor(0.0)).is_cuda
    assert not watch.waits and not watch.uploads


def test_device_memory_is_no_array_of_numpy(watch: DeviceWatch) -> None:
    for convert in (lambda x: x.numpy(), np.asarray, np.array):
        with pytest.raises(TypeError, match="numpy"):
            convert(ramp(2))


def test_operations_on_uint16_are_refused(watch: DeviceWatch) -> None:
    depth = torch.full((4, 3), 7, dtype=torch.int16, device="cuda").view(torch.uint16)
    row = torch.empty(3, dtype=torch.uint16, device="cuda").copy_(depth[2])
    assert watch.read(row.view(torch.int16).to(torch.int32) & 0xFFFF).tolist() == [7, 7, 7]
    assert depth.to("cuda", torch.float32).sum().item() == 84
    for refused in (
        lambda: depth + 1, lambda: depth[row.view(torch.int16).long() - 7], lambda: depth == 7, lambda: depth.sum(),
        lambda: torch.zeros(3, dtype=torch.uint16, device="cuda"), lambda: depth.zero_(),
    ):  # fmt: skip
        with pytest.raises(NotImplementedError, match="uint16"):
            refused()


def test_tables_that_grow_are_kept_for_the_work_that_reads_them(watch: DeviceWatch) -> None:
    """They were made on another stream than the one on which they grow in real time."""
    states = KeyframeStates(library=watch.library)
    for _ in range(65):
        states.append(np.eye(4), np.ones((3, 2)))
    table = CudaClassTable(np.random.default_rng(0), ClassKernels(DEVICE, watch.library))
    assert [record.where.split(":")[0] for record in watch.kept] == ["cuda/streams.py"]
    table.add(np.arange(1, 300, dtype=np.uint16))
    assert len(watch.kept) == 5
    assert watch.read(states.pose(64)).tolist() == np.eye(4)[:3].ravel().tolist()


class Job(ctypes.Structure):
    _fields_ = [("values", ctypes.c_void_p), ("stream", ctypes.c_void_p)]


class Jobs(ctypes.Structure):
    _fields_ = [("count", ctypes.c_int), ("job", Job)]


def test_host_addresses_given_to_kernels_are_refused(watch: DeviceWatch) -> None:
    x, y = ramp(4, 3), torch.ones(4, 3)
    watch.check_addresses("test", Jobs(1, Job(x[1].data_ptr(), 12345)))
    with pytest.raises(DeviceMixing, match="values"):
        watch.check_addresses("test", Jobs(1, Job(y.data_ptr(), None)))
    freed = x.data_ptr()
    del x
    with pytest.raises(DeviceMixing, match="values"):
        watch.check_addresses("test", Jobs(1, Job(freed, None)))


def test_threads_are_watched(watch: DeviceWatch) -> None:
    found: list[torch.Tensor] = []
    thread = threading.Thread(target=lambda: found.append(torch.ones(3, device="cuda") + 1))
    thread.start()
    thread.join()
    assert watch.read(found[0]).tolist() == [2, 2, 2]
    thread = threading.Thread(target=lambda: found[0].tolist())
    thread.start()
    thread.join()
    assert [wait.operation for wait in watch.waits] == ["tolist"]


def test_nothing_is_left_behind() -> None:
    with DeviceWatch() as watch:
        x = ramp(3)
    with pytest.raises(RuntimeError, match="outside"):
        x + 1
    assert watch.read(x).tolist() == [0, 1, 2]
    assert torch.Generator().device.type == "cpu" and torch.Generator.__module__ == "torch._C"
    assert torch.tensor([1.0]).item() == 1 and not watch.waits


# --- rendering and training -------------------------------------------------------------------------------------------

CAMERA = Camera(40, 24, 36.0, 36.0, 19.5, 11.5)
POSE = np.eye(4)


def make_map(count: int = 60) -> GaussianMap:
    random = torch.Generator(device="cuda").manual_seed(0)

    def uniform(*shape: int, low: float = -1.0, high: float = 1.0) -> torch.Tensor:
        return low + (high - low) * torch.rand(*shape, generator=random, device="cuda")

    gaussians = GaussianMap(1, 4, DEVICE)
    means = torch.stack([uniform(count), 0.5 * uniform(count), uniform(count, low=1.5, high=3.0)], 1)
    gaussians.insert(
        means, uniform(count, 4), uniform(count, 3, low=-3.0, high=-2.0), uniform(count), uniform(count, 3, low=0.0),
        uniform(count, 4),
    )  # fmt: skip
    return gaussians


def test_a_training_step_mixes_nothing_and_waits_for_its_projection_only(watch: DeviceWatch) -> None:
    gaussians, settings = make_map(), AdamSettings(dict.fromkeys(ADAM_GROUPS, 1e-3))
    target = LossTarget(
        torch.full((24, 40, 3), 128, dtype=torch.uint8, device="cuda"),
        torch.full((24, 40), 2000, dtype=torch.int16, device="cuda").view(torch.uint16),
        1e-3,
        torch.ones(3, 2, device="cuda"),
    )
    before = watch.read(gaussians.means)
    rasterizer, loss = CudaRasterizer(), CudaImageLoss()  # find the watch's kernels by themselves
    watch.forget()
    for _ in range(3):
        view = rasterizer.forward(gaussians, CAMERA, POSE, median_depth=True)
        result = loss.evaluate(view, target, LossSettings())
        step = rasterizer.backward_step(
            gaussians, result.d_image, result.d_depth, result.d_alpha, view.features, optimizer=settings
        )
        assert isinstance(step.twist, DeviceTensor) and isinstance(result.exposure_gradient, DeviceTensor)
    called = {record.operation for record in watch.calls}
    assert called == {"plan", "project", "composite", "wait", "image_loss", "backward"}
    assert [wait.operation for wait in watch.waits] == 3 * ["ggslam_cuda_wait"]
    assert not watch.uploads and not watch.downloads
    assert (watch.read(gaussians.means) != before).any()
    assert result.read_values().total > 0 and watch.waits[-1].where.startswith("mapping/cuda/losses.py:")


def test_images_of_the_host_are_refused_by_the_kernels(watch: DeviceWatch) -> None:
    rasterizer = CudaRasterizer(library=watch.library)
    images = {"image": torch.empty(3, 24, 40)}  # nothing in Python checks what is given here
    with pytest.raises(DeviceMixing, match="image is no address of device memory"):
        rasterizer.render(make_map(), CAMERA, POSE, rasterizer.memory, images)


# --- streams ----------------------------------------------------------------------------------------------------------


def use_beside(stream: torch.cuda.Stream, x: torch.Tensor) -> None:
    with torch.cuda.stream(stream):
        x.add_(1.0)


def test_two_streams_at_the_same_memory_are_found(watch: DeviceWatch) -> None:
    x, stream = ramp(4), torch.cuda.Stream()
    with pytest.raises(UnorderedWork, match=r"add_ .* on stream .* and .* on stream 0"):
        use_beside(stream, x[1:])  # the same memory
    stream.wait_stream(torch.cuda.current_stream())
    use_beside(stream, x)
    with pytest.raises(UnorderedWork, match="mul"):
        x * 2.0


@pytest.mark.parametrize("how", ["stream", "event", "host", "download", "query"])
def test_who_waits_may_use_what_others_used(watch: DeviceWatch, how: str) -> None:
    x, stream, event = ramp(4), torch.cuda.Stream(), torch.cuda.Event()
    event.record()
    if how == "stream":
        stream.wait_stream(torch.cuda.current_stream())
    elif how == "event":
        stream.wait_event(event)
    elif how == "host":
        torch.cuda.current_stream().synchronize()
    elif how == "download":
        x.cpu()
    else:
        assert event.query()
    use_beside(stream, x)
    event.record(stream)
    torch.cuda.current_stream().wait_event(event)
    assert watch.read(x * 2.0).tolist() == [2, 4, 6, 8]


def test_an_event_of_before_says_nothing_of_what_came_after(watch: DeviceWatch) -> None:
    x, stream, event = ramp(4), torch.cuda.Stream(), torch.cuda.Event()
    event.record()
    x.add_(1.0)
    stream.wait_event(event)
    with pytest.raises(UnorderedWork):
        use_beside(stream, x)


def test_work_of_a_slow_device_is_done_when_the_host_waited() -> None:
    with DeviceWatch(is_slow=True):
        x, event, stream = ramp(4), torch.cuda.Event(), torch.cuda.Stream()
        assert event.query()  # never recorded
        event.record()
        assert not event.query() and not torch.cuda.current_stream().query()
        with pytest.raises(UnorderedWork):
            use_beside(stream, x)
        event.synchronize()
        assert event.query()
        use_beside(torch.cuda.Stream(), x)


def test_streams_may_read_the_same_memory(watch: DeviceWatch) -> None:
    x, stream = ramp(4), torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        y = x + 1.0
    assert watch.read(x + 2.0).tolist() == [2, 3, 4, 5]
    with pytest.raises(UnorderedWork):
        y + 1.0


def test_memory_that_was_given_back_is_new(watch: DeviceWatch) -> None:
    order = WorkOrder()
    order.start("a", set(), {1})
    order.enter(7)
    order.forget(1)
    order.start("b", set(), {1})
    order.leave()
    with pytest.raises(UnorderedWork):
        order.start("c", {1}, set())


def test_calls_of_kernels_use_all_that_they_are_given(watch: DeviceWatch) -> None:
    states, stream = KeyframeStates(DEVICE, watch.library), torch.cuda.Stream()
    states.append(np.eye(4), identity_exposure())
    with torch.cuda.stream(stream), pytest.raises(UnorderedWork, match="keyframe_write"):
        states.write_pose(0, np.eye(4))


def test_a_side_stream_is_before_what_follows(watch: DeviceWatch) -> None:
    x, side = ramp(4), SideStream(DEVICE, host_waits=False)
    y = ramp(4)
    with side:
        x.add_(1.0)
    assert watch.read(x * 2.0).tolist() == [2, 4, 6, 8] and not watch.waits
    with pytest.raises(UnorderedWork), side:
        y.add_(1.0)
