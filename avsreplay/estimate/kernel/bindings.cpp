// Python bindings: array shapes are checked, and the interpreter lock is released during the computation.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>

#include <cstring>

#include "motion.hpp"
#include "update.hpp"

namespace nb = nanobind;
using namespace avs;

namespace {

template <int N>
using Vector = nb::ndarray<const double, nb::shape<N>, nb::c_contig, nb::device::cpu>;
template <int... N>
using Matrix = nb::ndarray<const double, nb::shape<N...>, nb::c_contig, nb::device::cpu>;
using Times = Vector<-1>;
using Numpy = nb::ndarray<nb::numpy, double>;
using Two = std::array<double, 2>;
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

using Square = double[DIM][DIM];
using Rows = double[SEEN][DIM];

// The numbers of an array as a matrix of fixed size.
template <class Fixed>
const Fixed& as(const double* data) {
  return *reinterpret_cast<const Fixed*>(data);
}

// An array of the numbers of a vector or matrix of fixed size.
template <size_t N>
Numpy made(const double (&from)[N]) {
  double* to;
  Numpy out = array({N}, &to);
  std::memcpy(to, from, sizeof from);
  return out;
}

template <size_t N, size_t M>
Numpy made(const double (&from)[N][M]) {
  double* to;
  Numpy out = array({N, M}, &to);
  std::memcpy(to, from, sizeof from);
  return out;
}

// All rows in turn, from y and P.
nb::tuple filter(const Vector<DIM>& y0, const Matrix<DIM, DIM>& P0, const Matrix<-1, SEEN>& e,
                 const Matrix<-1, SEEN, DIM>& H, const Matrix<-1, DIM, DIM>& Q) {
  const size_t n = e.shape(0);
  if (H.shape(0) != n || Q.shape(0) != n) throw std::invalid_argument("e, H and Q must be equally many");
  double y[DIM];
  Square P;
  std::memcpy(y, y0.data(), sizeof y);
  std::memcpy(P, P0.data(), sizeof P);
  {
    nb::gil_scoped_release release;
    for (size_t k = 0; k < n; ++k)
      pass(y, P, e.data() + SEEN * k, as<Rows>(H.data() + SEEN * DIM * k), as<Square>(Q.data() + DIM * DIM * k));
  }
  return nb::make_tuple(made(y), made(P));
}

template <size_t N>
void put(const Vector<(int)N>& from, double (&to)[N]) {
  std::memcpy(to, from.data(), sizeof to);
}

// The state's seven arrays and P, once a pose has been seen.
nb::tuple correct_of(const Vector<4>& q_ab, const Vector<3>& w, const Vector<3>& r, const Vector<3>& v,
                     const Vector<2>& sigma, const Vector<3>& c, const Vector<4>& q_bc, const Matrix<DIM, DIM>& P0,
                     const Matrix<SEEN, DIM>& H, const Vector<SEEN>& alpha, const Matrix<SEEN, SEEN>& S,
                     const Matrix<SEEN, SEEN>& R, const Two& colour) {
  State x;
  Pose seen;
  Square P;
  put<4>(q_ab, x.q_ab), put<3>(w, x.w_b), put<3>(r, x.r_a), put<3>(v, x.v_a);
  put<2>(sigma, x.sigma), put<3>(c, x.c_b), put<4>(q_bc, x.q_bc), put<SEEN>(alpha, seen.alpha);
  std::memcpy(P, P0.data(), sizeof P);
  std::memcpy(seen.H, H.data(), sizeof seen.H);
  std::memcpy(seen.S, S.data(), sizeof seen.S);
  std::memcpy(seen.R, R.data(), sizeof seen.R);
  correct(x, P, seen, colour.data());
  return nb::make_tuple(made(x.q_ab), made(x.w_b), made(x.r_a), made(x.v_a), made(x.sigma), made(x.c_b), made(x.q_bc),
                        made(P));
}

}  // namespace

NB_MODULE(_motion, m) {
  m.def("follow", &follow, nb::arg("q"), nb::arg("w"), nb::arg("sigma"), nb::arg("push"), nb::arg("times"));
  m.def("correct", &correct_of, nb::arg("q_ab"), nb::arg("w_b"), nb::arg("r_a"), nb::arg("v_a"), nb::arg("sigma"),
        nb::arg("c_b"), nb::arg("q_bc"), nb::arg("P"), nb::arg("H"), nb::arg("alpha"), nb::arg("S"), nb::arg("R"),
        nb::arg("colour"));
  m.def("filter", &filter, nb::arg("y"), nb::arg("P"), nb::arg("e"), nb::arg("H"), nb::arg("Q"));
  nb::class_<Path>(m, "Path")
      .def("__init__", [](Path* self, const Vector<4>& q, const Vector<3>& w, const Three& sigma) {
        new (self) Path(turn(q, w), body(sigma, {0, 0, 0}));
      }, nb::arg("q"), nb::arg("w"), nb::arg("sigma"))
      .def("at", &at, nb::arg("times"));
}
