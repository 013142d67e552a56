// SPDX-License-Identifier: Apache-2.0
// Threads of one block as fibers of one CPU thread, with barriers and warp collectives. See cuda_on_cpu.hpp.
#pragma once
#include <cstdint>

namespace emulation {

struct Index {
  unsigned x = 0;
};
extern Index threadIdx, blockIdx, blockDim, gridDim;
extern int current_device;

enum Operation { kShuffle, kShuffleXor, kBallot, kReduceAdd, kReduceMax, kSync };

[[noreturn]] void fail(const char* what);

// Between these the calling thread starts what could be recorded as a graph. One thread at a time; they do not nest.
void begin_graph();
void end_graph();

// Whether what the calling thread starts in between is noted instead of run.
void set_recording(bool recording);
bool is_recording();

// Whether the runtime refuses to record, as tests may ask for.
bool refuses_graphs();

// Fails if the calling thread is between them: a graph holds nothing of this kind.
void refuse_in_graph(const char* what);

// Runs blocks of `threads` threads one after another, each thread calling code(argument).
void run_grid(std::int64_t blocks, int threads, void (*code)(const void*), const void* argument);

// Waits for all threads of the block; returns the sum of what they brought.
int meet_block(int value);

// Waits for all lanes of the warp; returns what each of them gave, until the lane's next meeting but one.
const std::uint64_t* meet_warp(Operation operation, std::uint64_t value);

}  // namespace emulation
