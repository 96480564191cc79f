#include "fit.hpp"

#include <cstring>
#include <limits>
#include <stdexcept>

namespace avs {
namespace {

constexpr double DERIVATIVE_TAIL = 1e-7;  // relative error of the Jacobian by one piece of the flow
constexpr double DIFFERENCE = 0.1;  // part of a step for the second derivative along it
constexpr double MOST_BENT = 0.14;  // square of the second-order part of a step over that of the first: (0.75 / 2)^2
constexpr double LARGEST_RADPS = 0.5;  // a step that changes the rate by more than this plus the rate itself is not tried

double dot(const double* a, const double* b, int n) {
  double s = 0;
  for (int i = 0; i < n; ++i) s += a[i] * b[i];
  return s;
}

// Rows (3, 20) of the attitude's derivative B by (dq_v, w, sigma1..3), multiplied by A (3, 3) from the left.
void turned(const M3& A, double f, const double S[6][9], const double join[3][2], double rows[3][DIM]) {
  for (int r = 0; r < 3; ++r) {
    double s[9];
    for (int c = 0; c < 9; ++c) s[c] = f * (A.x[r][0] * S[0][c] + A.x[r][1] * S[1][c] + A.x[r][2] * S[2][c]);
    for (int c = 0; c < 6; ++c) rows[r][c] = s[c];
    for (int c = 0; c < 2; ++c) rows[r][12 + c] = s[6] * join[0][c] + s[7] * join[1][c] + s[8] * join[2][c];
  }
}

void put(const M3& A, double f, int column, double rows[3][DIM]) {
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) rows[r][column + c] = f * A.x[r][c];
}

// T' A T, symmetric.
void congruent(const Square T, const Square A, Square out) {
  Square AT = {};
  for (int r = 0; r < DIM; ++r)
    for (int i = 0; i < DIM; ++i)
      for (int c = 0; c < DIM; ++c) AT[r][c] += A[r][i] * T[i][c];
  for (int r = 0; r < DIM; ++r)
    for (int c = 0; c < DIM; ++c) out[r][c] = 0;
  for (int i = 0; i < DIM; ++i)
    for (int r = 0; r < DIM; ++r)
      for (int c = 0; c < DIM; ++c) out[r][c] += T[i][r] * AT[i][c];
}

// A += H' H in the first N columns of H, of which the upper triangle counts, and b -= H' e.
template <int N, int W>
void accumulate(const double (&H)[SEEN][W], const double e[SEEN], double A[N][N], double b[N]) {
  for (int r = 0; r < N; ++r) {
    double s[N];
    const int first = r & ~3;  // in groups of four
    std::memcpy(s, A[r], sizeof s);
    for (int i = 0; i < SEEN; ++i) {
      const double h = H[i][r];
      for (int c = first; c < N; ++c) s[c] += h * H[i][c];
      b[r] -= h * e[i];
    }
    std::memcpy(A[r], s, sizeof s);
  }
}

// S^-1 Q S^-T of a flow: its noise propagated back to the start.
void at_start(const Flow& flow, double out[6][6]) {
  double back[6][6];
  backward(flow, back);
  double half[6][6] = {}, across[6][6];
  for (int r = 0; r < 6; ++r)
    for (int c = 0; c < 6; ++c) across[c][r] = back[r][c];
  for (int r = 0; r < 6; ++r)
    for (int i = 0; i < 6; ++i)
      for (int c = 0; c < 6; ++c) half[r][c] += back[r][i] * flow.Q[i][c];
  for (int r = 0; r < 6; ++r) {
    double s[6] = {};
    for (int i = 0; i < 6; ++i)
      for (int c = 0; c < 6; ++c) s[c] += half[r][i] * across[i][c];
    std::memcpy(out[r], s, sizeof s);
  }
}

}  // namespace

