// SPDX-License-Identifier: Apache-2.0
#include "common/guard.hpp"

#include <cstdarg>
#include <cstdio>
#include <cstring>
#include <new>

namespace ggslam {
namespace {

constexpr std::size_t kRoom = 512;

struct LastError {
  CoreFault fault;
  char message[kRoom];
};
thread_local LastError last_error{kNoFault, {}};

void note(CoreFault fault, const char* message) noexcept {
  last_error.fault = fault;
  std::snprintf(last_error.message, kRoom, "%s", message);
}

}  // namespace

Failure note_failure() noexcept {
  try {
    throw;
  } catch (const InputError& error) {
    note(kBadInput, error.what());
  } catch (const std::bad_alloc&) {
    note(kMemoryRanOut, "memory ran out");
  } catch (const std::length_error&) {  // of a vector longer than any memory
    note(kMemoryRanOut, "memory ran out");
  } catch (const std::exception& error) {
    note(kCoreFailed, error.what());
  } catch (...) {
    note(kCoreFailed, "an exception of unknown type");
  }
  return {};
}

void refuse(const char* format, ...) {
  char text[kRoom];
  va_list arguments;
  va_start(arguments, format);
  std::vsnprintf(text, kRoom, format, arguments);
  va_end(arguments);
  throw InputError(text);
}

}  // namespace ggslam

GGSLAM_EXPORT int ggslam_last_error(char* message, std::size_t room) {
  using namespace ggslam;
  if (message != nullptr && room > 0) std::snprintf(message, room, "%s", last_error.message);
  const int fault = last_error.fault;
  last_error = {kNoFault, {}};
  return fault;
}
