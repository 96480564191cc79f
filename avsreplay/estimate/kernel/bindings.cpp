// The door to Python: checks shapes, lets go of the interpreter while it walks.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>

#include <cstring>

#include "motion.hpp"

namespace nb = nanobind;
using namespace avs;

namespace {

template <int N>
using Vector = nb::ndarray<const double, nb::shape<N>, nb::c_contig, nb::device::cpu>;
using Times = Vector<-1>;
using Numpy = nb::ndarray<nb::numpy, double>;
using Three = std::array<double, 3>;

Numpy array(std::initializer_list<size_t> shape, double** data) {
  size_t n = 1;
  for (size_t k : shape) n *= k;
  *data = new double[n];
  nb::capsule owner(*data, [](void* p) noexcept { delete[] static_cast<double*>(p); });
  return Numpy(*data, shape.size(), shape.begin(), owner);
}

Turn turn(const Vector<4>& q, const Vector<3>& w) {
  Turn at;
  std::memcpy(at.q, q.data(), sizeof at.q);
  std::memcpy(at.w, w.data(), sizeof at.w);
  return at;
}

Body body(const Three& sigma, const Three& push) {
  return {{sigma[0], sigma[1], sigma[2]}, {push[0], push[1], push[2]}};
}

// One flow through all times in turn, each from the one before.
nb::tuple follow(const Vector<4>& q0, const Vector<3>& w0, const Three& sigma, const Three& push, const Times& times) {
  const size_t n = times.shape(0);
  double *q, *w, *S, *Q;
  Numpy qs = array({n, 4}, &q), ws = array({n, 3}, &w), Ss = array({n, 6, 9}, &S), Qs = array({n, 6, 6}, &Q);
  {
    nb::gil_scoped_release release;
    const Body b = body(sigma, push);
    Flow flow = begin(turn(q0, w0));
    double t = 0;
    for (size_t k = 0; k < n; ++k) {
      advance(flow, b, times(k) - t);
      t = times(k);
      std::memcpy(q + 4 * k, flow.at.q, sizeof flow.at.q);
      std::memcpy(w + 3 * k, flow.at.w, sizeof flow.at.w);
      std::memcpy(S + 54 * k, flow.S, sizeof flow.S);
      std::memcpy(Q + 36 * k, flow.Q, sizeof flow.Q);
    }
  }
  return nb::make_tuple(qs, ws, Ss, Qs);
}

nb::tuple at(Path& path, const Times& times) {
  const size_t n = times.shape(0);
  double *q, *w;
  Numpy qs = array({n, 4}, &q), ws = array({n, 3}, &w);
  for (size_t k = 0; k < n; ++k) {
    const Turn there = path.at(times(k));
    std::memcpy(q + 4 * k, there.q, sizeof there.q);
    std::memcpy(w + 3 * k, there.w, sizeof there.w);
  }
  return nb::make_tuple(qs, ws);
}

}  // namespace

NB_MODULE(_motion, m) {
  m.def("follow", &follow, nb::arg("q"), nb::arg("w"), nb::arg("sigma"), nb::arg("push"), nb::arg("times"));
  nb::class_<Path>(m, "Path")
      .def("__init__", [](Path* self, const Vector<4>& q, const Vector<3>& w, const Three& sigma) {
        new (self) Path(turn(q, w), body(sigma, {0, 0, 0}));
      }, nb::arg("q"), nb::arg("w"), nb::arg("sigma"))
      .def("at", &at, nb::arg("times"));
}
