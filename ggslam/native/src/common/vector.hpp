// SPDX-License-Identifier: Apache-2.0
// Vectors and matrices of three, for the code around the kernels. Sums are added up from the left, as they are written,
// so that results do not depend on the form in which a formula is stated.
#pragma once
#include <algorithm>
#include <cmath>

namespace ggslam {

template <class T>
struct Vec3 {
  T v[3];

  constexpr T& operator[](int i) { return v[i]; }
  constexpr const T& operator[](int i) const { return v[i]; }
  static constexpr Vec3 all(T x) { return {{x, x, x}}; }
  static constexpr Vec3 from(const T* p) { return {{p[0], p[1], p[2]}}; }
  constexpr void to(T* p) const { p[0] = v[0], p[1] = v[1], p[2] = v[2]; }

  friend constexpr Vec3 operator+(const Vec3& a, const Vec3& b) { return {{a[0] + b[0], a[1] + b[1], a[2] + b[2]}}; }
  friend constexpr Vec3 operator-(const Vec3& a, const Vec3& b) { return {{a[0] - b[0], a[1] - b[1], a[2] - b[2]}}; }
  friend constexpr Vec3 operator*(T s, const Vec3& a) { return {{s * a[0], s * a[1], s * a[2]}}; }
  friend constexpr Vec3 operator/(const Vec3& a, T s) { return {{a[0] / s, a[1] / s, a[2] / s}}; }
  friend constexpr bool operator==(const Vec3& a, const Vec3& b) {
    return a[0] == b[0] && a[1] == b[1] && a[2] == b[2];
  }
};

// Component by component.
template <class T>
constexpr Vec3<T> min(const Vec3<T>& a, const Vec3<T>& b) {
  return {{std::min(a[0], b[0]), std::min(a[1], b[1]), std::min(a[2], b[2])}};
}

template <class T>
constexpr Vec3<T> max(const Vec3<T>& a, const Vec3<T>& b) {
  return {{std::max(a[0], b[0]), std::max(a[1], b[1]), std::max(a[2], b[2])}};
}

template <class T>
Vec3<int> floor(const Vec3<T>& a) {
  return {{static_cast<int>(std::floor(a[0])), static_cast<int>(std::floor(a[1])), static_cast<int>(std::floor(a[2]))}};
}

template <class To, class T>
constexpr Vec3<To> cast(const Vec3<T>& a) {
  return {{static_cast<To>(a[0]), static_cast<To>(a[1]), static_cast<To>(a[2])}};
}

template <class T>
constexpr T dot(const Vec3<T>& a, const Vec3<T>& b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

template <class T>
constexpr Vec3<T> cross(const Vec3<T>& a, const Vec3<T>& b) {
  return {{a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]}};
}

template <class T>
T length(const Vec3<T>& a) {
  return std::sqrt(dot(a, a));
}

template <class T>
Vec3<T> normalize(const Vec3<T>& a) {
  return (1 / length(a)) * a;
}

// Row by row.
template <class T>
struct Mat3 {
  Vec3<T> row[3];

  static constexpr Mat3 identity() { return {{{{1, 0, 0}}, {{0, 1, 0}}, {{0, 0, 1}}}}; }
  // K with K b = a x b.
  static constexpr Mat3 cross_product(const Vec3<T>& a) {
    return {{{{0, -a[2], a[1]}}, {{a[2], 0, -a[0]}}, {{-a[1], a[0], 0}}}};
  }
  constexpr T operator()(int i, int j) const { return row[i][j]; }
  constexpr Vec3<T> column(int j) const { return {{row[0][j], row[1][j], row[2][j]}}; }

  static constexpr Mat3 from(const T* p) { return {{Vec3<T>::from(p), Vec3<T>::from(p + 3), Vec3<T>::from(p + 6)}}; }
  constexpr void to(T* p) const { row[0].to(p), row[1].to(p + 3), row[2].to(p + 6); }
  constexpr Mat3 transpose() const { return {{column(0), column(1), column(2)}}; }

  friend constexpr Mat3 operator+(const Mat3& a, const Mat3& b) {
    return {{a.row[0] + b.row[0], a.row[1] + b.row[1], a.row[2] + b.row[2]}};
  }
  friend constexpr Mat3 operator*(T s, const Mat3& a) { return {{s * a.row[0], s * a.row[1], s * a.row[2]}}; }
  friend constexpr Vec3<T> operator*(const Mat3& a, const Vec3<T>& x) {
    return {{dot(a.row[0], x), dot(a.row[1], x), dot(a.row[2], x)}};
  }
  friend constexpr Mat3 operator*(const Mat3& a, const Mat3& b) {
    const Mat3 columns = b.transpose();
    return {{columns * a.row[0], columns * a.row[1], columns * a.row[2]}};
  }
};

template <class To, class T>
constexpr Mat3<To> cast(const Mat3<T>& a) {
  return {{cast<To>(a.row[0]), cast<To>(a.row[1]), cast<To>(a.row[2])}};
}

using Vec3f = Vec3<float>;
using Vec3d = Vec3<double>;
using Vec3i = Vec3<int>;
using Mat3f = Mat3<float>;
using Mat3d = Mat3<double>;

}  // namespace ggslam
