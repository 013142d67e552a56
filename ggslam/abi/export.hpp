// SPDX-License-Identifier: Apache-2.0
// Functions that callers of the compiled libraries see.
#pragma once

#define GGSLAM_EXPORT extern "C" __attribute__((visibility("default")))

#define GGSLAM_TEXT(macro) GGSLAM_TEXT_OF(macro)
#define GGSLAM_TEXT_OF(words) #words

namespace ggslam {

// Bytes of each of several structures.
template <class... Structures>
struct SizesOf {
  static constexpr int count = sizeof...(Structures);
  static constexpr decltype(sizeof(0)) bytes[] = {sizeof(Structures)...};
};

}  // namespace ggslam
