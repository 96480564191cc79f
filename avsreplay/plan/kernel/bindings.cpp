// Python binding: array shapes are checked, and the interpreter lock is released during the computation.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>

#include <cstring>

#include "body.hpp"
#include "constraints.hpp"
#include "interior_point.hpp"
#include "primer.hpp"
#include "space.hpp"

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

template <typename T>
nb::object array(std::vector<T>& values, size_t width = 0) {
  T* data = new T[values.size()];
  std::copy(values.begin(), values.end(), data);
  nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
  const size_t shape[2] = {width ? values.size() / width : values.size(), width};
  return nb::cast(nb::ndarray<nb::numpy, T>(data, width ? 2 : 1, shape, owner));
}

nb::object fields(PointRows& rows) {
  return nb::make_tuple(array(rows.interval), array(rows.fraction), array(rows.vector, 3), array(rows.offset),
                        array(rows.rate), array(rows.slack), array(rows.sizes));
}

// Rows of the geometric constraints: planes and cones, each as the fields of PointRows with the sizes of the groups.
nb::object rows(const In<double, -1, 3>& y, const In<double, -1, 3>& dy, const In<double, -1, 3>& r,
                const In<double, -1, 3>& rho, const In<double, -1, 3, 3>& R, const In<double, -1, ALTERNATIVES>& first,
                const In<double, -1, ALTERNATIVES>& second, const In<double, -1, ALTERNATIVES>& off,
                const In<double, -1, 3>& foot, const In<double, -1>& distance, const In<double, -1>& clearance,
                const In<bool, -1, ALTERNATIVES>& inside, const In<double, 5, 3>& frame,
                const std::array<double, 12>& limits) {
  const size_t m = y.shape(0);
  for (size_t other : {dy.shape(0), r.shape(0), rho.shape(0), R.shape(0), first.shape(0), second.shape(0), off.shape(0),
                       foot.shape(0), distance.shape(0), clearance.shape(0), inside.shape(0)})
    if (other != m) throw nb::value_error("points of different numbers");
  const auto vectors = [](const double* p) { return reinterpret_cast<const Vector3*>(p); };
  const auto pairs = [](const double* p) { return reinterpret_cast<const Pairs*>(p); };
  const ReferencePoints at{m, vectors(y.data()), vectors(dy.data()), vectors(r.data()), vectors(rho.data()),
                           reinterpret_cast<const Matrix3*>(R.data()), pairs(first.data()), pairs(second.data()),
                           pairs(off.data()), vectors(foot.data()), distance.data(), clearance.data(),
                           reinterpret_cast<const uint8_t*>(inside.data())};
  const Vector3* f = vectors(frame.data());
  const auto& l = limits;
  const ConstraintLimits of{{l[0], l[1]}, {l[2], l[3]}, l[4], l[5], l[6], l[7], l[8], l[9], l[10], l[11]};
  PointRows planes, cones;
  constraint_rows(at, {f[0], f[1], f[2], f[3], f[4]}, of, planes, cones);
  return nb::make_tuple(fields(planes), fields(cones));
}

// Positions (m, 3) and rotations (m, 3, 3) from cubic pieces of 12 values, or their derivatives.
nb::object motion(const In<double, 4, -1, 12>& c, const In<double, -1>& x, const In<double, -1>& times, int order) {
  const size_t n = c.shape(1), m = times.shape(0);
  if (n < 1 || x.shape(0) != n + 1 || order < 0 || order > 1) throw nb::value_error("pieces and limits differ");
  double *rho = new double[3 * m], *R = new double[9 * m];
  piecewise(c.data(), x.data(), n, 12, times.data(), m, order, 3, rho, R);
  const auto free = [](void* p) noexcept { delete[] static_cast<double*>(p); };
  nb::capsule own_rho(rho, free), own_R(R, free);
  const size_t shape[3] = {m, 3, 3};
  return nb::make_tuple(nb::ndarray<nb::numpy, double>(rho, 2, shape, own_rho),
                        nb::ndarray<nb::numpy, double>(R, 3, shape, own_R));
}

// Coefficients (4, n - 1, width) of the cubic spline through values (n, width).
nb::object spline_of(const In<double, -1>& x, const In<double, -1, -1>& y) {
  const size_t n = x.shape(0), width = y.shape(1);
  if (n < 4 || y.shape(0) != n) throw nb::value_error("a spline has at least 4 nodes, each with its values");
  for (size_t i = 0; i + 1 < n; ++i)
    if (!(x(i + 1) > x(i))) throw nb::value_error("the nodes of a spline ascend");
  double* c = new double[4 * (n - 1) * width];
  nb::capsule own(c, [](void* p) noexcept { delete[] static_cast<double*>(p); });
  spline(x.data(), y.data(), n, width, c);
  const size_t shape[3] = {4, n - 1, width};
  return nb::cast(nb::ndarray<nb::numpy, double>(c, 3, shape, own));
}