void backward(const Flow& flow, double out[6][6]) {
  double D[3][3];
  for (int r = 0; r < 3; ++r) std::memcpy(D[r], &flow.S[3 + r][3], sizeof D[r]);
  const M3 rate = inverse(D);  // S = [A B; 0 D] with A orthogonal
  std::memset(out, 0, 36 * sizeof(double));
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) {
      out[r][c] = flow.S[c][r];
      out[3 + r][3 + c] = rate.x[r][c];
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) out[r][3 + c] -= flow.S[i][r] * flow.S[i][3 + j] * rate.x[j][c];
    }
}

M3 inverse(const double A[3][3]) {
  M3 out;
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c)
      out.x[c][r] = A[NEXT[r]][NEXT[c]] * A[LAST[r]][LAST[c]] - A[NEXT[r]][LAST[c]] * A[LAST[r]][NEXT[c]];
  const double det = A[0][0] * out.x[0][0] + A[0][1] * out.x[1][0] + A[0][2] * out.x[2][0];
  for (auto& row : out.x)
    for (double& v : row) v /= det;
  return out;
}

Turn turn_of(const State& x) {
  Turn turn;
  std::memcpy(turn.q, x.q_ab, sizeof turn.q);
  std::memcpy(turn.w, x.w_b, sizeof turn.w);
  return turn;
}

Body body_of(const State& x, double join[3][2]) {
  const double a = x.sigma[0], b = x.sigma[1], one = 1 + a * b;
  const double slopes[3][2] = {{1, 0}, {0, 1}, {(b * b - 1) / (one * one), (a * a - 1) / (one * one)}};
  std::memcpy(join, slopes, sizeof slopes);
  return {{a, b, -(a + b) / one}, {0, 0, 0}, DERIVATIVE_TAIL};
}

void torque_density(const State& x, double torque, double density[3]) {
  const double s1 = x.sigma[0], s2 = x.sigma[1];
  const double B[3] = {1 + (2 + s1 * s2 + s1) / (1 - s2), 1 + (2 + s1 * s2 - s2) / (1 + s1),
                       1 + (2 + s1 - s2) / (1 + s1 * s2)};
  for (int k = 0; k < 3; ++k) density[k] = torque == 0 ? 0 : (torque * B[k]) * (torque * B[k]);
}

// d = [theta; v] in {C}: estimated relative to measured pose. Returns chi-square.
double Problem::residual(const Measured& pose, const State& x, const Turn& turn, double d[SEEN]) const {
  const V3 theta = rotation_vector(conjugate(pose.q) * (quad(turn.q) * quad(x.q_bc)));
  const V3 centre = pose.place * vector(x.r_a) + pose.speed * vector(x.v_a);
  V3 off = centre + matrix(quad(turn.q)) * vector(x.c_b) - pose.p;
  if (const double since = pose.t - push.onset; since > 0) off = off + 0.5 * since * since * vector(push.u + 3);
  const V3 v = transposed(matrix(pose.q)) * off;
  for (int k = 0; k < 3; ++k) {
    d[k] = theta.x[k] + pose.shift[k];
    d[k + 3] = v.x[k] + pose.shift[k + 3];
  }
  double chi2 = 0;
  for (int r = 0; r < SEEN; ++r) {
    double e = 0;
    for (int c = 0; c <= r; ++c) e += pose.root[r][c] * d[c];
    e /= factors[r >= 3];
    chi2 += e * e;
  }
  return chi2;
}

double Problem::robust(double chi2, double* weight) const {
  const double over = chi2 / gate;
  *weight = 1;
  if (!(over > 1)) return chi2;
  *weight = redescend ? 1 / over : 1 / std::sqrt(over);
  return redescend ? gate * (1 + log_of(over)) : gate * (2 * std::sqrt(over) - 1);
}

double Problem::penalty(const Chart& chart) const {
  double off[DIM], s = 0;
  minus(chart, mean, off);
  for (int r = 0; r < DIM; ++r) s += off[r] * dot(prior_info[r], off, DIM);
  const double miss_u = dot(push.row, push.u, SEEN) - push.target;
  for (int r = 0; r < SEEN; ++r) s += push.u[r] * push.info[r] * push.u[r];
  s += miss_u * miss_u;
  if (!pinned) return 0.5 * s;
  minus(chart, pin.centre, off);
  const double miss = (dot(pin.row, off, DIM) - pin.target) / pin.one_sigma;
  return 0.5 * (s + miss * miss);
}

