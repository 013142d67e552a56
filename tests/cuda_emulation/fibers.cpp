// SPDX-License-Identifier: Apache-2.0
#include "fibers.hpp"

#include <algorithm>
#include <atomic>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <link.h>
#include <memory>
#include <mutex>
#include <numeric>
#include <thread>
#include <ucontext.h>
#include <utility>
#include <vector>

namespace emulation {

Index threadIdx, blockIdx, blockDim, gridDim;
int current_device = 0;

namespace {

constexpr int kLanes = 32, kMaxThreads = 1024;
constexpr std::size_t kStackBytes = 64 * 1024;

// --- switching stacks: most of what an emulated kernel takes -----------------------------------------------------------

#ifdef __x86_64__
using Place = void*;  // stack pointer; on the stack lie the registers that a function has to preserve
extern "C" void ggslam_emulation_switch(Place* left, Place entered);
asm(R"(
.pushsection .text
.type ggslam_emulation_switch, @function
ggslam_emulation_switch:
  pushq %rbp
  pushq %rbx
  pushq %r12
  pushq %r13
  pushq %r14
  pushq %r15
  movq %rsp, (%rdi)
  movq %rsi, %rsp
  popq %r15
  popq %r14
  popq %r13
  popq %r12
  popq %rbx
  popq %rbp
  ret
.size ggslam_emulation_switch, .-ggslam_emulation_switch
.popsection
)");

void switch_stacks(Place& left, const Place& entered) { ggslam_emulation_switch(&left, entered); }

// A place at the beginning of `code`, which never returns.
void begin(Place& place, char* stack, std::size_t bytes, void (*code)()) {
  const auto top = (reinterpret_cast<std::uintptr_t>(stack) + bytes) / 16 * 16;
  auto* saved = reinterpret_cast<std::uintptr_t*>(top) - 8;  // six registers, where to go on, where `code` would return
  std::fill(saved, saved + 8, std::uintptr_t{0});
  saved[6] = reinterpret_cast<std::uintptr_t>(code);
  place = saved;
}
#else  // slower: every switch saves the signal mask by a system call
using Place = ucontext_t;

void switch_stacks(Place& left, const Place& entered) { swapcontext(&left, &entered); }

void begin(Place& place, char* stack, std::size_t bytes, void (*code)()) {
  getcontext(&place);
  place.uc_stack.ss_sp = stack;
  place.uc_stack.ss_size = bytes;
  makecontext(&place, code, 0);
}
#endif

struct Fiber {
  Place place;
  std::unique_ptr<char[]> stack;
  bool done = false;
  const unsigned* waits_for = nullptr;  // a count of meetings, to become another one than...
  unsigned meeting = 0;
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
Place scheduler;
bool progress;
int order = 0;

// Until that meeting is over.
void wait_for(const unsigned& meetings, unsigned meeting) {
  Fiber& mine = fibers[threadIdx.x];
  mine.waits_for = &meetings, mine.meeting = meeting;
  switch_stacks(mine.place, scheduler);
}

// Body of every fiber: one call of the kernel per block, then a pause until the next block.
void fiber_main() {
  for (;;) {
    block.code(block.argument);
    Fiber& mine = fibers[threadIdx.x];
    mine.done = true;
    progress = true;
    switch_stacks(mine.place, scheduler);
  }
}

// Goes on with a thread if what it waits for has come.
void resume(int thread) {
  Fiber& fiber = fibers[thread];
  if (fiber.waits_for != nullptr && *fiber.waits_for == fiber.meeting) return;
  fiber.waits_for = nullptr;
  threadIdx.x = static_cast<unsigned>(thread);
  if (!fiber.stack) {
    fiber.stack.reset(new char[kStackBytes]);
    begin(fiber.place, fiber.stack.get(), kStackBytes, fiber_main);
  }
  switch_stacks(scheduler, fiber.place);
}

// The thread to resume as number i of a round: 0 upwards, 1 downwards, 2 in an order of jumps.
int in_order(int i) {
  if (order == 1) return block.threads - 1 - i;
  if (order == 2) return i * 37 % block.threads;  // 37 has no factor in common with a power of two
  return i;
}

thread_local char in_shared_memory;  // tells where it is for the calling thread

// The memory of this library's thread_local variables, which are the shared memory of all kernels.
struct SharedMemory {
  std::ptrdiff_t offset = 0;  // from its beginning to the variable above
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
  *static_cast<SharedMemory*>(found) = {&in_shared_memory - static_cast<char*>(library->dlpi_tls_data), bytes};
  return 1;
}

// What was in shared memory before means nothing: as floats it is NaN.
void spoil_shared_memory() {
  static const SharedMemory shared = [] {
    in_shared_memory = 0;  // it is there from the first use on
    SharedMemory found;
    dl_iterate_phdr(find_shared_memory, &found);
    if (found.bytes == 0) fail("no shared memory found");
    return found;
  }();
  std::memset(&in_shared_memory - shared.offset, 0xff, shared.bytes);
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

namespace {
std::atomic<std::thread::id> in_graph{};
std::atomic<bool> records{}, refuses{};
}  // namespace

void begin_graph() {
  if (in_graph.exchange(std::this_thread::get_id()) != std::thread::id()) fail("a graph within a graph");
}

void end_graph() { in_graph = std::thread::id(); }

void set_recording(bool recording) { records = recording; }

bool refuses_graphs() { return refuses.load(); }

void refuse_graphs(bool refused) { refuses = refused; }

bool is_recording() { return records.load() && in_graph.load() == std::this_thread::get_id(); }

void refuse_in_graph(const char* what) {
  if (in_graph.load() == std::this_thread::get_id()) fail(what);
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
  for (int i = 0; i < threads; ++i) fibers[i].done = false, fibers[i].waits_for = nullptr;
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
  if (block.meetings == meeting) wait_for(block.meetings, meeting);
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
  if (warp.meetings == meeting) wait_for(warp.meetings, meeting);
  return warp.given[meeting % 2];
}

}  // namespace emulation

// Order in which blocks are run and the threads of a block are resumed: 0 upwards, 1 downwards, 2 jumping.
extern "C" void ggslam_emulation_order(int order) { emulation::order = order; }

// The device that calls without a device mean; returns what it was.
extern "C" int ggslam_emulation_device(int device) { return std::exchange(emulation::current_device, device); }

// From now on no graph can be recorded.
extern "C" void ggslam_emulation_refuse_graphs(int refused) { emulation::refuse_graphs(refused != 0); }
