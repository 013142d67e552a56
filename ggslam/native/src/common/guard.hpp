// SPDX-License-Identifier: Apache-2.0
// The boundary of the core. No exception leaves a function with a C interface: each is written
//
//   GGSLAM_EXPORT int ggslam_do(void* map, const float* points, std::int64_t count) try {
//     ...
//     return 0;
//   } GGSLAM_CATCH_ALL
//
// and returns, where something was thrown, a null pointer, -1, the largest unsigned number or NaN. What happened is told
// by ggslam_last_error in the same thread. Threads hand exceptions on to their caller (thread_pool.hpp).
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <stdexcept>
#include <type_traits>

#include "abi/core/common.hpp"

#define GGSLAM_CATCH_ALL \
  catch (...) { return ::ggslam::note_failure(); }

namespace ggslam {

// The caller's fault; its message says what was expected and what was found.
class InputError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

// What a function returns that failed, whatever its type.
struct Failure {
  template <class T>
  operator T() const noexcept {
    if constexpr (std::is_pointer_v<T>) return nullptr;
    else if constexpr (std::is_floating_point_v<T>) return std::numeric_limits<T>::quiet_NaN();
    else return static_cast<T>(-1);
  }
};

// Notes the exception that is being handled for ggslam_last_error.
Failure note_failure() noexcept;

// Throws an InputError; the text is that of printf.
[[noreturn]] void refuse(const char* format, ...) __attribute__((format(printf, 1, 2)));

// What an argument points to.
template <class T>
T& object_of(void* pointer) {
  if (pointer == nullptr) refuse("expected an object, found a null pointer");
  return *static_cast<T*>(pointer);
}

template <class T>
const T& object_of(const void* pointer) {
  if (pointer == nullptr) refuse("expected an object, found a null pointer");
  return *static_cast<const T*>(pointer);
}

// Elements in all of an array; sizes that cannot be are refused: more than fits memory, and negative ones.
inline std::size_t elements(std::int64_t count, std::int64_t each = 1, std::int64_t more = 1) {
  std::int64_t total;
  if (count < 0 || each < 0 || more < 0 || __builtin_mul_overflow(count, each, &total) ||
      __builtin_mul_overflow(total, more, &total) || total > (std::int64_t{1} << 46))
    refuse("expected the size of an array, found %lld x %lld x %lld", static_cast<long long>(count),
           static_cast<long long>(each), static_cast<long long>(more));
  return static_cast<std::size_t>(total);
}

// An array that is not empty must be somewhere.
inline void check_array(const char* name, const void* pointer, std::int64_t count) {
  if (count < 0) refuse("%s: expected a number of elements, found %lld", name, static_cast<long long>(count));
  if (count > 0 && pointer == nullptr)
    refuse("%s: expected %lld elements, found a null pointer", name, static_cast<long long>(count));
}

template <class T>
void check_range(const char* name, T value, T low, T high) {
  if (!(value >= low && value <= high))
    refuse("%s: expected %g to %g, found %g", name, static_cast<double>(low), static_cast<double>(high),
           static_cast<double>(value));
}

// `count` numbers within +- limit, hence finite.
template <class T>
void check_within(const char* name, const T* values, int count, double limit) {
  check_array(name, values, count);
  for (int i = 0; i < count; ++i)
    if (!(std::fabs(static_cast<double>(values[i])) <= limit))
      refuse("%s: expected numbers within +-%g, found %g", name, limit, static_cast<double>(values[i]));
}

// A rotation, row by row, as far as rounding goes.
template <class T>
void check_rotation(const T* rows, int stride = 3) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      double dot = 0;
      for (int k = 0; k < 3; ++k)
        dot += static_cast<double>(rows[stride * i + k]) * static_cast<double>(rows[stride * j + k]);
      if (!(std::fabs(dot - (i == j)) <= 0.1)) refuse("pose: expected a rotation, found rows whose product is %g", dot);
    }
}

// Limits of cameras, pixels.
constexpr int kMostPixelsAlong = 1 << 15;
constexpr double kLeastFocalLength = 0.02;  // of the image's size: it would see to 87 degrees from the axis
constexpr double kMostFocalLength = 1e7;

// A camera's numbers, pixels. Shorter focal lengths are those of cameras in units of the image's width; a principal
// point may lie outside of the image, as that of a crop does, but not farther away than several images.
inline void check_camera(int width, int height, double fx, double fy, double cx, double cy) {
  check_range("camera width", width, 1, kMostPixelsAlong);
  check_range("camera height", height, 1, kMostPixelsAlong);
  check_range("camera fx", fx, kLeastFocalLength * width, kMostFocalLength);
  check_range("camera fy", fy, kLeastFocalLength * height, kMostFocalLength);
  const double most = 16.0 * kMostPixelsAlong;
  check_range("camera cx", cx, -most, most);
  check_range("camera cy", cy, -most, most);
}

}  // namespace ggslam
