// SPDX-License-Identifier: Apache-2.0
// The part of the CUDA language and runtime that ggslam's kernels use, on a CPU, so that their logic can be tested where
// there is no GPU. Included ahead of the kernels' sources (g++ -include), with GGSLAM_CUDA_EMULATION defined.
//
// Blocks run one after another. Each thread of a block is a fiber with a stack of its own, which runs until it reaches a
// barrier or a warp collective and is resumed once all threads concerned have arrived: results that depend on a missing
// barrier come out wrong here, too, above all as the order in which blocks run and threads are resumed can be changed
// (ggslam_emulation_order) and shared memory is NaN when a block begins. Collectives insist on whole warps, barriers on
// whole blocks; a thread that never arrives ends the process with a message.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <type_traits>

#include "fibers.hpp"
#include "graphs.hpp"

#define __global__
#define __device__
#define __host__
#define __align__(bytes) alignas(bytes)
#define __launch_bounds__(...)
// Blocks run one after another, so one copy serves all. Nothing else here is thread_local: what is, is overwritten with
// NaN before each block.
#define GGSLAM_SHARED static thread_local

// --- types ------------------------------------------------------------------------------------------------------------

struct alignas(16) float4 {
  float x, y, z, w;
};
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }

using emulation::blockDim;
using emulation::blockIdx;
using emulation::gridDim;
using emulation::threadIdx;
using std::max;
using std::min;

// --- barriers, collectives, atomics -----------------------------------------------------------------------------------

inline void __syncthreads() { emulation::meet_block(0); }
inline int __syncthreads_count(int predicate) { return emulation::meet_block(predicate != 0); }

inline void __syncwarp() { emulation::meet_warp(emulation::kSync, 0); }

inline void require_whole_warp(unsigned mask) {
  if (mask != 0xffffffffu) emulation::fail("a collective of part of a warp");
}

// The value that lane `from` gave.
template <class T>
T exchange(emulation::Operation operation, unsigned mask, T value, int from) {
  static_assert(sizeof(T) <= 8, "at most eight bytes are exchanged");
  require_whole_warp(mask);
  std::uint64_t bits = 0;
  std::memcpy(&bits, &value, sizeof(T));
  const std::uint64_t* given = emulation::meet_warp(operation, bits);
  std::memcpy(&value, &given[from & 31], sizeof(T));
  return value;
}

template <class T>
T __shfl_sync(unsigned mask, T value, int lane) {
  return exchange(emulation::kShuffle, mask, value, lane);
}
template <class T>
T __shfl_xor_sync(unsigned mask, T value, int bits) {
  return exchange(emulation::kShuffleXor, mask, value, static_cast<int>(threadIdx.x % 32) ^ bits);
}
inline unsigned __ballot_sync(unsigned mask, int predicate) {
  require_whole_warp(mask);
  const std::uint64_t* given = emulation::meet_warp(emulation::kBallot, predicate != 0);
  unsigned result = 0;
  for (int lane = 0; lane < 32; ++lane) result |= static_cast<unsigned>(given[lane]) << lane;
  return result;
}
inline unsigned __reduce_add_sync(unsigned mask, unsigned value) {
  require_whole_warp(mask);
  const std::uint64_t* given = emulation::meet_warp(emulation::kReduceAdd, value);
  unsigned result = 0;
  for (int lane = 0; lane < 32; ++lane) result += static_cast<unsigned>(given[lane]);
  return result;
}
inline int __reduce_max_sync(unsigned mask, int value) {
  require_whole_warp(mask);
  const std::uint64_t* given = emulation::meet_warp(emulation::kReduceMax, static_cast<std::uint32_t>(value));
  int result = static_cast<int>(given[0]);
  for (int lane = 1; lane < 32; ++lane) result = std::max(result, static_cast<int>(given[lane]));
  return result;
}

template <class T>
T atomicAdd(T* place, T value) {
  const T before = *place;
  *place = before + value;
  return before;
}

// Compares and exchanges; returns what was there.
template <class T>
T atomicCAS(T* place, T expected, T value) {
  const T before = *place;
  if (before == expected) *place = value;
  return before;
}

template <class T>
T atomicOr(T* place, T value) {
  const T before = *place;
  *place = before | value;
  return before;
}

