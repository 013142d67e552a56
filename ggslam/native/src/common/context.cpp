// SPDX-License-Identifier: Apache-2.0
#include "common/context.hpp"

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

// Version of the C interface: the loader refuses a library whose number differs from its own.
GGSLAM_EXPORT int ggslam_abi_version() { return 1; }

// SHA-256 of the sources, see CMakeLists.txt.
GGSLAM_EXPORT const char* ggslam_source_hash() { return GGSLAM_SOURCE_HASH; }

GGSLAM_EXPORT int ggslam_isa_available(int isa) {
  return isa >= 0 && isa <= 2 && ggslam::isa_available(static_cast<ggslam::Isa>(isa)) ? 1 : 0;
}

GGSLAM_EXPORT int ggslam_best_isa() { return static_cast<int>(ggslam::best_isa()); }

GGSLAM_EXPORT void* ggslam_context_create(int threads, int isa) {
  return new ggslam::Context(threads, static_cast<ggslam::Isa>(isa));
}

GGSLAM_EXPORT void ggslam_context_destroy(void* context) { delete static_cast<ggslam::Context*>(context); }
