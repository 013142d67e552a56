// SPDX-License-Identifier: Apache-2.0
// Streams that record, and what they recorded. See cuda_on_cpu.hpp.
#pragma once
#include <functional>
#include <vector>

#include "fibers.hpp"

// A kernel or another piece of work.
struct EmulatedNode {
  const void* what;  // the same for nodes that differ in nothing but their arguments
  std::function<void()> run;
};

struct EmulatedGraph {
  std::vector<EmulatedNode> nodes;
};

// Nothing is executed on a stream that was made: here they are for recording alone.
struct EmulatedStream {
  EmulatedGraph* recording = nullptr;
};

namespace emulation {

// Runs work on a stream, or notes it there if that records.
template <class Work>
void run_or_record(EmulatedStream* stream, const void* what, const Work& work) {
  if (stream == nullptr) {
    if (is_recording()) fail("work on another stream than the one that records");
    work();
  } else {
    if (stream->recording == nullptr) fail("work on a stream that only records");
    stream->recording->nodes.push_back({what, work});
  }
}

}  // namespace emulation