template <class Motion, class At>
void Problem::go(Motion& motion, Body& body, const State& x, double from, double to, At at_onset) const {
  if (from <= push.onset && push.onset < to) {
    avs::advance(motion, body, push.onset - from);
    const V3 drive = matrix(quad(x.q_bc)) * vector(push.u);
    std::memcpy(body.drive, drive.x, sizeof body.drive);
    body.driven = true;
    at_onset();
    from = push.onset;
  }
  avs::advance(motion, body, to - from);
}

double Problem::cost_at(const Chart& chart, double* residuals, double* misfit) const {
  const State x = state_of(chart);
  double join[3][2], own[SEEN], weight, sum = 0, t = 0;
  Body body = body_of(x, join);
  Turn turn = turn_of(x);
  for (size_t k = 0; k < poses.size(); ++k) {
    go(turn, body, x, t, poses[k].t, [] {});
    t = poses[k].t;
    sum += robust(residual(poses[k], x, turn, residuals ? residuals + SEEN * k : own), &weight);
  }
  if (misfit) *misfit = 0.5 * sum;
  return 0.5 * sum + penalty(chart);
}

// The cost at a trial, infinite where its motion cannot be computed (an inertia or a rate beyond all bounds).
double Problem::trial_cost(const Chart& chart, double* residuals) const {
  try {
    return cost_at(chart, residuals);
  } catch (const std::invalid_argument&) {
    return std::numeric_limits<double>::infinity();
  }
}

void Problem::linearise(const Chart& chart) {
  const size_t n = poses.size();
  at = chart;
  d.resize(SEEN * n), J.assign(SEEN * DIM * n, 0.0), Ju.clear();
  if (std::isfinite(push.onset)) Ju.assign(SEEN * PUSHED * n, 0.0);
  const State x = state_of(chart);
  errors_of(chart, T);
  double join[3][2], later[6] = {}, t = 0;  // `later`: errors at the epoch by the onset
  Body body = body_of(x, join);
  Flow flow = begin(turn_of(x));
  const M3 A_cb = transposed(matrix(quad(x.q_bc))), arm = skew(vector(x.c_b));
  for (size_t k = 0; k < n; ++k) {
    const Measured& pose = poses[k];
    go(flow, body, x, t, pose.t, [&] {
      double back[6][6];
      backward(flow, back);
      for (int r = 0; r < 6; ++r) later[r] = -dot(back[r] + 3, body.drive, 3);
    });
    t = pose.t;
    residual(pose, x, flow.at, &d[SEEN * k]);
    const M3 R_ca = transposed(matrix(pose.q)), R_cb = R_ca * matrix(quad(flow.at.q));
    auto* rows = reinterpret_cast<double(*)[DIM]>(&J[SEEN * DIM * k]);
    turned(A_cb, 2, flow.S, join, rows);
    put(A_cb, 2, 17, rows);
    turned(R_cb * arm, -2, flow.S, join, rows + 3);
    put(R_ca * pose.place, 1, 6, rows + 3);
    put(R_ca * pose.speed, 1, 9, rows + 3);
    put(R_cb, 1, 14, rows + 3);
    if (!body.driven) continue;
    auto* by_push = reinterpret_cast<double(*)[PUSHED]>(&Ju[SEEN * PUSHED * k]);
    const double since = t - push.onset;
    const M3 A_bc = transposed(A_cb), axes[2] = {A_cb, R_cb * arm};
    const V3 force = vector(push.u + 3), moved = R_ca * force;
    for (int half = 0; half < 2; ++half) {
      double by_drive[3][3] = {}, f = half ? -2 : 2;  // of d by the angular acceleration in {B}
      for (int r = 0; r < 3; ++r)
        for (int i = 0; i < 3; ++i) {
          for (int c = 0; c < 3; ++c) by_drive[r][c] += f * axes[half].x[r][i] * flow.D[i][c];
          by_push[3 * half + r][6] += f * axes[half].x[r][i] * dot(flow.S[i], later, 6);
        }
      for (int r = 0; r < 3; ++r) {
        const V3 row = vector(by_drive[r]), by_u = transposed(A_bc) * row, by_mu = cross(row, vector(body.drive));
        for (int c = 0; c < 3; ++c) {
          by_push[3 * half + r][c] = by_u.x[c];
          rows[3 * half + r][17 + c] -= 2 * by_mu.x[c];  // R(dmu mu) = (1 + 2 [dmu x]) R(mu)
        }
      }
    }
    for (int r = 0; r < 3; ++r) {
      for (int c = 0; c < 3; ++c) by_push[3 + r][3 + c] = 0.5 * since * since * R_ca.x[r][c];
      by_push[3 + r][6] -= since * moved.x[r];
    }
  }
  reweigh();
}

