// SPDX-License-Identifier: Apache-2.0
// Choice of the instruction set. Every function in kernels/ is defined once per instruction set, in the namespace
// ggslam::baseline, ggslam::avx2 or ggslam::avx512 (the macro GGSLAM_ISA names the one being compiled).
#pragma once

namespace ggslam {

enum class Isa : int { baseline = 0, avx2 = 1, avx512 = 2 };

Isa best_isa();                 // the widest one that this processor has
bool isa_available(Isa isa);    // compiled in and supported by this processor

}  // namespace ggslam

// GGSLAM_DECLARE_KERNEL(int f(float)) declares f in each namespace. GGSLAM_ONLY names the one instruction set of a build
// that has no other, as those with sanitizers.
#if defined(GGSLAM_ONLY)
#define GGSLAM_DECLARE_KERNEL(...) namespace ggslam::GGSLAM_ONLY { __VA_ARGS__; }
#define GGSLAM_DISPATCH(isa, function) (&::ggslam::GGSLAM_ONLY::function)
#elif defined(__x86_64__)
#define GGSLAM_DECLARE_KERNEL(...)       \
  namespace ggslam::baseline { __VA_ARGS__; } \
  namespace ggslam::avx2 { __VA_ARGS__; }     \
  namespace ggslam::avx512 { __VA_ARGS__; }
#define GGSLAM_DISPATCH(isa, function)                                   \
  ((isa) == ::ggslam::Isa::avx512 ? &::ggslam::avx512::function          \
   : (isa) == ::ggslam::Isa::avx2 ? &::ggslam::avx2::function            \
                                  : &::ggslam::baseline::function)
#else
#define GGSLAM_DECLARE_KERNEL(...) namespace ggslam::baseline { __VA_ARGS__; }
#define GGSLAM_DISPATCH(isa, function) (&::ggslam::baseline::function)
#endif
