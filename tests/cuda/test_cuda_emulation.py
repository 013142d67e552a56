# SPDX-License-Identifier: Apache-2.0
"""The emulation of CUDA notices what a GPU would not forgive."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from cuda_emulation import EMULATION, FLAGS

from ggslam.cuda.compiler import KERNELS

SOURCE = """
#include "common/recorded_work.cuh"
using namespace ggslam::cuda;

// Each value moves on by one thread, by way of shared memory.
__global__ void __launch_bounds__(64) right(float* out) {
  GGSLAM_SHARED float values[64];
  values[threadIdx.x] = static_cast<float>(threadIdx.x);
  __syncthreads();
  out[threadIdx.x] = values[(threadIdx.x + 1) % 64];
}
__global__ void misaligned(float* out) { *reinterpret_cast<float4*>(out + 1) = make_float4(1, 2, 3, 4); }
__global__ void beyond(float* out) {
  GGSLAM_SHARED float values[64];
  values[threadIdx.x + static_cast<int>(blockDim.x) / 2] = 1.0f;
  out[threadIdx.x] = values[threadIdx.x];
}
__global__ void unwritten(float* out) {
  GGSLAM_SHARED float values[64];
  if (blockIdx.x == 0) values[threadIdx.x] = 1.0f;
  out[threadIdx.x] = values[threadIdx.x];
}
__global__ void part_of_a_warp(float* out) {
  if (threadIdx.x % 32 < 16) out[threadIdx.x] = __shfl_sync(kAllLanes, 1.0f, 0);
}
__global__ void part_of_a_block(float* out) {
  if (threadIdx.x < 32) __syncthreads();
  out[threadIdx.x] = 1.0f;
}
__global__ void last_block(float* out) { out[0] = static_cast<float>(blockIdx.x); }
__global__ void nothing(float*) {}

extern "C" void run(int what, float* out, std::int64_t blocks) {
  void (*kernels[])(float*) = {right,          misaligned,      beyond,     unwritten,
                               part_of_a_warp, part_of_a_block, last_block, nothing};
  launch(kernels[what], blocks, 64, cudaStream_t{}, out);
}

void start_in_graph(int what, float* out, cudaStream_t stream) {
  launch(right, 1, 64, stream, out);
  void* memory = nullptr;
  if (what == 1) cudaMemcpyAsync(out, out + 32, 4, cudaMemcpyDeviceToHost, stream);
  if (what == 2) cudaEventSynchronize(cudaEvent_t{});
  if (what == 3) cudaHostAlloc(&memory, 4, cudaHostAllocDefault);
  if (what == 4) launch(right, 1, 64, cudaStream_t{}, out);
  if (what == 5) cudaStreamSynchronize(stream);
}

extern "C" void run_in_graph(int what, float* out) {
  const CaptureRegion region;
  start_in_graph(what, out, cudaStream_t{});
}

// What is recorded is executed when the graph is launched, with the arguments that it was recorded with.
extern "C" void record(int what, float* out) {
  cudaStream_t stream = nullptr;
  cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking);
  RecordedWork work;
  work.record(stream, [&] {
    start_in_graph(what, out, stream);
    return 0;
  });
  if (out[0] != 0) emulation::fail("executed while it was recorded");
  for (int i = 0; i < 2; ++i) {
    work.launch(cudaStream_t{});
    if (out[5] != 6) emulation::fail("not executed");
    out[5] = 0;
  }
  cudaStreamDestroy(stream);
}
"""
NAMES = ("right", "misaligned", "beyond", "unwritten", "part_of_a_warp", "part_of_a_block", "last_block", "nothing")
RUN = """
import ctypes, sys
library, out = ctypes.CDLL(sys.argv[1]), ((ctypes.c_float * 4) * 17)()
library.ggslam_emulation_order(int(sys.argv[4]))
aligned = ctypes.addressof(out) + -ctypes.addressof(out) % 16
library.run(int(sys.argv[2]), ctypes.c_void_p(aligned), ctypes.c_int64(int(sys.argv[3])))
print(*(ctypes.c_float * 64).from_address(aligned))
"""


RUN_IN_GRAPH = """
import ctypes, sys
library, out = ctypes.CDLL(sys.argv[1]), (ctypes.c_float * 64)()
getattr(library, sys.argv[3])(int(sys.argv[2]), out)
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++")
    folder = tmp_path_factory.mktemp("faults")
    (folder / "faults.cpp").write_text(SOURCE)
    places = ["-I", str(EMULATION), "-I", str(KERNELS), "-include", "cuda_on_cpu.hpp"]
    sources = [str(folder / "faults.cpp"), str(EMULATION / "fibers.cpp")]
    subprocess.run([compiler, *FLAGS, "-shared", *places, *sources, "-o", str(folder / "faults.so")], check=True)
    return folder / "faults.so"


def run(library: Path, kernel: str, blocks: int = 1, order: int = 0) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-c", RUN, str(library), str(NAMES.index(kernel)), str(blocks), str(order)]
    return subprocess.run(words, capture_output=True, text=True, check=False)


def test_a_kernel_that_is_right_runs(library: Path) -> None:
    for order in (0, 1, 2):
        assert [float(x) for x in run(library, "right", 3, order).stdout.split()] == [*range(1, 64), 0]


@pytest.mark.parametrize(
    ("kernel", "message"),
    [("misaligned", "misaligned address"), ("beyond", "out of bounds"),
     ("part_of_a_warp", "wait for one another in vain"), ("part_of_a_block", "only some threads reached|in vain")],
)  # fmt: skip
def test_faults_end_the_process(library: Path, kernel: str, message: str) -> None:
    done = run(library, kernel)
    assert done.returncode != 0 and any(part in done.stderr for part in message.split("|")), done.stderr


@pytest.mark.parametrize("how", ["run_in_graph", "record"])
@pytest.mark.parametrize(
    ("what", "message"),
    [(0, ""), (1, "a copy to the host"), (2, "a wait"), (3, "an allocation"), (5, "a wait")],
)  # fmt: skip
def test_what_no_graph_holds_ends_the_process(library: Path, how: str, what: int, message: str) -> None:
    done = run_in_graph(library, how, what)
    assert (done.returncode == 0) == (what == 0) and message in done.stderr


def test_work_beside_what_is_recorded_ends_the_process(library: Path) -> None:
    done = run_in_graph(library, "record", 4)
    assert done.returncode != 0 and "another stream than the one that records" in done.stderr


def run_in_graph(library: Path, how: str, what: int) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-c", RUN_IN_GRAPH, str(library), str(what), how]
    return subprocess.run(words, capture_output=True, text=True, check=False)


def test_a_grid_that_is_too_large_is_refused(library: Path) -> None:
    assert "more blocks than a grid can have" in run(library, "nothing", 2**31).stderr


def test_shared_memory_keeps_nothing_from_block_to_block(library: Path) -> None:
    assert set(run(library, "unwritten").stdout.split()) == {"1.0"}
    assert set(run(library, "unwritten", 2).stdout.split()) == {"nan"}


def test_blocks_run_in_other_orders_too(library: Path) -> None:
    assert [run(library, "last_block", 5, order).stdout.split()[0] for order in (0, 1, 2)] == ["4.0", "0.0", "3.0"]