inline void __threadfence() {}  // blocks run one after another
template <class T>
T __ldcg(const T* place) {
  return *place;
}

// --- arithmetic -------------------------------------------------------------------------------------------------------

inline int __popc(unsigned x) { return __builtin_popcount(x); }
inline int __popcll(unsigned long long x) { return __builtin_popcountll(x); }
inline int __ffs(int x) { return __builtin_ffs(x); }
inline int __clz(int x) { return x == 0 ? 32 : __builtin_clz(static_cast<unsigned>(x)); }
inline double rsqrt(double x) { return 1 / std::sqrt(x); }
inline float rsqrtf(float x) { return 1 / std::sqrt(x); }
inline double sinpi(double x) { return std::sin(3.14159265358979323846 * x); }
inline double cospi(double x) { return std::cos(3.14159265358979323846 * x); }
inline float __fdividef(float a, float b) { return a / b; }
// What is rounded by itself, however the compiler would join it with what follows.
inline float rounded(float x) {
  volatile float kept = x;
  return kept;
}
inline float __fmul_rn(float a, float b) { return rounded(a * b); }
inline float __fadd_rn(float a, float b) { return rounded(a + b); }
inline float __fmaf_rn(float a, float b, float c) { return std::fma(a, b, c); }
// To whole numbers, as a GPU rounds: what is too large becomes the largest, NaN 0.
inline int saturated(double x) {
  return std::isnan(x) ? 0 : static_cast<int>(std::min(std::max(x, -2147483648.0), 2147483647.0));
}
inline int __float2int_rz(float x) { return saturated(std::trunc(static_cast<double>(x))); }
inline int __float2int_rd(float x) { return saturated(std::floor(static_cast<double>(x))); }
inline std::uint32_t __float_as_uint(float x) {
  std::uint32_t bits;
  std::memcpy(&bits, &x, sizeof(bits));
  return bits;
}
inline float __uint_as_float(std::uint32_t bits) {
  float x;
  std::memcpy(&x, &bits, sizeof(x));
  return x;
}

// --- runtime: everything is done when the call returns ------------------------------------------------------------------

using cudaStream_t = EmulatedStream*;
using cudaEvent_t = struct EmulatedEvent*;
using cudaGraph_t = EmulatedGraph*;
using cudaGraphExec_t = EmulatedGraph*;
enum cudaError_t { cudaSuccess = 0, cudaErrorStreamCaptureUnsupported = 900, cudaErrorGraphExecUpdateFailure = 910 };
enum cudaMemcpyKind { cudaMemcpyDeviceToHost };
enum cudaStreamCaptureMode { cudaStreamCaptureModeThreadLocal };
struct cudaGraphExecUpdateResultInfo {};
constexpr unsigned cudaHostAllocDefault = 0, cudaEventDisableTiming = 0, cudaStreamNonBlocking = 1;
#define CUDART_VERSION 13000

inline const char* cudaGetErrorString(cudaError_t error) {
  return error == cudaSuccess ? "no error" : "a graph cannot be recorded or changed";
}
inline cudaError_t cudaGetLastError() { return cudaSuccess; }
inline cudaError_t cudaGetDevice(int* device) {
  *device = emulation::current_device;
  return cudaSuccess;
}
inline cudaError_t cudaSetDevice(int device) {
  emulation::current_device = device;
  return cudaSuccess;
}
inline cudaError_t cudaMemsetAsync(void* place, int value, std::size_t bytes, cudaStream_t stream) {
  emulation::run_or_record(stream, reinterpret_cast<const void*>(&cudaMemsetAsync),
                           [=] { std::memset(place, value, bytes); });
  return cudaSuccess;
}
inline cudaError_t cudaMemcpyAsync(void* to, const void* from, std::size_t bytes, cudaMemcpyKind, cudaStream_t) {
  emulation::refuse_in_graph("a copy to the host");
  std::memcpy(to, from, bytes);
  return cudaSuccess;
}
inline cudaError_t cudaHostAlloc(void** place, std::size_t bytes, unsigned) {
  emulation::refuse_in_graph("an allocation");
  *place = std::malloc(bytes);
  return cudaSuccess;
}
inline cudaError_t cudaFreeHost(void* place) {
  std::free(place);
  return cudaSuccess;
}
inline cudaError_t cudaEventCreateWithFlags(cudaEvent_t* event, unsigned) {
  *event = nullptr;
  return cudaSuccess;
}
inline cudaError_t cudaEventRecord(cudaEvent_t, cudaStream_t) {
  emulation::refuse_in_graph("an event for the host");
  return cudaSuccess;
}
inline cudaError_t cudaEventSynchronize(cudaEvent_t) {
  emulation::refuse_in_graph("a wait");
  return cudaSuccess;
}
inline cudaError_t cudaEventDestroy(cudaEvent_t) { return cudaSuccess; }
inline cudaError_t cudaStreamSynchronize(cudaStream_t) {
  emulation::refuse_in_graph("a wait");
  return cudaSuccess;
}

