// SPDX-License-Identifier: Apache-2.0
// What all parts of the compiled core share: its version, instruction sets, threads.
#pragma once
#include <cstddef>
#include <cstdint>

#include "interface/export.hpp"

// SHA-256 of the headers in interface/core; the loader refuses a library whose headers are not its own.
GGSLAM_EXPORT const char* ggslam_interface_hash();

// SHA-256 of the sources, see CMakeLists.txt.
GGSLAM_EXPORT const char* ggslam_source_hash();

// Whether an instruction set (0 baseline, 1 AVX2, 2 AVX-512) is compiled in and this processor has it; the widest one.
GGSLAM_EXPORT int ggslam_isa_available(int isa);
GGSLAM_EXPORT int ggslam_best_isa();

// Threads and instruction set for the functions that take a context, which serves one caller at a time.
GGSLAM_EXPORT void* ggslam_context_create(int threads, int isa);
GGSLAM_EXPORT void ggslam_context_destroy(void* context);
