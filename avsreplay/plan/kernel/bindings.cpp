// Python binding: array shapes are checked, and the interpreter lock is released during the computation.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>

#include <cstring>

#include "interior_point.hpp"

namespace nb = nanobind;
using namespace avs;

namespace {

template <typename T, int... N>
using In = nb::ndarray<const T, nb::shape<N...>, nb::c_contig, nb::device::cpu>;

// One stagewise cone programme; None where no solution was found.
nb::object solve(int n, const std::array<double, 3>& start, const std::array<double, 2>& cost, const In<int, -1>& stage,
                 const In<double, -1, WIDTH>& C, const In<double, -1>& d, const In<int, -1>& cones) {
  const size_t m = d.shape(0);
  if (n < 1 || stage.shape(0) != m || C.shape(0) != m) throw nb::value_error("rows of different numbers");
  std::vector<int> sizes(cones.data(), cones.data() + cones.shape(0));
  Rows rows{static_cast<size_t>(n), start, {stage.data(), stage.data() + m}, std::vector<Entry>(m), {d.data(), d.data() + m}};
  if (m) std::memcpy(rows.C.data(), C.data(), m * sizeof(Entry));
  size_t count = 0;
  for (int size : sizes) {
    if (size < 1 || size > 4 || count + size > m) throw nb::value_error("a cone has 1 to 4 rows");
    for (int i = 0; i < size; ++i) {
      const int k = rows.stage[count + i];
      if (k < 0 || k >= n || k != rows.stage[count]) throw nb::value_error("a row belongs to no stage of its cone");
    }
    count += size;
  }
  if (count != m) throw nb::value_error("rows without a cone");
  Answer found;
  {
    nb::gil_scoped_release release;
    found = minimise(rows, sizes, cost);
  }
  if (!found.solved) return nb::none();
  double* w = new double[3 * found.w.size()];
  std::memcpy(w, found.w.data(), 3 * found.w.size() * sizeof(double));
  nb::capsule owner(w, [](void* p) noexcept { delete[] static_cast<double*>(p); });
  const size_t shape[2] = {found.w.size(), 3};
  return nb::make_tuple(found.h, found.slack, nb::ndarray<nb::numpy, double>(w, 2, shape, owner), found.iterations);
}

}  // namespace

NB_MODULE(_cone, m) {
  m.def("solve", &solve, nb::arg("n"), nb::arg("start"), nb::arg("cost"), nb::arg("stage"), nb::arg("C"), nb::arg("d"),
        nb::arg("cones"));
}
