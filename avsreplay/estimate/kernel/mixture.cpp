// A Gaussian in chart steps that is carried on through time and corrected by a pose (mixture.py).
#include <cstring>
#include <limits>
#include <utility>

#include "elimination.hpp"
#include "fit.hpp"

namespace avs {
namespace {

// A B A' for symmetric B, exactly symmetric.
template <int N>
void congruent(const double A[N][N], const double B[N][N], double out[N][N]) {
  double AB[N][N], At[N][N];
  for (int r = 0; r < N; ++r) {
    double s[N] = {};
    for (int i = 0; i < N; ++i)
      for (int c = 0; c < N; ++c) s[c] += A[r][i] * B[i][c];
    std::memcpy(AB[r], s, sizeof s);
    for (int c = 0; c < N; ++c) At[c][r] = A[r][c];
  }
  for (int r = 0; r < N; ++r) {
    double s[N] = {};
    for (int i = 0; i < N; ++i)
      for (int c = 0; c < N; ++c) s[c] += AB[r][i] * At[i][c];
    std::memcpy(out[r], s, sizeof s);
  }
  for (int r = 0; r < N; ++r)
    for (int c = 0; c < r; ++c) out[r][c] = out[c][r] = 0.5 * (out[r][c] + out[c][r]);
}

// The motion of a chart h seconds later.
Chart later(const Chart& from, double h, const double path[6][6]) {
  State x = state_of(from);
  double join[3][2];
  Turn turn = turn_of(x);
  avs::advance(turn, body_of(x, join), h);
  translate(x, path);
  std::memcpy(x.q_ab, turn.q, sizeof x.q_ab);
  std::memcpy(x.w_b, turn.w, sizeof x.w_b);
  return chart_of(x);
}

// chi-square and log determinant of off ~ N(0, 1 + H P H').
void evidence(const double off[SEEN], const double H[SEEN][DIM], const Square P, double out[2]) {
  double HP[SEEN][DIM], L[SEEN][SEEN], D[SEEN], left[SEEN], det = 1;
  product<SEEN, DIM>(H, P, HP);
  out[0] = 0;
  for (int r = 0; r < SEEN; ++r) {
    left[r] = off[r];
    for (int c = 0; c <= r; ++c) {
      double s = c == r;
      for (int i = 0; i < DIM; ++i) s += HP[r][i] * H[c][i];
      for (int i = 0; i < c; ++i) s -= L[r][i] * D[i] * L[c][i];
      if (c < r) L[r][c] = s / D[c];
      else D[r] = s;
    }
    for (int i = 0; i < r; ++i) left[r] -= L[r][i] * left[i];
    out[0] += left[r] * left[r] / D[r];
    det *= D[r];
  }
  out[1] = det > 1 ? log_of(det) : 0;  // of 1 and a positive semidefinite matrix
}

// Position and velocity in {A} and attitude q_ac of the fixture t seconds after x, when the body has turned to `at`.
struct Fixture {
  V3 position, velocity;
  Quad q;
};

Fixture fixture(const State& x, double t, const Turn& at) {
  const V3 arm = vector(x.c_b), v = vector(x.v_a);
  const M3 A = matrix(quad(at.q));
  return {vector(x.r_a) + t * v + A * arm, v + A * cross(vector(at.w), arm), quad(at.q) * quad(x.q_bc)};
}

// Moves the fixture of a state to `origin`, given in {C}: varrho + A(mu) origin. Returns the displacement in {B}.
V3 move_fixture(State& x, const V3& origin) {
  const V3 by = matrix(quad(x.q_bc)) * origin;
  for (int i = 0; i < 3; ++i) x.c_b[i] += by.x[i];
  return by;
}

// The same with the covariance of the state: A(dmu mu) = (1 + 2 [dmu x]) A(mu).
void move_fixture(State& x, const V3& origin, Square P) {
  const M3 J = skew(move_fixture(x, origin));  // dvarrho' = dvarrho - 2 J dmu
  for (int r = 0; r < 3; ++r)
    for (int k = 0; k < 3; ++k)
      for (int c = 0; c < DIM; ++c) P[14 + r][c] -= 2 * J.x[r][k] * P[17 + k][c];
  for (int r = 0; r < 3; ++r)
    for (int k = 0; k < 3; ++k)
      for (int c = 0; c < DIM; ++c) P[c][14 + r] -= 2 * J.x[r][k] * P[c][17 + k];
}

// The point `origin`, given in {C}, of a chart at each of n ascending times after it.
std::vector<Fixture> path_of(const Chart& chart, const double* times, size_t n, const V3& origin) {
  State x = state_of(chart);
  move_fixture(x, origin);
  double join[3][2], t = 0;
  const Body body = body_of(x, join);
  Turn turn = turn_of(x);
  std::vector<Fixture> out;
  for (size_t k = 0; k < n; t = times[k++]) {
    avs::advance(turn, body, times[k] - t);
    out.push_back(fixture(x, times[k], turn));
  }
  return out;
}

double square(const V3& v) { return v.x[0] * v.x[0] + v.x[1] * v.x[1] + v.x[2] * v.x[2]; }

}  // namespace

void errors_transition(const Flow& flow, const double join[3][2], const double path[6][6], Square Phi) {
  std::memset(Phi, 0, sizeof(Square));
  for (int r = 0; r < DIM; ++r) Phi[r][r] = 1;
  for (int r = 0; r < 6; ++r) {
    std::memcpy(Phi[r], flow.S[r], 6 * sizeof(double));
    for (int c = 0; c < 2; ++c)
      Phi[r][12 + c] = flow.S[r][6] * join[0][c] + flow.S[r][7] * join[1][c] + flow.S[r][8] * join[2][c];
    std::memcpy(&Phi[6 + r][6], path[r], sizeof path[r]);
  }
}

void translate(State& x, const double path[6][6]) {
  double centre[6] = {};
  for (int r = 0; r < 6; ++r)
    for (int c = 0; c < 3; ++c) centre[r] += path[r][c] * x.r_a[c] + path[r][3 + c] * x.v_a[c];
  std::memcpy(x.r_a, centre, sizeof x.r_a);
  std::memcpy(x.v_a, centre + 3, sizeof x.v_a);
}

void transition(Chart& chart, double h, const double path[6][6], const double* torque_density, double force_density,
                Square F, double (*Q)[MOTION]) {
  State x = state_of(chart);
  double join[3][2];
  Body body = body_of(x, join);
  body.tail = 1e-12;
  if (torque_density) std::memcpy(body.push, torque_density, sizeof body.push);
  Flow flow = begin(turn_of(x));
  avs::advance(flow, body, h);
  Square T, Phi;
  errors_of(chart, T);
  errors_transition(flow, join, path, Phi);
  translate(x, path);
  std::memcpy(x.q_ab, flow.at.q, sizeof x.q_ab);
  std::memcpy(x.w_b, flow.at.w, sizeof x.w_b);
  chart = chart_of(x);
  product<DIM, DIM>(Phi, T, F);
  errors_of(chart, T);
  if (Q) {
    double noise[MOTION][MOTION] = {}, into[MOTION][MOTION] = {}, first[MOTION][MOTION];
    for (int r = 0; r < MOTION; ++r) {
      into[r][r] = 1;
      std::memcpy(first[r], T[r], sizeof first[r]);
    }
    Factored<MOTION>(first).divide<MOTION>(into);
    for (int r = 0; r < 6; ++r) std::memcpy(noise[r], flow.Q[r], sizeof flow.Q[r]);
    const double d = std::fabs(h);
    for (int r = 6; r < 9; ++r) {
      noise[r][r] = force_density * d * d * d / 3;
      noise[r][r + 3] = noise[r + 3][r] = force_density * d * d / 2;
      noise[r + 3][r + 3] = force_density * d;
    }
    congruent<MOTION>(into, noise, Q);
  }
  Factored<DIM>(T).divide<DIM>(F);
}

void carry(Chart& chart, Chart& base, Square P, double h, const double path[6][6], const double torque_density[3],
           double force_density, const Measured& pose, const double factors[2], double weight, double told[2]) {
  Square F, moved_on, T;
  double Q[MOTION][MOTION], y[DIM] = {}, e[SEEN];
  chart = later(chart, h, path);
  transition(base, h, path, torque_density, force_density, F, Q);
  congruent<DIM>(F, P, moved_on);
  std::memcpy(P, moved_on, sizeof(Square));
  Problem one;
  one.poses = {pose};
  one.mean = chart;
  std::memset(one.prior_info, 0, sizeof one.prior_info);
  one.factors[0] = factors[0], one.factors[1] = factors[1];
  one.linearise(base);
  one.cost_at(chart, one.d.data());
  one.weights[0] = weight;
  Rows H, HT;
  one.whitened(0, e, H);
  errors_of(base, T);
  product<SEEN, DIM>(H, T, HT);
  for (int r = 0; r < MOTION; ++r)
    for (int c = 0; c < MOTION; ++c) P[r][c] += Q[r][c];
  const double none[MOTION][MOTION] = {};
  evidence(e, HT, P, told);
  pass<DIM>(y, P, e, HT, none);
  chart = moved(chart, y);
}

void mixture_forecast(const Chart* charts, const Chart* references, const Square* P, const double* weights,
                      const double (*torque_density)[3], size_t count, const Chart& published, double force_density,
                      const double* times, size_t n, const V3& origin, double (*out)[3]) {
  const std::vector<Fixture> centre = path_of(published, times, n, origin);
  for (size_t k = 0; k < n; ++k) out[k][0] = out[k][1] = out[k][2] = 0;
  for (size_t i = 0; i < count; ++i) {
    const std::vector<Fixture> mean = path_of(charts[i], times, n, origin);
    Square T, errors;
    errors_of(references[i], T);
    congruent<DIM>(T, P[i], errors);
    State x = state_of(references[i]);
    move_fixture(x, origin, errors);
    double join[3][2], t = 0;
    Body body = body_of(x, join);
    std::memcpy(body.push, torque_density[i], sizeof body.push);
    Flow flow = begin(turn_of(x));
    for (size_t k = 0; k < n; t = times[k++]) {
      avs::advance(flow, body, times[k] - t);
      double variances[3];
      forecast(x, errors, force_density, times[k], flow, variances);
      const Quad turn = conjugate(centre[k].q) * mean[k].q;
      const double apart[3] = {square(mean[k].position - centre[k].position), square(mean[k].velocity - centre[k].velocity),
                               turn.x * turn.x + turn.y * turn.y + turn.z * turn.z};
      for (int block = 0; block < 3; ++block) out[k][block] += weights[i] * (variances[block] + apart[block]);
    }
  }
}

}  // namespace avs