void Problem::reweigh() {
  const size_t n = poses.size();
  weights.resize(n);
  double sum = 0;
  for (size_t k = 0; k < n; ++k) {
    double chi2 = 0;
    for (int r = 0; r < SEEN; ++r) {
      double e = 0;
      for (int c = 0; c <= r; ++c) e += poses[k].root[r][c] * d[SEEN * k + c];
      e /= factors[r >= 3];
      chi2 += e * e;
    }
    sum += robust(chi2, &weights[k]);
  }
  cost = 0.5 * sum + penalty(at);
}

void Problem::whitened(size_t k, double e[SEEN], Rows H) const {
  const double w = std::sqrt(weights[k]);
  const double* jacobian = &J[SEEN * DIM * k];
  for (int r = 0; r < SEEN; ++r) {
    e[r] = 0;
    for (int c = 0; c < DIM; ++c) H[r][c] = 0;
    for (int i = 0; i <= r; ++i) {
      const double f = w * poses[k].root[r][i] / factors[r >= 3];
      e[r] += f * d[SEEN * k + i];
      for (int c = 0; c < DIM; ++c) H[r][c] += f * jacobian[DIM * i + c];
    }
  }
}

template <int N>
void Problem::in_steps(size_t k, double e[SEEN], double H[SEEN][N]) const {
  Rows own, turned;
  whitened(k, e, own);
  product<SEEN, DIM>(own, T, turned);
  const double w = std::sqrt(weights[k]);
  for (int r = 0; r < SEEN; ++r) {
    std::memcpy(H[r], turned[r], sizeof turned[r]);
    for (int c = DIM; c < N; ++c) {
      H[r][c] = 0;
      for (int i = 0; i <= r; ++i)
        H[r][c] += w * poses[k].root[r][i] / factors[r >= 3] * Ju[PUSHED * (SEEN * k + i) + c - DIM];
    }
  }
}

template void Problem::in_steps<DIM>(size_t, double[SEEN], double[SEEN][DIM]) const;
template void Problem::in_steps<DIM + PUSHED>(size_t, double[SEEN], double[SEEN][DIM + PUSHED]) const;

void Problem::normal(Square A, double b[DIM]) const {
  Square B = {};
  double g[DIM] = {}, e[SEEN];
  Rows H;
  for (size_t k = 0; k < poses.size(); ++k) {
    whitened(k, e, H);
    accumulate<DIM>(H, e, B, g);
  }
  for (int r = 0; r < DIM; ++r)
    for (int c = 0; c < r; ++c) B[r][c] = B[c][r];
  congruent(T, B, A);
  double off[DIM];
  minus(at, mean, off);
  for (int r = 0; r < DIM; ++r) {
    b[r] = -dot(prior_info[r], off, DIM);
    for (int i = 0; i < DIM; ++i) b[r] += T[i][r] * g[i];
    for (int c = 0; c < DIM; ++c) A[r][c] += prior_info[r][c];
  }
  if (!pinned) return;
  minus(at, pin.centre, off);
  const double miss = (dot(pin.row, off, DIM) - pin.target) / pin.one_sigma;
  for (int r = 0; r < DIM; ++r) {
    const double row = pin.row[r] / pin.one_sigma;
    b[r] -= row * miss;
    for (int c = 0; c < DIM; ++c) A[r][c] += row * pin.row[c] / pin.one_sigma;
  }
}

