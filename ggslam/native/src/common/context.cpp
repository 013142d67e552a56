// SPDX-License-Identifier: Apache-2.0
#include "common/context.hpp"
#include "common/guard.hpp"
#include "abi/core/codec.hpp"
#include "abi/core/common.hpp"
#include "abi/core/mapping.hpp"
#include "abi/core/objects.hpp"
#include "abi/core/planning.hpp"
#include "abi/core/rendering.hpp"
#include "abi/core/sight.hpp"
#include "abi/core/tracking.hpp"
#include "abi/core/volumes.hpp"

namespace ggslam {

bool isa_available(Isa isa) {
#if defined(GGSLAM_ONLY)
  return isa == Isa::GGSLAM_ONLY;
#elif defined(__x86_64__)
  __builtin_cpu_init();
  switch (isa) {
    case Isa::baseline: return true;
    case Isa::avx2:
      return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
    case Isa::avx512:
      return isa_available(Isa::avx2) && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
             __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq");
  }
  return false;
#else
  return isa == Isa::baseline;
#endif
}

Isa best_isa() {
  if (isa_available(Isa::avx512)) return Isa::avx512;
  if (isa_available(Isa::avx2)) return Isa::avx2;
  return Isa::baseline;
}

}  // namespace ggslam

GGSLAM_EXPORT const char* ggslam_abi_hash() { return GGSLAM_TEXT(GGSLAM_ABI_HASH); }

GGSLAM_EXPORT const std::size_t* ggslam_structure_sizes(int* count) {
  using Sizes = ggslam::SizesOf<GGSLAM_STRUCTURES>;
  *count = Sizes::count;
  return Sizes::bytes;
}

GGSLAM_EXPORT const char* ggslam_source_hash() { return GGSLAM_TEXT(GGSLAM_SOURCE_HASH); }

GGSLAM_EXPORT int ggslam_isa_available(int isa) try {
  return isa >= 0 && isa <= 2 && ggslam::isa_available(static_cast<ggslam::Isa>(isa)) ? 1 : 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_best_isa() try {
  return static_cast<int>(ggslam::best_isa());
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT void* ggslam_context_create(int threads, int isa) try {
  ggslam::check_range("threads", threads, 1, 4096);
  if (!ggslam_isa_available(isa)) ggslam::refuse("instruction set %d is not available here", isa);
  return new ggslam::Context(threads, static_cast<ggslam::Isa>(isa));
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_context_destroy(void* context) try {
  delete static_cast<ggslam::Context*>(context);
  return 0;
} GGSLAM_CATCH_ALL
