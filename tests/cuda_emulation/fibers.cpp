// SPDX-License-Identifier: Apache-2.0
// Fibers start by ucontext, whose switches save the signal mask by a system call; all later switches are by _setjmp and
// _longjmp, which do not.
#include "fibers.hpp"

#include <csetjmp>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <ucontext.h>
#include <vector>

namespace emulation {

Index threadIdx, blockIdx, blockDim, gridDim;

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

}  // namespace

void fail(const char* what) {
  std::fprintf(stderr, "CUDA emulation: block %u, thread %u: %s\n", blockIdx.x, threadIdx.x, what);
  std::abort();
}

void run_block(unsigned number, unsigned blocks, int threads, void (*code)(const void*), const void* argument) {
  if (threads > kMaxThreads || threads % kLanes != 0) fail("a block of an impossible size");
  blockIdx.x = number, gridDim.x = blocks, blockDim.x = static_cast<unsigned>(threads);
  block = Block{};
  block.threads = threads, block.code = code, block.argument = argument;
  for (int i = 0; i < threads; ++i) fibers[i].done = false;
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

// Order in which the threads of a block are resumed: 0 upwards, 1 downwards, 2 jumping.
extern "C" void ggslam_emulation_order(int order) { emulation::order = order; }