// Values (m, width) of cubic pieces (4, n, width), or their derivatives.
nb::object values(const In<double, 4, -1, -1>& c, const In<double, -1>& x, const In<double, -1>& times, int order) {
  const size_t n = c.shape(1), width = c.shape(2), m = times.shape(0);
  if (n < 1 || x.shape(0) != n + 1 || order < 0 || order > 1) throw nb::value_error("pieces and limits differ");
  double* out = new double[m * width];
  nb::capsule own(out, [](void* p) noexcept { delete[] static_cast<double*>(p); });
  piecewise(c.data(), x.data(), n, width, times.data(), m, order, width, out, out);
  const size_t shape[2] = {m, width};
  return nb::cast(nb::ndarray<nb::numpy, double>(out, 2, shape, own));
}

// Integrals (n, 3), once and twice, of the unit vectors along P from P0 to P1.
nb::object integrals(const In<double, -1, 3>& P0, const In<double, -1, 3>& P1, const In<double, 2, 8>& nodes, double turn,
                     double least) {
  const size_t n = P0.shape(0);
  if (P1.shape(0) != n) throw nb::value_error("vectors of different numbers");
  double *first = new double[3 * n], *second = new double[3 * n];
  primer_integrals(P0.data(), P1.data(), n, reinterpret_cast<const double(*)[8]>(nodes.data()), turn, least, first, second);
  const auto free = [](void* p) noexcept { delete[] static_cast<double*>(p); };
  nb::capsule own_first(first, free), own_second(second, free);
  const size_t shape[2] = {n, 3};
  return nb::make_tuple(nb::ndarray<nb::numpy, double>(first, 2, shape, own_first),
                        nb::ndarray<nb::numpy, double>(second, 2, shape, own_second));
}

using Points = In<double, -1, 3>;
using Values = In<double, -1>;
using Many = In<double, -1, 14>;  // manoeuvres

const Vector3* vectors(const Points& points) { return reinterpret_cast<const Vector3*>(points.data()); }

// An array of n (times width) values, filled without the lock of the interpreter.
template <typename F>
nb::object filled(size_t n, size_t width, F fill) {
  double* out = new double[std::max<size_t>(n * width, 1)];
  nb::capsule own(out, [](void* p) noexcept { delete[] static_cast<double*>(p); });
  {
    nb::gil_scoped_release release;
    fill(out);
  }
  const size_t shape[2] = {n, width};
  return nb::cast(nb::ndarray<nb::numpy, double>(out, width == 1 ? 1 : 2, shape, own));
}

nb::object vectors_of(const std::vector<Vector3>& found) {
  const auto copied = [&](double* out) { std::copy(found.begin(), found.end(), reinterpret_cast<Vector3*>(out)); };
  return filled(found.size(), 3, copied);
}

void make_body(Body* self, const Points& vertices, const In<int, -1, 3>& faces) {
  const size_t n = vertices.shape(0), m = faces.shape(0);
  for (size_t i = 0; i < 3 * m; ++i)
    if (faces.data()[i] < 0 || static_cast<size_t>(faces.data()[i]) >= n)
      throw nb::value_error("a face refers to a missing vertex");
  new (self) Body(std::make_shared<const FaceTree>(vertices.data(), n, faces.data(), m), {});
}

// Closest points (n, 3) of points (n, 3), and their signed distances (n,).
nb::object closest(const Body& body, const Points& points) {
  const size_t n = points.shape(0);
  std::vector<Vector3> feet(n);
  nb::object distances = filled(n, 1, [&](double* out) {
    Near last;
    for (size_t i = 0; i < n; ++i) out[i] = body.signed_distance(vectors(points)[i], last, &feet[i]);
  });
  return nb::make_tuple(vectors_of(feet), distances);
}

using Triple = std::array<double, 3>;

void make_space(Space* self, const Body* body, double clearance, double sigmas, const Triple& axis, const Triple& corridor,
                const Triple& centre, double radius, double enough, const std::array<double, 4>& rates, double a_max,
                double coast, double kept_share) {
  new (self) Space(body, {clearance, sigmas, axis, corridor[0], corridor[1], corridor[2], centre, radius, enough, rates[0],
                          rates[1], rates[2], rates[3], a_max, coast, kept_share});
}

void set_motion(Space& space, const In<double, 4, -1, 12>& c, const Values& x) {
  if (c.shape(1) < 1 || x.shape(0) != c.shape(1) + 1) throw nb::value_error("pieces and limits differ");
  space.set_motion(c.data(), x.data(), c.shape(1));
}

void set_sigma(Space& space, double end, const Values& position, const Values& attitude) {
  if (position.shape(0) < 2 || position.shape(0) != attitude.shape(0)) throw nb::value_error("sigmas differ");
  space.set_sigma(end, position.data(), attitude.data(), position.shape(0));
}

const Manoeuvre* manoeuvres(const Many& m) { return reinterpret_cast<const Manoeuvre*>(m.data()); }

