// Python bindings: array shapes are checked.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <stdexcept>
#include <vector>

#include "root.hpp"

namespace nb = nanobind;

namespace {

template <int... N>
using Matrix = nb::ndarray<const double, nb::shape<N...>, nb::c_contig, nb::device::cpu>;

// The roots (2, n, n) with k more scans: of rows (k, m, n), and of the same rows whitened by R (k, m, m).
nb::ndarray<nb::numpy, double> extended(const Matrix<-1, -1>& root, const Matrix<-1, -1>& white, const Matrix<-1, -1, -1>& rows,
                                        const Matrix<-1, -1, -1>& R) {
  const size_t k = rows.shape(0), m = rows.shape(1), n = rows.shape(2), shape[3] = {2, n, n};
  if (root.shape(0) != n || root.shape(1) != n || white.shape(0) != n || white.shape(1) != n || R.shape(0) != k ||
      R.shape(1) != m || R.shape(2) != m)
    throw std::invalid_argument("sizes of the roots, the rows and their noise differ");
  double* out = new double[2 * n * n];
  nb::capsule owner(out, [](void* p) noexcept { delete[] static_cast<double*>(p); });
  std::copy(root.data(), root.data() + n * n, out);
  std::copy(white.data(), white.data() + n * n, out + n * n);
  std::vector<double> more(rows.data(), rows.data() + k * m * n), whitened = more;
  for (size_t i = 0; i < k; ++i)
    if (!avs::whiten(R.data() + m * m * i, whitened.data() + m * n * i, m, n))
      throw std::invalid_argument("a noise is not positive definite");
  avs::add_rows(out, more.data(), k * m, n);
  avs::add_rows(out + n * n, whitened.data(), k * m, n);
  return nb::ndarray<nb::numpy, double>(out, 3, shape, owner);
}

// L^-1 e of the Cholesky factor L of C (m, m).
nb::ndarray<nb::numpy, double> whitened(const Matrix<-1, -1>& C, const nb::ndarray<const double, nb::shape<-1>, nb::c_contig>& e) {
  const size_t m = e.shape(0), shape[1] = {m};
  if (C.shape(0) != m || C.shape(1) != m) throw std::invalid_argument("sizes of the covariance and the vector differ");
  double* out = new double[m];
  nb::capsule owner(out, [](void* p) noexcept { delete[] static_cast<double*>(p); });
  std::copy(e.data(), e.data() + m, out);
  if (!avs::whiten(C.data(), out, m, 1)) throw std::invalid_argument("a covariance is not positive definite");
  return nb::ndarray<nb::numpy, double>(out, 1, shape, owner);
}

}  // namespace

NB_MODULE(_root, m) {
  m.def("extended", &extended, nb::arg("root"), nb::arg("white"), nb::arg("rows"), nb::arg("R"));
  m.def("whitened", &whitened, nb::arg("C"), nb::arg("e"));
}
