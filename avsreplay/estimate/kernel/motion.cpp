// One Taylor series gives all of it. With time scaled to the step, u = w h, the rate obeys u' = phi(u, sigma), a quadratic
// equation whose coefficients follow from Cauchy products; attitude, derivatives and noise obey linear equations with u
// as coefficient. The solutions are elliptic functions without a pole nearer than |w| h = pi / 2, so the order at which
// the tail is small enough is known beforehand. A constant torque adds its acceleration a to u', times h^2; by the
// majorant y' = y^2 + a the pole is then not nearer than (|w| + root |a|) h = 1.
#include "motion.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <stdexcept>

namespace avs {
namespace {

constexpr double POLE = 1.5;
constexpr double MOST_TURN = 1e6;  // rad in one advance: some seconds of work
constexpr int MOST_ORDER = 16;  // enough for a piece of SUBSTEP

double size(const double* w) { return std::sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]); }

// Rate [rad/s] that bounds the growth of the series.
double pace(const double* w, const Body& body) { return size(w) + std::sqrt(size(body.drive)); }

// Terms until the tail is below `tail`; one at least.
int terms(double turn, double tail) {
  int n = 1;
  for (double left = turn / POLE; left > tail && n < MOST_ORDER; ++n) left *= turn / POLE;
  return n;
}

// Orders of the state's series, to 1e-12 of a radian, and of that of derivatives and noise. The noise is exact to a
// hundred times the tail, and that of the attitude begins with the third power of time.
struct Orders {
  int state, derivative;
};

template <int N>
Orders orders_for(double turn, double tail) {
  const int derivative = std::max(3, terms(turn, tail));
  const int all = N == 12 ? std::min(MOST_ORDER, std::max(derivative, 3 + terms(turn, 100 * tail))) : derivative;
  return {std::max(all, std::max(3, terms(turn, 1e-12))), all};
}

// Taylor coefficients over a step of length 1. Rows of X: dq_v, then u. Its first six columns are the derivatives by u
// and by sigma1..3 at the start (those by dq_v are A(q)' alone); with N = 12 the last six are the noise's covariance, with
// N = 9 the last three the derivative by the angular acceleration.
template <int N>
struct Series {
  double u[MOST_ORDER + 1][3];
  double q[MOST_ORDER + 1][4];
  double X[MOST_ORDER + 1][6][N > 0 ? N : 1];
};

// Coefficients k of the products (uy uz, ux uz, ux uy).
template <int N>
void products(const Series<N>& y, int k, double* p) {
  p[0] = p[1] = p[2] = 0;
  for (int i = 0; i <= k; ++i) {
    p[0] += y.u[i][1] * y.u[k - i][2];
    p[1] += y.u[i][0] * y.u[k - i][2];
    p[2] += y.u[i][0] * y.u[k - i][1];
  }
}

// q' = q * [u 0] / 2 in Hamilton's product.
template <int N>
void attitude(Series<N>& y, int k) {
  double s[4] = {0, 0, 0, 0};
  for (int i = 0; i <= k; ++i) {
    const double *u = y.u[i], *q = y.q[k - i];
    s[0] += q[3] * u[0] + q[1] * u[2] - q[2] * u[1];
    s[1] += q[3] * u[1] + q[2] * u[0] - q[0] * u[2];
    s[2] += q[3] * u[2] + q[0] * u[1] - q[1] * u[0];
    s[3] -= q[0] * u[0] + q[1] * u[1] + q[2] * u[2];
  }
  for (int c = 0; c < 4; ++c) y.q[k + 1][c] = 0.5 * s[c] / (k + 1);
}

// sum over i of f u_i[a] X_{k-i}[row_a] + u_i[b] X_{k-i}[row_b], into out (N).
template <int N>
void convolve(const Series<N>& y, int k, double f, int a, int row_a, int b, int row_b, double* out) {
  double s[N] = {};
  for (int i = 0; i <= k; ++i) {
    const double fa = f * y.u[i][a], fb = y.u[i][b];
    const double *xa = y.X[k - i][row_a], *xb = y.X[k - i][row_b];
    for (int c = 0; c < N; ++c) s[c] += fa * xa[c] + fb * xb[c];
  }
  std::memcpy(out, s, sizeof s);
}

