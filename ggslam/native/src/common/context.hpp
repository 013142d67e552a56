// SPDX-License-Identifier: Apache-2.0
// What every entry point of the core is handed: the threads to work on and the instruction set to use.
#pragma once
#include "common/dispatch.hpp"
#include "common/thread_pool.hpp"

namespace ggslam {

struct Context {
  ThreadPool pool;
  Isa isa;
  Context(int threads, Isa isa_) : pool(threads), isa(isa_) {}
};

}  // namespace ggslam