// --- graphs: what is recorded is executed when the graph is launched, with the arguments that it was recorded with ------

inline cudaError_t cudaStreamCreateWithFlags(cudaStream_t* stream, unsigned) {
  emulation::refuse_in_graph("a new stream");
  *stream = new EmulatedStream;
  return cudaSuccess;
}
inline cudaError_t cudaStreamDestroy(cudaStream_t stream) {
  delete stream;
  return cudaSuccess;
}
inline cudaError_t cudaStreamBeginCapture(cudaStream_t stream, cudaStreamCaptureMode) {
  if (stream == nullptr) emulation::fail("the stream that torch uses cannot record");
  if (emulation::refuses_graphs()) return cudaErrorStreamCaptureUnsupported;
  emulation::begin_graph();
  emulation::set_recording(true);
  stream->recording = new EmulatedGraph;
  return cudaSuccess;
}
inline cudaError_t cudaStreamEndCapture(cudaStream_t stream, cudaGraph_t* graph) {
  *graph = stream->recording;
  stream->recording = nullptr;
  emulation::set_recording(false);
  emulation::end_graph();
  return cudaSuccess;
}
inline cudaError_t cudaGraphInstantiateWithFlags(cudaGraphExec_t* made, cudaGraph_t graph, unsigned long long) {
  *made = new EmulatedGraph(*graph);
  return cudaSuccess;
}
// Graphs of the same kernels in the same order can be changed to one another.
inline cudaError_t cudaGraphExecUpdate(cudaGraphExec_t made, cudaGraph_t graph, cudaGraphExecUpdateResultInfo*) {
  const auto same = [](const EmulatedNode& a, const EmulatedNode& b) { return a.what == b.what; };
  if (!std::equal(made->nodes.begin(), made->nodes.end(), graph->nodes.begin(), graph->nodes.end(), same))
    return cudaErrorGraphExecUpdateFailure;
  *made = *graph;
  return cudaSuccess;
}
inline cudaError_t cudaGraphLaunch(cudaGraphExec_t made, cudaStream_t stream) {
  if (stream != nullptr) emulation::fail("a graph on a stream that only records");
  emulation::refuse_in_graph("a graph");
  for (const EmulatedNode& node : made->nodes) node.run();
  return cudaSuccess;
}
inline cudaError_t cudaGraphDestroy(cudaGraph_t graph) {
  delete graph;
  return cudaSuccess;
}
inline cudaError_t cudaGraphExecDestroy(cudaGraphExec_t made) {
  delete made;
  return cudaSuccess;
}

namespace ggslam::cuda {

// What could be recorded as a graph, see common/platform.cuh.
struct CaptureRegion {
  CaptureRegion() { emulation::begin_graph(); }
  ~CaptureRegion() { emulation::end_graph(); }
};

template <class Kernel, class... Arguments>
void launch(Kernel kernel, std::int64_t blocks, int threads, cudaStream_t stream, const Arguments&... arguments) {
  if (blocks <= 0) return;
  emulation::run_or_record(stream, reinterpret_cast<const void*>(kernel), [=] {
    const auto thread = [&] { kernel(arguments...); };
    using Thread = decltype(thread);
    emulation::run_grid(blocks, threads, [](const void* code) { (*static_cast<const Thread*>(code))(); }, &thread);
  });
}

}  // namespace ggslam::cuda
