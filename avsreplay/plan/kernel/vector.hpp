// Vectors and matrices of three rows, and vectors of any length.
#pragma once
#include <array>
#include <cmath>
#include <limits>
#include <vector>

namespace avs {

constexpr double INFINITE = std::numeric_limits<double>::infinity();

using Vector3 = std::array<double, 3>;
using Matrix3 = std::array<Vector3, 3>;

inline Vector3 operator-(const Vector3& a, const Vector3& b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }
inline Vector3 operator+(const Vector3& a, const Vector3& b) { return {a[0] + b[0], a[1] + b[1], a[2] + b[2]}; }
inline Vector3 operator*(double s, const Vector3& a) { return {s * a[0], s * a[1], s * a[2]}; }
inline double dot(const Vector3& a, const Vector3& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline double norm(const Vector3& a) { return std::sqrt(dot(a, a)); }
inline Vector3 cross(const Vector3& a, const Vector3& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}
// M v and M' v
inline Vector3 times(const Matrix3& M, const Vector3& v) { return {dot(M[0], v), dot(M[1], v), dot(M[2], v)}; }
inline Vector3 transposed(const Matrix3& M, const Vector3& v) {
  return v[0] * M[0] + v[1] * M[1] + v[2] * M[2];
}

inline double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

using Vector = std::vector<double>;

inline double dot(const Vector& a, const Vector& b) {
  double s = 0;
  for (size_t i = 0; i < a.size(); ++i) s += a[i] * b[i];
  return s;
}
inline double norm(const Vector& a) { return std::sqrt(dot(a, a)); }

}  // namespace avs