// X' = F X (Eq:F's attitude and rate rows) + the sigmas' drive p; for the noise + (F X)' + the torque's push.
template <int N>
void linear(Series<N>& y, int k, const Body& body, const double* p, const double* push) {
  double(*M)[N] = y.X[k + 1];
  const double(*X)[N] = y.X[k];
  for (int r = 0; r < 3; ++r) {
    const int j = (r + 1) % 3, l = (r + 2) % 3;
    convolve(y, k, -1, j, l, l, j, M[r]);  // -[u x]
    convolve(y, k, 1, j, 3 + l, l, 3 + j, M[3 + r]);  // d(u_j u_l)
    for (int c = 0; c < N; ++c) {
      M[r][c] += 0.5 * X[3 + r][c];
      M[3 + r][c] *= body.sigma[r];
    }
    M[3 + r][3 + r] += p[r];
    if constexpr (N == 9) M[3 + r][6 + r] += k == 0;
  }
  if constexpr (N == 12) {
    for (int r = 0; r < 6; ++r) {
      M[r][6 + r] *= 2;
      for (int c = 0; c < r; ++c) M[r][6 + c] = M[c][6 + r] = M[r][6 + c] + M[c][6 + r];
    }
    for (int r = 0; k == 0 && r < 3; ++r) M[3 + r][9 + r] += push[r];
  }
  const double scale = 1.0 / (k + 1);
  for (int r = 0; r < 6; ++r)
    for (int c = 0; c < N; ++c) M[r][c] *= scale;
}

// The whole series of a step of h seconds; returns its orders.
template <int N>
Orders expand(Series<N>& y, const double* w, const Body& body, double h) {
  const Orders orders = orders_for<N>(pace(w, body) * std::fabs(h), body.tail);
  double push[3];
  for (int r = 0; r < 3; ++r) {
    y.u[0][r] = w[r] * h;
    push[r] = std::fabs(h) * body.push[r] * (h * h);
  }
  const double identity[4] = {0, 0, 0, 1};
  std::memcpy(y.q[0], identity, sizeof identity);
  if constexpr (N > 0) {
    std::memset(y.X[0], 0, sizeof y.X[0]);
    for (int r = 0; r < 3; ++r) y.X[0][3 + r][r] = 1;
  }
  for (int k = 0; k < orders.state; ++k) {
    double p[3];
    products(y, k, p);
    for (int r = 0; r < 3; ++r) y.u[k + 1][r] = body.sigma[r] * p[r] / (k + 1);
    for (int r = 0; k == 0 && r < 3; ++r) y.u[1][r] += body.drive[r] * (h * h);
    attitude(y, k);
    if constexpr (N > 0)
      if (k < orders.derivative) linear(y, k, body, p, push);
  }
  return orders;
}

// Value at the end of the step: the sum of n coefficients, smallest first.
template <int WIDTH>
void sum(const double (*coefficients)[WIDTH], int order, double* out) {
  for (int c = 0; c < WIDTH; ++c) out[c] = 0;
  for (int k = order; k >= 0; --k)
    for (int c = 0; c < WIDTH; ++c) out[c] += coefficients[k][c];
}

void normalise(double* q) {
  const double n = 1 / std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int c = 0; c < 4; ++c) q[c] *= n;
}

// a := a * b in Hamilton's product, of length 1.
void multiply(double* a, const double* b) {
  const double q[4] = {a[3] * b[0] + b[3] * a[0] + a[1] * b[2] - a[2] * b[1],
                       a[3] * b[1] + b[3] * a[1] + a[2] * b[0] - a[0] * b[2],
                       a[3] * b[2] + b[3] * a[2] + a[0] * b[1] - a[1] * b[0],
                       a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2]};
  std::memcpy(a, q, sizeof q);
  normalise(a);
}

// Attitude and rate at the end of the step; q: the turn of the step itself.
template <int N>
void finish(const Series<N>& y, int order, double h, Turn& at, double* q) {
  sum<4>(y.q, order, q);
  normalise(q);
  multiply(at.q, q);
  sum<3>(y.u, order, at.w);
  for (double& rate : at.w) rate /= h;
}

// A(q)', which takes dq_v across the step.
void transposed(const double* q, double A[6][6]) {
  const double x = q[0], y = q[1], z = q[2], w = q[3];
  const double R[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)},
                          {2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)},
                          {2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)}};
  for (int r = 0; r < 3; ++r) std::memcpy(A[r], R[r], sizeof R[r]);
}