// Largest required distances (n,) of manoeuvres from points (n, 3) in {A} at times (n,).
nb::object most(const Space& space, const Values& times, const Points& r) {
  const size_t n = r.shape(0);
  if (times.shape(0) != n) throw nb::value_error("points of different numbers");
  return filled(n, 1, [&](double* out) {
    Near last;
    for (size_t i = 0; i < n; ++i) out[i] = space.most(times.data()[i], vectors(r)[i], last);
  });
}

// Gradients (n, 3) in {C} of the margin at points (n, 3) in {C}.
nb::object gradient(const Space& space, const Points& y, const Values& times, const Values& most) {
  const size_t n = y.shape(0);
  if (times.shape(0) != n || most.shape(0) != n) throw nb::value_error("points of different numbers");
  return filled(n, 3, [&](double* out) {
    Near last;
    for (size_t i = 0; i < n; ++i)
      reinterpret_cast<Vector3*>(out)[i] = space.gradient(vectors(y)[i], times.data()[i], most.data()[i], last);
  });
}

// Longest durations (n,) of escapes from states (n, 3), (n, 3) at times (n,).
nb::object span(const Space& space, const Values& times, const Points& r, const Points& v) {
  const size_t n = r.shape(0);
  if (times.shape(0) != n || v.shape(0) != n) throw nb::value_error("states of different numbers");
  return filled(n, 1, [&](double* out) {
    for (size_t i = 0; i < n; ++i) out[i] = space.span(times.data()[i], vectors(r)[i], vectors(v)[i]);
  });
}

// Durations (n,) of manoeuvres until the robot recedes outside the sphere.
nb::object ended(const Space& space, const Many& m) {
  const size_t n = m.shape(0);
  return filled(n, 1, [&](double* out) {
    for (size_t i = 0; i < n; ++i) out[i] = space.ended(manoeuvres(m)[i]);
  });
}

// Margins at instants tau (n, k) of manoeuvres; those above ``below`` may be lower bounds.
nb::object margins(const Space& space, const Many& m, const In<double, -1, -1>& tau, double below) {
  const size_t n = m.shape(0), k = tau.shape(1);
  if (tau.shape(0) != n) throw nb::value_error("manoeuvres of different numbers");
  return filled(n, k, [&](double* out) {
    Near first;
    for (size_t i = 0; i < n; ++i) space.margins(manoeuvres(m)[i], tau.data() + i * k, k, below, first, out + i * k);
  });
}

// Lower bounds, smallest margins that were found, and their times (n, 3).
nb::object least(const Space& space, const Many& m, double target) {
  const size_t n = m.shape(0);
  return filled(n, 3, [&](double* out) {
    Near first;
    for (size_t i = 0; i < n; ++i) {
      const Least found = space.least(manoeuvres(m)[i], target, first);
      out[3 * i] = found.lower;
      out[3 * i + 1] = found.upper;
      out[3 * i + 2] = found.at;
    }
  });
}

// Directions of escapes (n, 3), searched from directions d (n, 3), and their margins (n,); NaN: none.
nb::object search(const Space& space, const Values& times, const Points& r, const Points& v, const Points& d,
                  double wanted) {
  const size_t n = r.shape(0);
  if (times.shape(0) != n || v.shape(0) != n || d.shape(0) != n) throw nb::value_error("states of different numbers");
  std::vector<Vector3> found(vectors(d), vectors(d) + n);
  nb::object margins = filled(n, 1, [&](double* out) {
    for (size_t i = 0; i < n; ++i)
      out[i] = space.search(times.data()[i], vectors(r)[i], vectors(v)[i], wanted, found[i]);
  });
  return nb::make_tuple(vectors_of(found), margins);
}

}  // namespace

NB_MODULE(_cone, m) {
  m.def("solve", &solve, nb::arg("n"), nb::arg("start"), nb::arg("cost"), nb::arg("stage"), nb::arg("C"), nb::arg("d"),
        nb::arg("cones"));
  m.def("rows", &rows);
  m.def("motion", &motion);
  m.def("spline", &spline_of);
  m.def("values", &values);
  m.def("integrals", &integrals);
  nb::class_<Body>(m, "Body")
      .def("__init__", &make_body)
      .def("moved", &Body::moved)
      .def("__call__", &closest);
  nb::class_<Space>(m, "Space")
      .def("__init__", &make_space, nb::keep_alive<1, 2>(), nb::arg("body").none(), nb::arg("clearance_m"),
           nb::arg("sigmas"), nb::arg("axis_c"), nb::arg("corridor"), nb::arg("centre_c"), nb::arg("radius_m"),
           nb::arg("enough_m"), nb::arg("rates"), nb::arg("a_max"), nb::arg("coast_s"), nb::arg("kept_share"))
      .def("set_motion", &set_motion)
      .def("set_sigma", &set_sigma)
      .def("most", &most)
      .def("gradient", &gradient)
      .def("span", &span)
      .def("ended", &ended)
      .def("margins", &margins)
      .def("least", &least)
      .def("search", &search);
}
