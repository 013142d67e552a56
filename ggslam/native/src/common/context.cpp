// SPDX-License-Identifier: Apache-2.0
#include "common/context.hpp"
#include "interface/core/common.hpp"

#define GGSLAM_TEXT(macro) GGSLAM_TEXT_OF(macro)
#define GGSLAM_TEXT_OF(words) #words

namespace ggslam {

bool isa_available(Isa isa) {
#if defined(__x86_64__)
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

GGSLAM_EXPORT const char* ggslam_interface_hash() { return GGSLAM_TEXT(GGSLAM_INTERFACE_HASH); }

GGSLAM_EXPORT const char* ggslam_source_hash() { return GGSLAM_TEXT(GGSLAM_SOURCE_HASH); }

GGSLAM_EXPORT int ggslam_isa_available(int isa) {
  return isa >= 0 && isa <= 2 && ggslam::isa_available(static_cast<ggslam::Isa>(isa)) ? 1 : 0;
}

GGSLAM_EXPORT int ggslam_best_isa() { return static_cast<int>(ggslam::best_isa()); }

GGSLAM_EXPORT void* ggslam_context_create(int threads, int isa) {
  return new ggslam::Context(threads, static_cast<ggslam::Isa>(isa));
}

GGSLAM_EXPORT void ggslam_context_destroy(void* context) { delete static_cast<ggslam::Context*>(context); }