// The second-order part of a step of the damped normal equations M (Transtrum and Sethna, arXiv:1201.5885): a =
// -1/2 M^-1 J' r'', r'' the second derivative of the residuals along the step, by a finite difference. A descent along
// a bent valley of the cost takes far fewer steps with it. Returns whether the step with it remains a small correction.
bool Problem::bent(const Square M, const Square A, double step[DIM], std::vector<double>& trial) const {
  double part[DIM], along[DIM] = {}, g[DIM] = {}, a[DIM] = {}, sizes[2] = {}, e[SEEN];
  for (int r = 0; r < DIM; ++r) part[r] = DIFFERENCE * step[r];
  if (!std::isfinite(trial_cost(moved(at, part), trial.data()))) return false;
  for (int r = 0; r < DIM; ++r)
    for (int c = 0; c < DIM; ++c) along[r] += T[r][c] * step[c];
  Rows H;
  for (size_t k = 0; k < poses.size(); ++k) {
    whitened(k, e, H);
    double second[SEEN];
    for (int i = 0; i < SEEN; ++i) {
      const size_t row = SEEN * k + i;
      second[i] = 2 / DIFFERENCE * ((trial[row] - d[row]) / DIFFERENCE - dot(&J[DIM * row], along, DIM));
    }
    const double w = std::sqrt(weights[k]);
    for (int r = 0; r < SEEN; ++r) {
      double one = 0;
      for (int i = 0; i <= r; ++i) one += w * poses[k].root[r][i] / factors[r >= 3] * second[i];
      for (int c = 0; c < DIM; ++c) g[c] += H[r][c] * one;
    }
  }
  for (int i = 0; i < DIM; ++i)
    for (int r = 0; r < DIM; ++r) a[r] -= 0.5 * T[i][r] * g[i];
  solve<DIM>(M, a);
  for (int r = 0; r < DIM; ++r) {
    sizes[0] += A[r][r] * step[r] * step[r], sizes[1] += A[r][r] * a[r] * a[r];
    step[r] += a[r];
  }
  return sizes[1] <= MOST_BENT * sizes[0];
}

bool Problem::descend(int most, double gain_tol, int& steps) {
  double damping = 1e-3;
  Square A, M;
  double b[DIM], step[DIM];
  std::vector<double> trial(d.size());
  normal(A, b);
  for (int count = 1; count <= most; ++count) {
    std::memcpy(M, A, sizeof M);
    std::memcpy(step, b, sizeof step);
    for (int k = 0; k < DIM; ++k) M[k][k] += damping * A[k][k];
    solve<DIM>(M, step);
    double expected = dot(step, b, DIM);
    for (int r = 0; r < DIM; ++r) expected -= 0.5 * step[r] * dot(A[r], step, DIM);
    const double turning = std::sqrt(dot(at.w.x, at.w.x, 3)), change = std::sqrt(dot(step + 3, step + 3, 3));
    bool tried = change <= LARGEST_RADPS + turning;
    const bool last = std::fabs(expected) < gain_tol && tried;
    if (tried && !last) tried = bent(M, A, step, trial);
    const Chart there = tried ? moved(at, step) : at;
    const double gain = tried ? cost - trial_cost(there, last ? trial.data() : nullptr) : 0;
    ++steps;
    if (last) {  // so short a step that the Jacobian is kept
      if (gain > 0) {
        at = there;
        d.swap(trial);
        reweigh();
      }
      return true;
    }
    if (gain > 0) {
      damping = std::max(damping * (gain > 0.5 * expected ? 0.1 : 0.5), 1e-9);
      linearise(there);
      normal(A, b);
    } else {
      damping *= 8;
    }
    if (damping > 1e9) return true;
  }
  return false;
}

