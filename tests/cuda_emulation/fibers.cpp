// SPDX-License-Identifier: Apache-2.0
// Fibers start by ucontext, whose switches save the signal mask by a system call; all later switches are by _setjmp and
// _longjmp, which do not.
#include "fibers.hpp"

#include <csetjmp>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <link.h>
#include <memory>
#include <mutex>
#include <numeric>
#include <ucontext.h>
#include <utility>
#include <vector>

namespace emulation {

Index threadIdx, blockIdx, blockDim, gridDim;
int current_device = 0;

namespace {

constexpr int kLanes = 32, kMaxThreads = 1024;
constexpr std::size_t kStackBytes = 64 * 1024;

struct Fiber {
  ucontext_t start;
  jmp_buf place;
  std::unique_ptr<char[]> stack;
  bool started = false, done = false;
};

struct Warp {
  std::uint64_t given[2][kLanes];  // a lane can be one meeting ahead of the others, not two
  Operation operation;
  int arrived = 0;
  unsigned meetings = 0;
};

struct Block {
  int threads = 0, arrived = 0, sum = 0, result[2] = {0, 0};
  unsigned meetings = 0;
  void (*code)(const void*) = nullptr;
  const void* argument = nullptr;
};

Fiber fibers[kMaxThreads];
Warp warps[kMaxThreads / kLanes];
Block block;
jmp_buf scheduler;
ucontext_t scheduler_context;
bool progress;
int order = 0;

void pause_fiber() {
  Fiber& mine = fibers[threadIdx.x];
  if (_setjmp(mine.place) == 0) _longjmp(scheduler, 1);
}

// Body of every fiber: one call of the kernel per block, then a pause until the next block.
void fiber_main() {
  for (;;) {
    block.code(block.argument);
    fibers[threadIdx.x].done = true;
    progress = true;
    pause_fiber();
  }
}

void resume(int thread) {
  Fiber& fiber = fibers[thread];
  threadIdx.x = static_cast<unsigned>(thread);
  if (_setjmp(scheduler) != 0) return;
  if (fiber.started) _longjmp(fiber.place, 1);
  fiber.started = true;
  fiber.stack.reset(new char[kStackBytes]);
  getcontext(&fiber.start);
  fiber.start.uc_stack.ss_sp = fiber.stack.get();
  fiber.start.uc_stack.ss_size = kStackBytes;
  fiber.start.uc_link = &scheduler_context;
  makecontext(&fiber.start, fiber_main, 0);
  setcontext(&fiber.start);
}

// The thread to resume as number i of a round: 0 upwards, 1 downwards, 2 in an order of jumps.
int in_order(int i) {
  if (order == 1) return block.threads - 1 - i;
  if (order == 2) return i * 37 % block.threads;  // 37 has no factor in common with a power of two
  return i;
}

// The memory of this library's thread_local variables, which are the shared memory of all kernels.
struct SharedMemory {
  void* place = nullptr;
  std::size_t bytes = 0;
};

int find_shared_memory(dl_phdr_info* library, std::size_t, void* found) {
  const auto here = reinterpret_cast<ElfW(Addr)>(&find_shared_memory);
  bool mine = false;
  std::size_t bytes = 0;
  for (int i = 0; i < library->dlpi_phnum; ++i) {
    const ElfW(Phdr)& part = library->dlpi_phdr[i];
    const ElfW(Addr) start = library->dlpi_addr + part.p_vaddr;
    if (part.p_type == PT_LOAD && here >= start && here < start + part.p_memsz) mine = true;
    if (part.p_type == PT_TLS) bytes = part.p_memsz;
  }
  if (!mine) return 0;
  *static_cast<SharedMemory*>(found) = {library->dlpi_tls_data, bytes};
  return 1;
}

// What was in shared memory before means nothing: as floats it is NaN.
void spoil_shared_memory() {
  SharedMemory shared;
  dl_iterate_phdr(find_shared_memory, &shared);
  if (shared.place != nullptr) std::memset(shared.place, 0xff, shared.bytes);
}

// The block to run as number i: upwards, downwards or in an order of jumps.
std::int64_t block_in_order(std::int64_t i, std::int64_t blocks) {
  if (order == 1) return blocks - 1 - i;
  if (order != 2) return i;
  std::int64_t jump = 37;
  while (std::gcd(jump, blocks) != 1) jump += 2;
  return i * jump % blocks;
}

void run_block(unsigned number, unsigned blocks, int threads, void (*code)(const void*), const void* argument);

}  // namespace

void fail(const char* what) {
  std::fprintf(stderr, "CUDA emulation: block %u, thread %u: %s\n", blockIdx.x, threadIdx.x, what);
  std::abort();
}

void run_grid(std::int64_t blocks, int threads, void (*code)(const void*), const void* argument) {
  static std::mutex one_at_a_time;  // callers may be on several threads; there is one set of fibers
  const std::lock_guard<std::mutex> alone(one_at_a_time);
  if (blocks > 0x7fffffff) fail("more blocks than a grid can have");
  for (std::int64_t i = 0; i < blocks; ++i)
    run_block(static_cast<unsigned>(block_in_order(i, blocks)), static_cast<unsigned>(blocks), threads, code, argument);
}

namespace {

void run_block(unsigned number, unsigned blocks, int threads, void (*code)(const void*), const void* argument) {
  if (threads > kMaxThreads || threads % kLanes != 0) fail("a block of an impossible size");
  blockIdx.x = number, gridDim.x = blocks, blockDim.x = static_cast<unsigned>(threads);
  block = Block{};
  block.threads = threads, block.code = code, block.argument = argument;
  for (int i = 0; i < threads; ++i) fibers[i].done = false;
  spoil_shared_memory();
  for (Warp& warp : warps) warp.arrived = 0;
  for (int running = threads; running > 0;) {
    progress = false;
    running = 0;
    for (int i = 0; i < threads; ++i) {
      const int thread = in_order(i);
      if (!fibers[thread].done) resume(thread);
      running += !fibers[thread].done;
    }
    if (!progress) fail("threads wait for one another in vain");
  }
  if (block.arrived != 0) fail("a barrier that only some threads reached");
}

}  // namespace

int meet_block(int value) {
  const unsigned meeting = block.meetings;
  block.sum += value;
  if (++block.arrived == block.threads) {
    block.result[meeting % 2] = block.sum;
    block.sum = block.arrived = 0;
    ++block.meetings;
    progress = true;
  }
  while (block.meetings == meeting) pause_fiber();
  return block.result[meeting % 2];
}

const std::uint64_t* meet_warp(Operation operation, std::uint64_t value) {
  Warp& warp = warps[threadIdx.x / kLanes];
  const unsigned meeting = warp.meetings;
  if (warp.arrived == 0) warp.operation = operation;
  if (warp.operation != operation) fail("lanes of a warp at different collectives");
  warp.given[meeting % 2][threadIdx.x % kLanes] = value;
  if (++warp.arrived == kLanes) {
    warp.arrived = 0;
    ++warp.meetings;
    progress = true;
  }
  while (warp.meetings == meeting) pause_fiber();
  return warp.given[meeting % 2];
}

}  // namespace emulation

// Order in which blocks are run and the threads of a block are resumed: 0 upwards, 1 downwards, 2 jumping.
extern "C" void ggslam_emulation_order(int order) { emulation::order = order; }

// The device that calls without a device mean; returns what it was.
extern "C" int ggslam_emulation_device(int device) { return std::exchange(emulation::current_device, device); }
