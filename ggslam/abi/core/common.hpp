// SPDX-License-Identifier: Apache-2.0
// What all parts of the compiled core share: its version, instruction sets, threads.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/export.hpp"

namespace ggslam {

// Whose fault it is that a function of the core failed.
enum CoreFault : int {
  kNoFault = 0,
  kBadInput = 1,      // the caller's: a size, a number or a pointer that cannot be
  kMemoryRanOut = 2,
  kCoreFailed = 3,
};

}  // namespace ggslam

// A function that fails returns a null pointer, -1, the largest unsigned number or NaN, by its type; one that has
// nothing to return but that it did not fail, 0. This one returns the CoreFault of the calling thread's last failure,
// copies its message into `message` [room], and forgets it.
GGSLAM_EXPORT int ggslam_last_error(char* message, std::size_t room);

// SHA-256 of the headers in abi/core; the loader refuses a library whose headers are not its own.
GGSLAM_EXPORT const char* ggslam_abi_hash();

// Bytes of each structure in the headers in abi/core, in their order; `count` receives how many there are.
GGSLAM_EXPORT const std::size_t* ggslam_structure_sizes(int* count);

// SHA-256 of the sources, see CMakeLists.txt.
GGSLAM_EXPORT const char* ggslam_source_hash();

// Whether an instruction set (0 baseline, 1 AVX2, 2 AVX-512) is compiled in and this processor has it; the widest one.
GGSLAM_EXPORT int ggslam_isa_available(int isa);
GGSLAM_EXPORT int ggslam_best_isa();

// Threads and instruction set for the functions that take a context, which serves one caller at a time.
GGSLAM_EXPORT void* ggslam_context_create(int threads, int isa);
GGSLAM_EXPORT int ggslam_context_destroy(void* context);