void Problem::absorbed(const Square P, double out[2]) const {
  Square Tt, Pe;
  for (int r = 0; r < DIM; ++r)
    for (int c = 0; c < DIM; ++c) Tt[r][c] = T[c][r];
  congruent(Tt, P, Pe);
  out[0] = out[1] = 0;
  for (size_t k = 0; k < poses.size(); ++k)
    for (int r = 0; r < SEEN; ++r) {
      double row[DIM] = {}, s = 0;
      for (int i = 0; i <= r; ++i)
        for (int c = 0; c < DIM; ++c) row[c] += poses[k].root[r][i] * J[DIM * (SEEN * k + i) + c];
      for (int m = 0; m < DIM; ++m) s += row[m] * dot(Pe[m], row, DIM);
      out[r >= 3] += weights[k] * s;
    }
}

template <int N>
void Problem::smooth(double y[N], double P[N][N], const double into[MOTION][MOTION], const double torque_density[3],
                     double force_density, double since) const {
  const State x = state_of(at);
  double join[3][2], before[6][6] = {}, now[6][6], e[SEEN], H[SEEN][N], t = since;
  Body body = body_of(x, join);
  std::memcpy(body.push, torque_density, sizeof body.push);
  Flow flow = begin(turn_of(x));
  if (since > 0) {
    go(flow, body, x, 0, since, [] {});
    at_start(flow, before);
  }
  double place[MOTION][MOTION] = {}, mixed[MOTION][MOTION] = {}, speed[MOTION][MOTION] = {};
  double turned_by[6][MOTION];  // the transpose of the columns of attitude and rate
  for (int r = 0; r < MOTION; ++r)
    for (int c = 0; c < MOTION; ++c)
      for (int i = 6; i < 9; ++i) {
        place[r][c] += into[r][i] * into[c][i];
        mixed[r][c] += into[r][i] * into[c][i + 3] + into[r][i + 3] * into[c][i];
        speed[r][c] += into[r][i + 3] * into[c][i + 3];
      }
  for (int i = 0; i < 6; ++i)
    for (int r = 0; r < MOTION; ++r) turned_by[i][r] = into[r][i];
  for (size_t k = 0; k < poses.size(); ++k) {
    const double last = t;
    t = poses[k].t;
    go(flow, body, x, last, t, [] {});
    at_start(flow, now);
    const double third = force_density * (t * t * t - last * last * last) / 3;
    const double half = -force_density * (t * t - last * last) / 2, one = force_density * (t - last);
    double Q[MOTION][MOTION];
    for (int r = 0; r < MOTION; ++r) {
      double row[6] = {}, s[MOTION] = {};
      for (int i = 0; i < 6; ++i)
        for (int c = 0; c < 6; ++c) row[c] += into[r][i] * (now[i][c] - before[i][c]);
      for (int i = 0; i < 6; ++i)
        for (int c = 0; c < MOTION; ++c) s[c] += row[i] * turned_by[i][c];
      for (int c = 0; c < MOTION; ++c) Q[r][c] = s[c] + third * place[r][c] + half * mixed[r][c] + one * speed[r][c];
    }
    std::memcpy(before, now, sizeof before);
    in_steps<N>(k, e, H);
    pass<N>(y, P, e, H, Q);
  }
}

template void Problem::smooth<DIM>(double[DIM], Square, const double[MOTION][MOTION], const double[3], double,
                                   double) const;
template void Problem::smooth<DIM + PUSHED>(double[DIM + PUSHED], double[DIM + PUSHED][DIM + PUSHED],
                                            const double[MOTION][MOTION], const double[3], double, double) const;

void Driven::linearise(const Chart& chart, const double u[SEEN]) {
  std::memcpy(push.u, u, sizeof push.u);
  Problem::linearise(chart);
  if (!std::isfinite(cost)) cost = std::numeric_limits<double>::infinity();
  normal();
}

