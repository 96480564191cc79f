// Python bindings: array shapes are checked, and the interpreter lock is released during the computation.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <cstring>
#include <stdexcept>

#include "covariance.hpp"
#include "evidence.hpp"
#include "innovation.hpp"
#include "shocks.hpp"

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

// Principal moments satisfy the triangle inequality only with ratios from -1 to 1. Beyond them the rate grows without bound.
void check_ratios(const double* sigma, int count) {
  for (int k = 0; k < count; ++k)
    if (!(std::fabs(sigma[k]) <= 1 + 1e-9)) throw std::invalid_argument("an inertia ratio must be between -1 and 1");
}

Body body(const Three& sigma, const Three& push, const Three& drive) {
  check_ratios(sigma.data(), 3);
  return {{sigma[0], sigma[1], sigma[2]}, {push[0], push[1], push[2]}, 1e-12, {drive[0], drive[1], drive[2]}};
}

// One flow through all times in turn, each from the one before.
nb::tuple follow(const Vector<4>& q0, const Vector<3>& w0, const Three& sigma, const Three& push, const Times& times,
                 const Three& drive) {
  const size_t n = times.shape(0);
  double *q, *w, *S, *Q;
  Numpy qs = array({n, 4}, &q), ws = array({n, 3}, &w), Ss = array({n, 6, 9}, &S), Qs = array({n, 6, 6}, &Q);
  {
    nb::gil_scoped_release release;
    const Body b = body(sigma, push, drive);
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

// Per instant, a point c of the body from its centre of mass and its velocity about it, in {A}.
nb::tuple point_at(Path& path, const Times& times, const Vector<3>& c) {
  const size_t n = times.shape(0);
  double *p, *v;
  Numpy ps = array({n, 3}, &p), vs = array({n, 3}, &v);
  const V3 arm = vector(c.data());
  for (size_t k = 0; k < n; ++k) {
    const Turn there = path.at(times(k));
    const M3 A = matrix(quad(there.q));
    const V3 from = A * arm, moving = A * cross(vector(there.w), arm);
    std::memcpy(p + 3 * k, from.x, sizeof from.x);
    std::memcpy(v + 3 * k, moving.x, sizeof moving.x);
  }
  return nb::make_tuple(ps, vs);
}

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

template <size_t N>
void put(const Vector<(int)N>& from, double (&to)[N]) {
  std::memcpy(to, from.data(), sizeof to);
}

// A state as the array of its 22 numbers.
constexpr int STATE = sizeof(State) / sizeof(double);
using Mean = Vector<STATE>;

State state(const Mean& from) {
  State x;
  std::memcpy(&x, from.data(), sizeof x);
  check_ratios(x.sigma, 2);
  return x;
}

Numpy flat(const State& from) {
  double* to;
  Numpy out = array({STATE}, &to);
  std::memcpy(to, &from, sizeof from);
  return out;
}

Numpy flat(const Chart& from) {
  double* to;
  Numpy out = array({CHART}, &to);
  std::memcpy(to, &from, sizeof from);
  return out;
}

Numpy chart_from(const Mean& mean) {
  return flat(chart_of(state(mean)));
}

// Per instant: variances of position, velocity and half-angle attitude.
Numpy forecast_of(const Mean& mean, const Matrix<DIM, DIM>& P, const Three& torque, double force, const Times& times) {
  const size_t n = times.shape(0);
  double* variances;
  Numpy out = array({n, 3}, &variances);
  {
    nb::gil_scoped_release release;
    const State x = state(mean);
    double join[3][2], t = 0;
    Body body = body_of(x, join);
    std::memcpy(body.push, torque.data(), sizeof body.push);
    Flow flow = begin(turn_of(x));
    for (size_t k = 0; k < n; ++k) {
      advance(flow, body, times(k) - t);
      t = times(k);
      forecast(x, as<Square>(P.data()), force, t, flow, variances + 3 * k);
    }
  }
  return out;
}

// State and P, once a pose has been seen.
nb::tuple correct_of(const Mean& mean, const Matrix<DIM, DIM>& P0, const Matrix<SEEN, DIM>& H,
                     const Vector<SEEN>& alpha, const Matrix<SEEN, SEEN>& S,
                     const Matrix<SEEN, SEEN>& R, const Matrix<SEEN, SEEN>& noise) {
  State x = state(mean);
  Pose seen;
  Square P;
  put<SEEN>(alpha, seen.alpha);
  std::memcpy(P, P0.data(), sizeof P);
  std::memcpy(seen.H, H.data(), sizeof seen.H);
  std::memcpy(seen.S, S.data(), sizeof seen.S);
  std::memcpy(seen.R, R.data(), sizeof seen.R);
  correct(x, P, seen, as<double[SEEN][SEEN]>(noise.data()));
  return nb::make_tuple(flat(x), made(P));
}

using Six = Matrix<SEEN, SEEN>;

const double (&six(const Six& from))[SEEN][SEEN] {
  return as<double[SEEN][SEEN]>(from.data());
}

// S, whether it is positive definite, and alpha' S^-1 alpha.
nb::tuple innovation_of(const Matrix<DIM, DIM>& P, const Matrix<SEEN, DIM>& H, const Vector<SEEN>& alpha, const Six& R) {
  double S[SEEN][SEEN];
  const double nis = innovation(as<Square>(P.data()), as<double[SEEN][DIM]>(H.data()), alpha.data(), six(R), S);
  return nb::make_tuple(made(S), definite(S), nis);
}

Numpy pose_jacobian_of(const Mean& mean) {
  double H[SEEN][DIM];
  State x;
  std::memcpy(&x, mean.data(), sizeof x);
  pose_jacobian(x, H);
  return made(H);
}

Numpy pose_covariance_of(const Matrix<DIM, DIM>& P, const Matrix<SEEN, DIM>& H) {
  double C[SEEN][SEEN];
  pose_covariance(as<Square>(P.data()), as<double[SEEN][DIM]>(H.data()), C);
  return made(C);
}

std::array<Two, 2> block_squares_of(const Six& R, const Vector<SEEN>& e, const Six& C) {
  std::array<Two, 2> found;
  block_squares(six(R), e.data(), six(C), found[0].data(), found[1].data());
  return found;
}

Numpy shifted_mean(const Mean& mean, const Vector<3>& to) {
  State x = state(mean);
  shift(x, to.data());
  return flat(x);
}

nb::tuple shifted_of(const Mean& mean, const Matrix<DIM, DIM>& P0, const Vector<3>& to) {
  State x = state(mean);
  Square P;
  std::memcpy(P, P0.data(), sizeof P);
  shift(x, P, to.data());
  return nb::make_tuple(flat(x), made(P));
}

constexpr int USED = sizeof(Used) / sizeof(double);

// The numbers of a scan that was used, for change_of.
Numpy used_of(const Matrix<DIM, DIM>& Phi, const Matrix<DIM, DIM>& P, const Matrix<SEEN, DIM>& H, const Vector<SEEN>& alpha,
              const Six& S, const Six& R, const Six& noise) {
  Pose pose;
  Used used;
  std::memcpy(pose.H, H.data(), sizeof pose.H);
  std::memcpy(pose.alpha, alpha.data(), sizeof pose.alpha);
  std::memcpy(pose.S, S.data(), sizeof pose.S);
  std::memcpy(pose.R, R.data(), sizeof pose.R);
  seen_at(as<Square>(P.data()), pose, six(noise), used);
  std::memcpy(used.Phi, Phi.data(), sizeof used.Phi);
  double* to;
  Numpy out = array({(size_t)USED}, &to);
  std::memcpy(to, &used, sizeof used);
  return out;
}

// The likelihood ratio of a change in the last scans, and the second moments (20, 20) of the error it would cause.
nb::tuple change_of(const Matrix<-1, USED>& scans, const Two& one_sigma, const std::vector<double>& sizes, double scale,
                    double share, double most) {
  if (sizes.empty() || !scans.shape(0)) throw std::invalid_argument("a change needs a size and a scan");
  Square moments;
  const double ratio = change_ratio(reinterpret_cast<const Used*>(scans.data()), (int)scans.shape(0), one_sigma.data(), sizes,
                                    scale, share, most, moments);
  return nb::make_tuple(ratio, made(moments));
}

// Log evidence (k), mean (k, n) and covariance (k, n, n) of the unknowns of each M (m, n).
nb::tuple evidence_of(const Matrix<-1, -1, -1>& M, const Vector<-1>& white, const Vector<-1>& size) {
  const size_t k = M.shape(0), m = M.shape(1), n = M.shape(2);
  if (white.shape(0) != m || size.shape(0) != n) throw std::invalid_argument("sizes of M, data and unknowns differ");
  double *values, *means, *covariances;
  Numpy value = array({k}, &values), mean = array({k, n}, &means), P = array({k, n, n}, &covariances);
  for (size_t i = 0; i < k; ++i)
    values[i] = evidence(M.data() + m * n * i, white.data(), size.data(), m, n, means + n * i, covariances + n * n * i);
  return nb::make_tuple(value, mean, P);
}

// Per instant, the derivatives (m, 6) of white data by a change then, of those in `late` (n, m, 12) that `which` names.
Numpy after_changes(const Matrix<-1, -1, MOTION>& late, const nb::ndarray<const int64_t, nb::shape<-1>, nb::c_contig>& which,
                    const Matrix<-1, 6, 3>& impulses, const Times& instants) {
  const size_t k = instants.shape(0), m = late.shape(1);
  if (which.shape(0) != k || impulses.shape(0) != k) throw std::invalid_argument("instants and impulses must be equally many");
  double* values;
  Numpy out = array({k, m, SEEN}, &values);
  for (size_t i = 0; i < k; ++i) {
    const int64_t at = which(i);
    if (at < 0 || (size_t)at >= late.shape(0)) throw std::invalid_argument("there are not so many scans");
    after_change(late.data() + MOTION * m * (size_t)at, as<double[6][3]>(impulses.data() + 18 * i), instants(i), m,
                 values + SEEN * m * i);
  }
  return out;
}

Numpy log_ratio_of(const Matrix<-1, -1, -1>& A, const Matrix<-1, -1>& b) {
  const size_t k = A.shape(0), n = A.shape(1);
  if (A.shape(2) != n || b.shape(0) != k || b.shape(1) != n) throw std::invalid_argument("sizes of A and b differ");
  double* values;
  Numpy value = array({k}, &values);
  for (size_t i = 0; i < k; ++i) values[i] = log_ratio(A.data() + n * n * i, b.data() + n * i, n);
  return value;
}

// Per M (m, n), the log of the mean evidence over kinds, ranges of columns, and factors on the size.
Numpy mixed_of(const Matrix<-1, -1, -1>& M, const Vector<-1>& white, const Vector<-1>& size, const Vector<-1>& factors,
               const std::vector<std::array<size_t, 2>>& kinds) {
  const size_t k = M.shape(0), m = M.shape(1), n = M.shape(2);
  if (white.shape(0) != m || size.shape(0) != n || !factors.shape(0) || kinds.empty())
    throw std::invalid_argument("sizes of M, data and unknowns differ");
  for (const auto& kind : kinds)
    if (kind[0] >= kind[1] || kind[1] > n) throw std::invalid_argument("a kind is not a range of columns");
  double* values;
  Numpy value = array({k}, &values);
  for (size_t i = 0; i < k; ++i)
    values[i] = mixed_evidence(M.data() + m * n * i, white.data(), size.data(), m, n, factors.data(), factors.shape(0),
                               reinterpret_cast<const size_t(*)[2]>(kinds.data()), kinds.size());
  return value;
}

// Per variance of the unknowns, the log evidence over none and the fall of the chi-square, from A = M' M and b = M' white.
nb::tuple impulse_odds_of(const Matrix<-1, -1>& A, const Vector<-1>& b, const Vector<-1>& variances) {
  const size_t n = A.shape(0), k = variances.shape(0);
  if (A.shape(1) != n || b.shape(0) != n) throw std::invalid_argument("sizes of A and b differ");
  double *odds, *fall;
  Numpy first = array({k}, &odds), second = array({k}, &fall);
  std::vector<double> copy(A.data(), A.data() + n * n);
  impulse_odds(copy.data(), {b.data(), b.data() + n}, variances.data(), k, odds, fall);
  return nb::make_tuple(first, second);
}

Numpy lower_inverse_of(const Matrix<-1, -1>& L) {
  const size_t n = L.shape(0);
  if (L.shape(1) != n) throw std::invalid_argument("the matrix is not square");
  double* to;
  Numpy out = array({n, n}, &to);
  lower_inverse(L.data(), n, to);
  return out;
}

using Flat = Vector<CHART>;

Chart chart(const Flat& from) {
  Chart to;
  std::memcpy(&to, from.data(), sizeof to);
  return to;
}

Numpy copied(const std::vector<double>& from, std::initializer_list<size_t> shape) {
  double* to;
  Numpy out = array(shape, &to);
  std::memcpy(to, from.data(), from.size() * sizeof(double));
  return out;
}

Numpy moved_by(const Flat& from, const Vector<DIM>& y) { return flat(moved(chart(from), y.data())); }

Numpy minus_of(const Flat& c, const Flat& from) {
  double y[DIM];
  minus(chart(c), chart(from), y);
  return made(y);
}

Numpy state_at(const Flat& from) { return flat(state_of(chart(from))); }

// Steps (n, 20) from a chart to those of a state displaced by errors (n, 20), |sigma| being at most `most`. The terms of
// the products are added in the order of error_state.py's hamilton.
Numpy spread_of(const Mean& mean, const Matrix<-1, DIM>& errors, double most, const Flat& from) {
  const State centre = state(mean);
  const Chart origin = chart(from);
  const auto product = [](const Quad& a, const Quad& b) {
    return unit({a.w * b.x + b.w * a.x + a.y * b.z - a.z * b.y, a.w * b.y + b.w * a.y + a.z * b.x - a.x * b.z,
                 a.w * b.z + b.w * a.z + a.x * b.y - a.y * b.x, a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z});
  };
  double* y;
  Numpy out = array({errors.shape(0), (size_t)DIM}, &y);
  for (size_t k = 0; k < errors.shape(0); ++k) {
    const double* d = errors.data() + DIM * k;
    State x = centre;
    const Quad q = product(quad(centre.q_ab), half_angle(vector(d))), mu = product(half_angle(vector(d + 17)), quad(centre.q_bc));
    std::memcpy(x.q_ab, &q, sizeof q), std::memcpy(x.q_bc, &mu, sizeof mu);
    for (int i = 0; i < 3; ++i) x.w_b[i] += d[3 + i], x.r_a[i] += d[6 + i], x.v_a[i] += d[9 + i], x.c_b[i] += d[14 + i];
    for (int i = 0; i < 2; ++i) x.sigma[i] = std::min(std::max(x.sigma[i] + d[12 + i], -most), most);
    minus(chart_of(x), origin, y + DIM * k);
  }
  return out;
}

double least_gap_of(const Flat& from) { return least_gap(chart(from)); }

Numpy errors(const Flat& from) {
  Square T;
  errors_of(chart(from), T);
  return made(T);
}

Numpy body_numbers(const Flat& from, const Matrix<DIM, DIM>& P, double largest) {
  double* to;
  Numpy out = array({sizeof(BodyNumbers) / sizeof(double)}, &to);
  const BodyNumbers found = numbers_of(chart(from), as<Square>(P.data()), largest);
  std::memcpy(to, &found, sizeof found);
  return out;
}

// Measured poses, as a fit takes them.
struct Poses {
  std::vector<Measured> each;
};

void create_poses(Poses* self, const Times& t, const Matrix<-1, 4>& q, const Matrix<-1, 3>& p,
                  const Matrix<-1, SEEN>& shift, const Matrix<-1, SEEN, SEEN>& root) {
  const size_t n = t.shape(0);
  if (q.shape(0) != n || p.shape(0) != n || shift.shape(0) != n || root.shape(0) != n)
    throw std::invalid_argument("times, q, p, shift and root must be equally many");
  std::vector<Measured>& poses = (new (self) Poses{std::vector<Measured>(n)})->each;
  for (size_t k = 0; k < n; ++k) {
    Measured& pose = poses[k];
    pose.t = t(k);
    pose.speed = {{{pose.t, 0, 0}, {0, pose.t, 0}, {0, 0, pose.t}}};
    std::memcpy(&pose.q, q.data() + 4 * k, sizeof pose.q);
    std::memcpy(&pose.p, p.data() + 3 * k, sizeof pose.p);
    std::memcpy(pose.shift, shift.data() + SEEN * k, sizeof pose.shift);
    std::memcpy(pose.root, root.data() + SEEN * SEEN * k, sizeof pose.root);
  }
}

void fill(Problem& self, const Poses& poses, const Flat& mean, const Matrix<DIM, DIM>& prior_info) {
  self.poses = poses.each;
  self.mean = chart(mean);
  std::memcpy(self.prior_info, prior_info.data(), sizeof self.prior_info);
}

void create(Problem* self, const Poses& poses, const Flat& mean, const Matrix<DIM, DIM>& prior_info) {
  fill(*new (self) Problem(), poses, mean, prior_info);
}

// An acceleration with a prior 1 sigma of zero is fixed at zero.
void create_driven(Driven* self, const Poses& poses, const Flat& mean, const Matrix<DIM, DIM>& prior_info, double onset,
                   const Vector<SEEN>& widths) {
  fill(*new (self) Driven(), poses, mean, prior_info);
  self->push.onset = onset;
  for (int k = 0; k < SEEN; ++k) {
    self->open[k] = widths(k) > 0;
    self->push.info[k] = self->open[k] ? 1 / (widths(k) * widths(k)) : 1;
  }
}

// A pseudo-measurement of the acceleration with unit standard deviation.
void set_row(Driven& self, const Vector<SEEN>& row, double target) {
  std::memcpy(self.push.row, row.data(), sizeof self.push.row);
  self.push.target = target;
}

// The centre of mass at each pose by position and by velocity at the epoch, in place of those of free motion.
void set_paths(Problem& self, const Matrix<-1, 2, 3, 3>& paths) {
  if (paths.shape(0) != self.poses.size()) throw std::invalid_argument("paths and poses must be equally many");
  for (size_t k = 0; k < self.poses.size(); ++k) {
    std::memcpy(&self.poses[k].place, paths.data() + 18 * k, sizeof(M3));
    std::memcpy(&self.poses[k].speed, paths.data() + 18 * k + 9, sizeof(M3));
  }
}

void set_pin(Problem& self, const Flat& centre, const Vector<DIM>& row, double target, double one_sigma) {
  self.pinned = true;
  self.pin.centre = chart(centre);
  std::memcpy(self.pin.row, row.data(), sizeof self.pin.row);
  self.pin.target = target;
  self.pin.one_sigma = one_sigma;
}

void set_noise(Problem& self, const Two& factors, bool redescend, double gate) {
  self.gate = gate;
  std::memcpy(self.factors, factors.data(), sizeof self.factors);
  self.redescend = redescend;
  if (!self.weights.empty()) self.reweigh();
}

nb::tuple residuals(const Problem& self, const Flat& at) {
  double* d;
  Numpy out = array({self.poses.size(), SEEN}, &d);
  double misfit;
  const double cost = self.cost_at(chart(at), d, &misfit);
  return nb::make_tuple(cost, misfit, out);
}

nb::tuple descend(Problem& self, int most, double gain_tol) {
  int steps = 0;
  bool done;
  {
    nb::gil_scoped_release release;
    done = self.descend(most, gain_tol, steps);
  }
  return nb::make_tuple(steps, done);
}

nb::tuple normal(const Problem& self) {
  Square A;
  double b[DIM];
  self.normal(A, b);
  return nb::make_tuple(made(A), made(b));
}

nb::tuple rows(const Problem& self) {
  const size_t n = self.poses.size();
  double *e, *H;
  Numpy first = array({n, SEEN}, &e), second = array({n, SEEN, DIM}, &H);
  for (size_t k = 0; k < n; ++k) self.whitened(k, e + SEEN * k, *reinterpret_cast<Rows*>(H + SEEN * DIM * k));
  return nb::make_tuple(first, second);
}

// Weighted residuals (n, 6) and their Jacobian (n, 6, 27) by chart steps, acceleration and onset.
nb::tuple driven_rows(const Driven& self) {
  const size_t n = self.poses.size();
  constexpr size_t ALL = DIM + PUSHED;
  double *e, *H;
  Numpy first = array({n, SEEN}, &e), second = array({n, SEEN, ALL}, &H);
  for (size_t k = 0; k < n; ++k)
    self.in_steps<ALL>(k, e + SEEN * k, *reinterpret_cast<double(*)[SEEN][ALL]>(H + SEEN * ALL * k));
  return nb::make_tuple(first, second);
}

Two absorbed(const Problem& self, const Matrix<DIM, DIM>& P) {
  Two out;
  self.absorbed(as<Square>(P.data()), out.data());
  return out;
}

template <int N>
nb::tuple smooth(const Problem& self, const Vector<N>& y0, const Matrix<N, N>& P0, const Matrix<MOTION, MOTION>& into,
                 const Three& torque, double force, double since) {
  double y[N], P[N][N];
  std::memcpy(y, y0.data(), sizeof y);
  std::memcpy(P, P0.data(), sizeof P);
  {
    nb::gil_scoped_release release;
    self.smooth<N>(y, P, as<double[MOTION][MOTION]>(into.data()), torque.data(), force, since);
  }
  return nb::make_tuple(made(y), made(P));
}

// The chart h seconds later, and the transition (20, 20) of its steps.
nb::tuple transition_of(const Flat& from, double h, const Matrix<6, 6>& path) {
  Chart c = chart(from);
  Square F;
  transition(c, h, as<double[6][6]>(path.data()), nullptr, 0, F, nullptr);
  return nb::make_tuple(flat(c), made(F));
}

// Charts after `counts` equal steps from each of n charts, with the transition of each step; all steps in one list.
nb::tuple chains(const Matrix<-1, CHART>& from, const Times& steps, const nb::ndarray<const int64_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>& counts,
                 const Matrix<-1, 6, 6>& paths) {
  const size_t n = from.shape(0);
  size_t total = 0;
  if (steps.shape(0) != n || counts.shape(0) != n) throw std::invalid_argument("charts, steps and counts must be equally many");
  for (size_t k = 0; k < n; ++k) total += (size_t)counts(k);
  if (paths.shape(0) != total) throw std::invalid_argument("there must be one path for each step");
  double *nodes, *F;
  Numpy nodes_ = array({total, CHART}, &nodes), F_ = array({total, DIM, DIM}, &F);
  {
    nb::gil_scoped_release free;
    size_t at = 0;
    for (size_t k = 0; k < n; ++k) {
      Chart c;
      std::memcpy(&c, from.data() + k * CHART, sizeof c);
      for (int64_t i = 0; i < counts(k); ++i, ++at) {
        transition(c, steps(k), *reinterpret_cast<const double(*)[6][6]>(paths.data() + at * 36), nullptr, 0,
                   *reinterpret_cast<double(*)[DIM][DIM]>(F + at * DIM * DIM), nullptr);
        std::memcpy(nodes + at * CHART, &c, sizeof c);
      }
    }
  }
  return nb::make_tuple(nodes_, F_);
}

// The passes over a linear model in time (events/linear.py), by the names of its attributes.
nb::dict passes(const nb::object& given) {
  const auto of = [&](const char* name) { return given.attr(name); };
  const auto F = nb::cast<Matrix<-1, -1, -1>>(of("F")), Q = nb::cast<Matrix<-1, -1, -1>>(of("Q"));
  const auto b = nb::cast<Matrix<-1, -1>>(of("b")), P0 = nb::cast<Matrix<-1, -1>>(of("P0"));
  const auto z = nb::cast<Matrix<-1, 6>>(of("z"));
  const auto H = nb::cast<Matrix<-1, 6, -1>>(of("H"));
  const auto R = nb::cast<Matrix<-1, 6, 6>>(of("R"));
  const auto used = nb::cast<nb::ndarray<const bool, nb::shape<-1>, nb::c_contig, nb::device::cpu>>(of("used"));
  const auto m0 = nb::cast<Times>(of("m0"));
  const size_t count = b.shape(0), n = b.shape(1);
  for (const auto* each : {&F, &Q})
    if (each->shape(0) != count || each->shape(1) != n || each->shape(2) != n) throw std::invalid_argument("a model in time has matrices (k, n, n)");
  if (z.shape(0) != count || H.shape(0) != count || H.shape(2) != n || R.shape(0) != count || used.shape(0) != count || m0.shape(0) != n ||
      P0.shape(0) != n || P0.shape(1) != n)
    throw std::invalid_argument("the arrays of a model in time differ in length");
  TimePasses out{};
  nb::dict found;
  found["before"] = array({count, n}, &out.mean), found["before_P"] = array({count, n, n}, &out.covariance);
  found["score"] = array({count, n}, &out.score), found["information"] = array({count, n, n}, &out.information);
  found["error"] = array({count, SEEN}, &out.error), found["weight"] = array({count, SEEN, SEEN}, &out.weight);
  std::fill(out.error, out.error + count * SEEN, 0.0);
  std::fill(out.weight, out.weight + count * SEEN * SEEN, 0.0);
  const TimeModel model{count, n, F.data(), b.data(), Q.data(), z.data(), H.data(), R.data(), m0.data(), P0.data(), used.data()};
  {
    nb::gil_scoped_release free;
    pass_over(model, out);
  }
  found["log_likelihood"] = out.likelihood;
  return found;
}

// The poses (n) as they would be without an acceleration since an instant, or with it where `back`: turned and moved by
// the difference of the two motions from a chart. `centre` is the centre of mass in free motion.
nb::tuple without_drift(const Flat& from, const Vector<SEEN>& u, double onset, const Poses& seen, const Matrix<-1, 3>& centre,
                        bool back) {
  const std::vector<Measured>& poses = seen.each;
  const size_t n = poses.size();
  if (centre.shape(0) != n) throw std::invalid_argument("poses and centres must be equally many");
  double *turned, *moved, t = 0;
  Numpy qs = array({n, 4}, &turned), ps = array({n, 3}, &moved);
  const State x = state_of(chart(from));
  double join[3][2];
  Body body = body_of(x, join), driven = body;
  Turn free = turn_of(x), pushed = free;
  for (size_t k = 0; k < n; t = poses[k++].t) {
    advance(free, body, poses[k].t - t);
    if (t <= onset && onset < poses[k].t) {
      const V3 drive = matrix(quad(x.q_bc)) * vector(u.data());
      advance(pushed, driven, onset - t);
      std::memcpy(driven.drive, drive.x, sizeof driven.drive);
      t = onset;
    }
    advance(pushed, driven, poses[k].t - t);
    const double since = std::max(poses[k].t - onset, 0.0);
    V3 away = 0.5 * since * since * vector(u.data() + 3), to = vector(centre.data() + 3 * k), was = to + away;
    if (back) std::swap(to, was);
    Quad turn = quad(free.q) * conjugate(quad(pushed.q));
    if (back) turn = conjugate(turn);
    const Quad seen = turn * poses[k].q;
    const V3 place = to + matrix(turn) * (poses[k].p - was);
    std::memcpy(turned + 4 * k, &seen, sizeof seen);
    std::memcpy(moved + 3 * k, place.x, sizeof place.x);
  }
  return nb::make_tuple(qs, ps);
}

// Poses (n) of {C} at attitudes of {B} with the centre of mass `centre`, each corrected by its mean error in {C}: the turn
// `error`, and `moved` at the corrected attitude. `mean`: of the motion, with the fixture.
nb::tuple corrected_poses(const Mean& mean, const Matrix<-1, 4>& attitude, const Matrix<-1, 3>& centre,
                          const Matrix<-1, 4>& error, const Matrix<-1, 3>& moved) {
  const size_t n = attitude.shape(0);
  if (centre.shape(0) != n || error.shape(0) != n || moved.shape(0) != n)
    throw std::invalid_argument("attitudes, centres and errors must be equally many");
  double *turned, *placed;
  Numpy qs = array({n, 4}, &turned), ps = array({n, 3}, &placed);
  const State x = state(mean);
  for (size_t k = 0; k < n; ++k) {
    const Quad body = quad(attitude.data() + 4 * k), q = body * quad(x.q_bc) * quad(error.data() + 4 * k);
    const V3 t = vector(centre.data() + 3 * k) + matrix(body) * vector(x.c_b) - matrix(q) * vector(moved.data() + 3 * k);
    std::memcpy(turned + 4 * k, &q, sizeof q);
    std::memcpy(placed + 3 * k, t.x, sizeof t.x);
  }
  return nb::make_tuple(qs, ps);
}

// Components of a mixture: charts, the charts along which their covariances P (n, 20, 20) are taken, and these.
struct Mixture {
  std::vector<Chart> charts, references;
  std::vector<double> P;
  Square& covariance(size_t k) { return *reinterpret_cast<Square*>(P.data() + DIM * DIM * k); }
  size_t size() const { return charts.size(); }
};

void create_mixture(Mixture* self, const Matrix<-1, CHART>& charts, const Matrix<-1, CHART>& references,
                    const Matrix<-1, DIM, DIM>& P) {
  const size_t n = charts.shape(0);
  if (references.shape(0) != n || P.shape(0) != n)
    throw std::invalid_argument("charts and covariances must be equally many");
  const Chart* first = reinterpret_cast<const Chart*>(charts.data());
  const Chart* second = reinterpret_cast<const Chart*>(references.data());
  new (self) Mixture{{first, first + n}, {second, second + n}, {P.data(), P.data() + DIM * DIM * n}};
}

Numpy flat(const std::vector<Chart>& from) {
  double* to;
  Numpy out = array({from.size(), (size_t)CHART}, &to);
  std::memcpy(to, from.data(), from.size() * sizeof(Chart));
  return out;
}

// A step of time h, over which `path` takes position and velocity of the centre of mass; root density of the torque, and
// density of the force.
struct Step {
  double h, path[6][6], torque, force;
};

void create_step(Step* self, double h, const Matrix<6, 6>& path, double torque, double force) {
  new (self) Step{h, {}, torque, force};
  std::memcpy(self->path, path.data(), sizeof self->path);
}

// A pose, its factors on the standard deviations of attitude and position, and its Cauchy weight.
struct Weighed {
  Measured pose;
  Two factors;
  double weight;
};

void create_weighed(Weighed* self, const Vector<4>& q, const Vector<3>& p, const Matrix<SEEN, SEEN>& root, const Two& factors,
                    double weight) {
  new (self) Weighed{{}, factors, weight};
  std::memcpy(&self->pose.q, q.data(), sizeof self->pose.q);
  std::memcpy(&self->pose.p, p.data(), sizeof self->pose.p);
  std::memcpy(self->pose.root, root.data(), sizeof self->pose.root);
}

// A mixture after a step of time and corrected by a pose there, and the chi-square of the pose with the log determinant of
// its covariance (n).
nb::tuple carry_of(const Mixture& mixture, const Step& step, const Weighed& seen) {
  Mixture after = mixture;
  const size_t n = after.size();
  double *misfit, density[3], told[2];
  Numpy misfits = array({n}, &misfit);
  for (size_t k = 0; k < n; ++k) {
    torque_density(state_of(after.charts[k]), step.torque, density);
    carry(after.charts[k], after.references[k], after.covariance(k), step.h, step.path, density, step.force, seen.pose,
          seen.factors.data(), seen.weight, told);
    misfit[k] = told[0] + told[1];
  }
  return nb::make_tuple(std::move(after), misfits);
}

// Of covariances C (n, 6, 6): lower triangular roots (n, 6, 6) with root C root' = 1.
Numpy roots_of(const Matrix<-1, SEEN, SEEN>& C) {
  const size_t n = C.shape(0);
  double* root;
  Numpy out = array({n, SEEN, SEEN}, &root);
  for (size_t k = 0; k < n; ++k) {
    const auto& one = as<double[SEEN][SEEN]>(C.data() + SEEN * SEEN * k);
    if (!inverse_root(one, *reinterpret_cast<double(*)[SEEN][SEEN]>(root + SEEN * SEEN * k)))
      throw std::invalid_argument("a covariance is not positive definite");
  }
  return out;
}

bool above_of(const Matrix<DIM, DIM>& P, double least) { return above(as<Square>(P.data()), least); }

// (n, 6, 3) errors (dq_v, w) at the start that equal a unit of rate at each instant.
Numpy impulses(const Vector<4>& q0, const Vector<3>& w0, const Three& sigma, const Times& times, const Three& drive) {
  const size_t n = times.shape(0);
  double* out;
  Numpy found = array({n, 6, 3}, &out);
  const Body b = body(sigma, {0, 0, 0}, drive);
  Flow flow = begin(turn(q0, w0));
  double t = 0;
  for (size_t k = 0; k < n; ++k) {
    advance(flow, b, times(k) - t);
    t = times(k);
    double back[6][6];
    backward(flow, back);
    for (int r = 0; r < 6; ++r) std::memcpy(out + 18 * k + 3 * r, &back[r][3], 3 * sizeof(double));
  }
  return found;
}

// (n, 6, 3) derivatives of (dq_v, w) at each instant by the angular acceleration in {B} since the start.
Numpy by_drive(const Vector<4>& q0, const Vector<3>& w0, const Three& sigma, const Times& times, const Three& drive) {
  const size_t n = times.shape(0);
  double* out;
  Numpy found = array({n, 6, 3}, &out);
  Body b = body(sigma, {0, 0, 0}, drive);
  b.driven = true;
  Flow flow = begin(turn(q0, w0));
  for (size_t k = 0; k < n; ++k) {
    advance(flow, b, times(k) - (k ? times(k - 1) : 0));
    std::memcpy(out + 18 * k, flow.D, sizeof flow.D);
  }
  return found;
}

// Per instant, of a mixture: second moments of position, velocity and half-angle attitude about the motion of a chart.
Numpy mixture_forecast_of(const Mixture& mixture, const Vector<-1>& weights, const Matrix<-1, 3>& torque,
                          const Flat& published, double force, const Times& times, const Three& origin) {
  const size_t count = mixture.size(), n = times.shape(0);
  if (weights.shape(0) != count || torque.shape(0) != count)
    throw std::invalid_argument("components, weights and densities must be equally many");
  double* moments;
  Numpy out = array({n, 3}, &moments);
  {
    nb::gil_scoped_release release;
    mixture_forecast(mixture.charts.data(), mixture.references.data(), reinterpret_cast<const Square*>(mixture.P.data()),
                     weights.data(), reinterpret_cast<const double(*)[3]>(torque.data()), count, chart(published), force,
                     times.data(), n, V3{{origin[0], origin[1], origin[2]}}, reinterpret_cast<double(*)[3]>(moments));
  }
  return out;
}

nb::tuple join_of(const Matrix<-1, CHART>& charts, const Matrix<-1, DIM, DIM>& P, const Vector<-1>& weights,
                  const Vector<-1>& quadrature) {
  const size_t n = charts.shape(0);
  if (!n || P.shape(0) != n || weights.shape(0) != n || quadrature.shape(0) != n)
    throw std::invalid_argument("charts, covariances and weights must be equally many, one at least");
  Chart mean;
  Square moments;
  join(reinterpret_cast<const Chart*>(charts.data()), reinterpret_cast<const Square*>(P.data()), weights.data(),
       quadrature.data(), (int)n, mean, moments);
  return nb::make_tuple(flat(mean), made(moments));
}

// The state h seconds later, the transition and the covariance.
nb::tuple propagate_of(const Mean& mean, const Matrix<DIM, DIM>& P0, double h, const Matrix<6, 6>& path,
                       const Three& torque, double force) {
  State x = state(mean);
  Square P, Phi;
  std::memcpy(P, P0.data(), sizeof P);
  propagate(x, P, h, as<double[6][6]>(path.data()), torque.data(), force, Phi);
  return nb::make_tuple(flat(x), made(Phi), made(P));
}

// The nearest order of the truth's axes among R_nb, and the NEES of a belief.
Errors nees_of(const Mean& mean, const Mean& true_mean, const Matrix<DIM, DIM>& P,
                  const Matrix<-1, 3, 3>& R_nb, const Matrix<-1, 4>& q_bn) {
  if (!R_nb.shape(0) || q_bn.shape(0) != R_nb.shape(0))
    throw std::invalid_argument("rotations and quaternions must be equally many, one at least");
  const State x = state(mean);
  const State truth = state(true_mean);
  return errors_squared(truth, x, as<Square>(P.data()), reinterpret_cast<const M3*>(R_nb.data()),
                        reinterpret_cast<const Quad*>(q_bn.data()), (int)R_nb.shape(0));
}

}  // namespace

NB_MODULE(_motion, m) {
  m.def("follow", &follow, nb::arg("q"), nb::arg("w"), nb::arg("sigma"), nb::arg("push"), nb::arg("times"),
        nb::arg("drive") = Three{0, 0, 0});
  m.def("correct", &correct_of, nb::arg("x"), nb::arg("P"), nb::arg("H"), nb::arg("alpha"), nb::arg("S"), nb::arg("R"),
        nb::arg("noise"));
  m.def("forecast", &forecast_of, nb::arg("x"), nb::arg("P"), nb::arg("torque"), nb::arg("force"), nb::arg("times"));
  m.def("mixture_forecast", &mixture_forecast_of, nb::arg("mixture"), nb::arg("weights"), nb::arg("torque"),
        nb::arg("published"), nb::arg("force"), nb::arg("times"), nb::arg("origin_c"));
  m.def("innovation", &innovation_of, nb::arg("P"), nb::arg("H"), nb::arg("alpha"), nb::arg("R"));
  m.def("pose_jacobian", &pose_jacobian_of, nb::arg("x"));
  m.def("pose_covariance", &pose_covariance_of, nb::arg("P"), nb::arg("H"));
  m.def("definite", [](const Six& A) { return definite(six(A)); }, nb::arg("A"));
  m.def("trace_of_ratio", [](const Six& part, const Six& total) { return trace_of_ratio(six(part), six(total)); }, nb::arg("part"),
        nb::arg("total"));
  m.def("squared_traces", [](const Six& part, const Six& total) { return squared_traces(six(part), six(total)); }, nb::arg("part"),
        nb::arg("total"));
  m.def("block_squares", &block_squares_of, nb::arg("R"), nb::arg("e"), nb::arg("C"));
  m.def("shifted_mean", &shifted_mean, nb::arg("x"), nb::arg("to"));
  m.def("shifted", &shifted_of, nb::arg("x"), nb::arg("P"), nb::arg("to"));
  m.def("used", &used_of, nb::arg("Phi"), nb::arg("P"), nb::arg("H"), nb::arg("alpha"), nb::arg("S"), nb::arg("R"),
        nb::arg("noise"));
  m.def("change", &change_of, nb::arg("scans"), nb::arg("one_sigma"), nb::arg("sizes"), nb::arg("scale"), nb::arg("share"),
        nb::arg("most"));
  m.def("after_changes", &after_changes, nb::arg("late"), nb::arg("which"), nb::arg("impulses"), nb::arg("instants"));
  m.def("evidence", &evidence_of, nb::arg("M"), nb::arg("white"), nb::arg("size"));
  m.def("log_ratio", &log_ratio_of, nb::arg("A"), nb::arg("b"));
  m.def("mixed", &mixed_of, nb::arg("M"), nb::arg("white"), nb::arg("size"), nb::arg("factors"), nb::arg("kinds"));
  m.def("impulse_odds", &impulse_odds_of, nb::arg("A"), nb::arg("b"), nb::arg("variances"));
  m.def("lower_inverse", &lower_inverse_of, nb::arg("L"));
  m.def("chart", &chart_from, nb::arg("x"));
  m.def("least_gap", &least_gap_of, nb::arg("chart"));
  m.def("moved", &moved_by, nb::arg("chart"), nb::arg("y"));
  m.def("spread", &spread_of, nb::arg("x"), nb::arg("errors"), nb::arg("most"), nb::arg("chart"));
  m.def("minus", &minus_of, nb::arg("chart"), nb::arg("other"));
  m.def("state", &state_at, nb::arg("chart"));
  m.def("errors", &errors, nb::arg("chart"));
  m.def("body", &body_numbers, nb::arg("chart"), nb::arg("P"), nb::arg("largest"));
  m.def("chains", &chains, nb::arg("charts"), nb::arg("steps"), nb::arg("counts"), nb::arg("paths"));
  m.def("passes", &passes, nb::arg("model"));
  m.def("transition", &transition_of, nb::arg("chart"), nb::arg("h"), nb::arg("path"));
  nb::class_<Mixture>(m, "Mixture")
      .def("__init__", &create_mixture, nb::arg("charts"), nb::arg("references"), nb::arg("P"))
      .def_prop_ro("charts", [](const Mixture& self) { return flat(self.charts); }, nb::rv_policy::move)
      .def_prop_ro("references", [](const Mixture& self) { return flat(self.references); }, nb::rv_policy::move)
      .def_prop_ro("P", [](const Mixture& self) { return copied(self.P, {self.size(), DIM, DIM}); }, nb::rv_policy::move);
  nb::class_<Step>(m, "Step").def("__init__", &create_step, nb::arg("h"), nb::arg("path"), nb::arg("torque"), nb::arg("force"));
  nb::class_<Weighed>(m, "Weighed")
      .def("__init__", &create_weighed, nb::arg("q"), nb::arg("t"), nb::arg("root"), nb::arg("factors"), nb::arg("weight"));
  m.def("carry", &carry_of, nb::arg("mixture"), nb::arg("step"), nb::arg("seen"));
  m.def("without_drift", &without_drift, nb::arg("chart"), nb::arg("u"), nb::arg("onset"), nb::arg("poses"), nb::arg("centre"),
        nb::arg("back"));
  m.def("corrected_poses", &corrected_poses, nb::arg("x"), nb::arg("attitude"), nb::arg("centre"), nb::arg("error"),
        nb::arg("moved"));
  m.def("roots", &roots_of, nb::arg("C"));
  m.def("above", &above_of, nb::arg("P"), nb::arg("least"));
  m.def("impulses", &impulses, nb::arg("q"), nb::arg("w"), nb::arg("sigma"), nb::arg("times"),
        nb::arg("drive") = Three{0, 0, 0});
  m.def("by_drive", &by_drive, nb::arg("q"), nb::arg("w"), nb::arg("sigma"), nb::arg("times"), nb::arg("drive"));
  m.def("join", &join_of, nb::arg("charts"), nb::arg("P"), nb::arg("weights"), nb::arg("quadrature"));
  m.def("propagate", &propagate_of, nb::arg("x"), nb::arg("P"), nb::arg("h"), nb::arg("path"), nb::arg("torque"),
        nb::arg("force"));
  nb::class_<Errors>(m, "Errors")
      .def_ro("best", &Errors::best)
      .def_ro("size", &Errors::size)
      .def_ro("chart", &Errors::chart)
      .def_prop_ro("block", [](const Errors& self) { return std::vector<double>(self.block, self.block + BLOCK_COUNT); });
  m.def("nees", &nees_of, nb::arg("x"), nb::arg("truth"), nb::arg("P"),
        nb::arg("R_nb"), nb::arg("q_bn"));
  nb::class_<Poses>(m, "Poses")
      .def("__init__", &create_poses, nb::arg("times"), nb::arg("q"), nb::arg("t"), nb::arg("shift"), nb::arg("root"));
  nb::class_<Problem>(m, "Problem")
      .def("__init__", &create, nb::arg("poses"), nb::arg("mean"), nb::arg("prior_info"))
      .def("paths", &set_paths, nb::arg("paths"))
      .def("pin", &set_pin, nb::arg("centre"), nb::arg("row"), nb::arg("target"), nb::arg("one_sigma"))
      .def("unpin", [](Problem& self) { self.pinned = false; })
      .def("noise", &set_noise, nb::arg("factors"), nb::arg("redescend"), nb::arg("gate"))
      .def("linearise", [](Problem& self, const Flat& at) { self.linearise(chart(at)); }, nb::arg("chart"))
      .def("residuals", &residuals, nb::arg("chart"))
      .def("descend", &descend, nb::arg("most"), nb::arg("gain_tol"))
      .def("normal", &normal)
      .def("rows", &rows)
      .def("absorbed", &absorbed, nb::arg("P"))
      .def("smooth", &smooth<DIM>, nb::arg("y"), nb::arg("P"), nb::arg("into"), nb::arg("torque"), nb::arg("force"),
           nb::arg("since") = 0.0)
      .def_prop_ro("chart", [](const Problem& self) { return flat(self.at); }, nb::rv_policy::move)
      .def_prop_ro("cost", [](const Problem& self) { return self.cost; })
      .def_prop_ro("d", [](const Problem& self) { return copied(self.d, {self.poses.size(), SEEN}); }, nb::rv_policy::move)
      .def_prop_ro("weights", [](const Problem& self) { return copied(self.weights, {self.poses.size()}); }, nb::rv_policy::move);
  nb::class_<Driven, Problem>(m, "Driven")
      .def("__init__", &create_driven, nb::arg("poses"), nb::arg("mean"), nb::arg("prior_info"), nb::arg("onset"),
           nb::arg("widths"))
      .def("measure", &set_row, nb::arg("row"), nb::arg("target"))
      .def("linearise", [](Driven& self, const Flat& at, const Vector<SEEN>& u) { self.linearise(chart(at), u.data()); },
           nb::arg("chart"), nb::arg("u"))
      .def("step", &Driven::step, nb::arg("damping"))
      .def("rows", &driven_rows)
      .def("normal", [](const Driven& self) { return nb::make_tuple(made(self.A), made(self.b)); })
      .def("smooth", &smooth<DIM + PUSHED>, nb::arg("y"), nb::arg("P"), nb::arg("into"), nb::arg("torque"),
           nb::arg("force"), nb::arg("since"))
      .def_prop_ro("u", [](const Driven& self) { return made(self.push.u); }, nb::rv_policy::move)
      .def_prop_ro("left", [](const Driven& self) { return self.left; });
  nb::class_<Path>(m, "Path")
      .def("__init__", [](Path* self, const Vector<4>& q, const Vector<3>& w, const Three& sigma, const Three& drive) {
        new (self) Path(turn(q, w), body(sigma, {0, 0, 0}, drive));
      }, nb::arg("q"), nb::arg("w"), nb::arg("sigma"), nb::arg("drive") = Three{0, 0, 0})
      .def("at", &at, nb::arg("times"))
      .def("point", &point_at, nb::arg("times"), nb::arg("c"));
}
