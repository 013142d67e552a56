// SPDX-License-Identifier: Apache-2.0
// Functions that callers of the compiled libraries see.
#pragma once

#define GGSLAM_EXPORT extern "C" __attribute__((visibility("default")))