void Driven::normal() {
  std::memset(A, 0, sizeof A);
  double e[SEEN], off[DIM], to_minimum[JOINT];
  double H[SEEN][DIM + PUSHED];
  minus(at, mean, off);
  const double miss = dot(push.row, push.u, SEEN) - push.target;
  for (int r = 0; r < JOINT; ++r)
    b[r] = r < DIM ? -dot(prior_info[r], off, DIM) : -push.info[r - DIM] * push.u[r - DIM] - miss * push.row[r - DIM];
  for (size_t k = 0; k < poses.size(); ++k) {
    in_steps<DIM + PUSHED>(k, e, H);
    for (auto& row : H)
      for (int c = 0; c < SEEN; ++c) row[DIM + c] *= open[c];
    accumulate<JOINT>(H, e, A, b);
  }
  for (int r = 0; r < JOINT; ++r)
    for (int c = r; c < JOINT; ++c) {
      double known = 0;
      if (c < DIM) known = prior_info[r][c];
      else if (r >= DIM) known = push.row[r - DIM] * push.row[c - DIM] + (r == c ? push.info[r - DIM] : 0);
      A[c][r] = A[r][c] += known;
    }
  std::memcpy(to_minimum, b, sizeof b);
  solve<JOINT>(A, to_minimum);
  left = 0.5 * dot(b, to_minimum, JOINT);
}

// Cost and residuals at a part of a step.
double Driven::cost_there(const double step[JOINT], double part, double* residuals) {
  double y[DIM], u[SEEN];
  std::memcpy(u, push.u, sizeof u);
  for (int r = 0; r < DIM; ++r) y[r] = part * step[r];
  for (int r = 0; r < SEEN; ++r) push.u[r] += part * step[DIM + r];
  const double found = trial_cost(moved(at, y), residuals);
  std::memcpy(push.u, u, sizeof u);
  return found;
}

double Driven::step(double damping) {
  constexpr double LESS = 5, MORE = 4, GOOD = 0.5;  // divided, multiplied; least decrease over the expected one
  double M[JOINT][JOINT], step[JOINT], a[JOINT] = {}, sizes[2] = {}, e[SEEN], H[SEEN][DIM + PUSHED];
  std::vector<double> trial(d.size());
  std::memcpy(M, A, sizeof M);
  std::memcpy(step, b, sizeof step);
  for (int r = 0; r < JOINT; ++r) M[r][r] += damping * A[r][r];
  solve<JOINT>(M, step);
  if (std::isfinite(cost_there(step, DIFFERENCE, trial.data()))) {  // as in `bent`
    for (size_t k = 0; k < poses.size(); ++k) {
      in_steps<DIM + PUSHED>(k, e, H);
      const double w = std::sqrt(weights[k]);
      for (int r = 0; r < SEEN; ++r) {
        double probed = 0;
        for (int i = 0; i <= r; ++i) probed += w * poses[k].root[r][i] / factors[r >= 3] * trial[SEEN * k + i];
        const double second = 2 / DIFFERENCE * ((probed - e[r]) / DIFFERENCE - dot(H[r], step, JOINT));
        for (int c = 0; c < JOINT; ++c) a[c] -= 0.5 * H[r][c] * second;
      }
    }
    for (int r = 0; r < SEEN; ++r) a[DIM + r] *= open[r];
    solve<JOINT>(M, a);
    for (int r = 0; r < JOINT; ++r) sizes[0] += A[r][r] * step[r] * step[r], sizes[1] += A[r][r] * a[r] * a[r];
    if (sizes[1] <= MOST_BENT * sizes[0])
      for (int r = 0; r < JOINT; ++r) step[r] += a[r];
  }
  const double gain = cost - cost_there(step, 1, trial.data());
  if (!(gain > 0)) return damping * MORE;
  double expected = dot(step, b, JOINT);
  for (int r = 0; r < JOINT; ++r) expected -= 0.5 * step[r] * dot(A[r], step, JOINT);
  for (int r = 0; r < SEEN; ++r) push.u[r] += step[DIM + r];
  Problem::linearise(moved(at, step));
  normal();
  return gain < GOOD * expected ? damping : damping / LESS;
}

}  // namespace avs