// Q := M Q M'.
void carry(const double M[6][6], double Q[6][6]) {
  double MQ[6][6] = {};
  for (int r = 0; r < 6; ++r)
    for (int i = 0; i < 6; ++i)
      for (int c = 0; c < 6; ++c) MQ[r][c] += M[r][i] * Q[i][c];
  for (int r = 0; r < 6; ++r)
    for (int c = 0; c <= r; ++c) {
      double s = 0;
      for (int i = 0; i < 6; ++i) s += MQ[r][i] * M[c][i];
      Q[r][c] = Q[c][r] = s;
    }
}

// S := M S + [0 sigma-columns of the step].
void carry(const double M[6][6], const double drive[6][3], double S[6][9]) {
  double out[6][9] = {};
  for (int r = 0; r < 6; ++r) {
    for (int i = 0; i < 6; ++i)
      for (int c = 0; c < 9; ++c) out[r][c] += M[r][i] * S[i][c];
    for (int c = 0; c < 3; ++c) out[r][6 + c] += drive[r][c];
  }
  std::memcpy(S, out, sizeof out);
}

// One piece of the flow; newest factor on the left.
template <int N>
void piece(Flow& flow, const Body& body, double h) {
  Series<N> y;
  double q[4], X[6][N], M[6][6] = {}, drive[6][3];
  const Orders orders = expand(y, flow.at.w, body, h);
  finish(y, orders.state, h, flow.at, q);
  sum<6 * N>(reinterpret_cast<const double(*)[6 * N]>(y.X), orders.derivative, &X[0][0]);
  transposed(q, M);
  for (int r = 0; r < 6; ++r)
    for (int c = 0; c < 3; ++c) {
      M[r][3 + c] = r < 3 ? X[r][c] * h : X[r][c];
      drive[r][c] = r < 3 ? X[r][3 + c] : X[r][3 + c] / h;
    }
  carry(M, drive, flow.S);
  if constexpr (N == 9) {
    double D[6][3] = {};
    for (int r = 0; r < 6; ++r)
      for (int c = 0; c < 3; ++c) {
        for (int i = 0; i < 6; ++i) D[r][c] += M[r][i] * flow.D[i][c];
        D[r][c] += X[r][6 + c] * (r < 3 ? h * h : h);
      }
    std::memcpy(flow.D, D, sizeof D);
  }
  if constexpr (N == 12) {
    carry(M, flow.Q);
    for (int r = 0; r < 6; ++r)
      for (int c = 0; c < 6; ++c) flow.Q[r][c] += X[r][6 + c] / ((r < 3 ? 1 : h) * (c < 3 ? 1 : h));
  }
}

// Calls one(length) for pieces of at most SUBSTEP rad that make up h; the rate, and so the cut, may change between them.
template <class Rate, class One>
void cut(double h, Rate rate, One one) {
  while (h != 0) {
    const double turn = rate() * std::fabs(h);
    if (!(turn <= MOST_TURN)) throw std::invalid_argument("a step must be finite and turn less than a million radians");
    const double pieces = std::ceil(turn / SUBSTEP - 1e-9);
    const double length = pieces <= 1 ? h : h / pieces;
    one(length);
    h -= length;
  }
}

}  // namespace

Flow begin(const Turn& at) {
  Flow flow{at, {}, {}, {}};
  for (int r = 0; r < 6; ++r) flow.S[r][r] = 1;
  return flow;
}

void advance(Turn& at, const Body& body, double h) {
  cut(h, [&] { return pace(at.w, body); }, [&](double length) {
    Series<0> y;
    double q[4];
    finish(y, expand(y, at.w, body, length).state, length, at, q);
  });
}

void advance(Flow& flow, const Body& body, double h) {
  const bool noisy = body.push[0] != 0 || body.push[1] != 0 || body.push[2] != 0;
  cut(h, [&] { return pace(flow.at.w, body); }, [&](double length) {
    if (noisy)
      piece<12>(flow, body, length);
    else if (body.driven)
      piece<9>(flow, body, length);
    else
      piece<6>(flow, body, length);
  });
}

Path::Path(const Turn& start, const Body& body) : body_(body), spacing_(SUBSTEP / size(start.w)), knots_{start} {}

Turn Path::at(double t) {
  const double place = std::max(0.0, std::floor(t / spacing_));
  if (!(place * SUBSTEP <= MOST_TURN)) throw std::invalid_argument("a time must be finite and within a million radians of turn");
  const size_t k = (size_t)place;
  while (knots_.size() <= k) {
    knots_.push_back(knots_.back());
    advance(knots_.back(), body_, spacing_);
  }
  Turn at = knots_[k];
  advance(at, body_, k ? t - k * spacing_ : t);
  return at;
}

}  // namespace avs
