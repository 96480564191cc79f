#include "covariance.hpp"

#include <cmath>
#include <cstring>

namespace avs {
namespace {

// The columns in which a row of Phi may differ from 0: Phi is 1 beside the turn and the translation.
struct Columns {
  int count, at[8];
};

Columns columns_of(int row) {
  if (row < 6) return {8, {0, 1, 2, 3, 4, 5, 12, 13}};
  if (row < MOTION) return {6, {6, 7, 8, 9, 10, 11}};
  return {1, {row}};
}

// P := Phi P Phi' for the transition Phi of error states.
void congruent(const Square Phi, Square P) {
  Square half = {};
  for (int r = 0; r < DIM; ++r) {
    const Columns from = columns_of(r);
    for (int k = 0; k < from.count; ++k)
      for (int c = 0; c < DIM; ++c) half[c][r] += Phi[r][from.at[k]] * P[from.at[k]][c];
  }
  for (int c = 0; c < DIM; ++c) {
    const Columns from = columns_of(c);
    for (int r = 0; r < DIM; ++r) P[c][r] = 0;
    for (int k = 0; k < from.count; ++k)
      for (int r = 0; r < DIM; ++r) P[c][r] += Phi[c][from.at[k]] * half[from.at[k]][r];
  }
}

}  // namespace

bool inverse_root(const double C[SEEN][SEEN], double root[SEEN][SEEN]) {
  double L[SEEN][SEEN] = {};
  std::memset(root, 0, sizeof L);
  if (!cholesky<SEEN>(C, L)) return false;
  for (int c = 0; c < SEEN; ++c) {
    root[c][c] = 1 / L[c][c];
    for (int r = c + 1; r < SEEN; ++r) {
      double s = 0;
      for (int i = c; i < r; ++i) s -= L[r][i] * root[i][c];
      root[r][c] = s / L[r][r];
    }
  }
  return true;
}

bool above(const Square P, double least) {
  double scale[DIM];
  Square scaled, L;
  for (int r = 0; r < DIM; ++r) {
    if (!(P[r][r] > 0) || !std::isfinite(P[r][r])) return false;
    scale[r] = std::sqrt(P[r][r]);
  }
  for (int r = 0; r < DIM; ++r)
    for (int c = 0; c <= r; ++c) scaled[r][c] = P[r][c] / (scale[r] * scale[c]) - (r == c ? least : 0);
  return cholesky<DIM>(scaled, L);
}

void join(const Chart* charts, const Square* P, const double* weights, const double* quadrature, int count, Chart& mean,
          Square moments) {
  std::vector<double> off(DIM * count);
  double shift[DIM] = {};
  for (int k = 0; k < count; ++k) {
    minus(charts[k], charts[0], &off[DIM * k]);
    for (int r = 0; r < DIM; ++r) shift[r] += (weights[k] - quadrature[k]) * off[DIM * k + r];
  }
  std::memset(moments, 0, sizeof(Square));
  for (int k = 0; k < count; ++k) {
    double y[DIM];
    for (int r = 0; r < DIM; ++r) y[r] = off[DIM * k + r] - shift[r];
    for (int r = 0; r < DIM; ++r)
      for (int c = 0; c < DIM; ++c) moments[r][c] += weights[k] * (y[r] * y[c] + P[k][r][c]);
  }
  mean = moved(charts[0], shift);
}

void propagate(State& x, Square P, double h, const double path[6][6], const double torque_density[3],
               double force_density, Square Phi) {
  double join[3][2];
  Body body = body_of(x, join);
  body.tail = 1e-12;
  std::memcpy(body.push, torque_density, sizeof body.push);
  Flow flow = begin(turn_of(x));
  advance(flow, body, h);
  errors_transition(flow, join, path, Phi);
  congruent(Phi, P);
  if (h > 0) {
    for (int r = 0; r < 6; ++r)
      for (int c = 0; c < 6; ++c) P[r][c] += flow.Q[r][c];
    for (int r = 6; r < 9; ++r) {
      P[r][r] += force_density * h * h * h / 3;
      P[r][r + 3] += force_density * h * h / 2;
      P[r + 3][r] += force_density * h * h / 2;
      P[r + 3][r + 3] += force_density * h;
    }
  }
  for (int r = 0; r < DIM; ++r)
    for (int c = 0; c < r; ++c) P[r][c] = P[c][r] = 0.5 * (P[r][c] + P[c][r]);
  translate(x, path);
  std::memcpy(x.q_ab, flow.at.q, sizeof x.q_ab);
  std::memcpy(x.w_b, flow.at.w, sizeof x.w_b);
}

}  // namespace avs
