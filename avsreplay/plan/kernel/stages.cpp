// Stagewise linear algebra: plain sums in a fixed order.
#include "stages.hpp"

#include <cmath>

namespace avs {
namespace {

// v := F' v: from the state after a stage to the variables of the stage.
Entry before(const State& v) {
  Entry out{};
  for (int i = 0; i < 3; ++i) {
    out[i] = v[i];
    out[3 + i] = v[i] + v[3 + i];
    out[STATE + i] = 0.5 * v[i] + v[3 + i];
  }
  out[6] = v[6];
  out[7] = v[7];
  return out;
}

void follow(const Entry& x, Entry& next) {
  for (int i = 0; i < 3; ++i) {
    next[i] = x[i] + x[3 + i] + 0.5 * x[STATE + i];
    next[3 + i] = x[3 + i] + x[STATE + i];
  }
  next[6] = x[6];
  next[7] = x[7];
}

using Small = std::array<std::array<double, 3>, 3>;

void back(const Small& L, double v[3]) {
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < i; ++j) v[i] -= L[i][j] * v[j];
    v[i] /= L[i][i];
  }
  for (int i = 2; i >= 0; --i) {
    for (int j = i + 1; j < 3; ++j) v[i] -= L[j][i] * v[j];
    v[i] /= L[i][i];
  }
}

}  // namespace

void apply(const Rows& rows, const Motion& x, std::vector<double>& out) {
  for (size_t i = 0; i < rows.d.size(); ++i) {
    const Entry &c = rows.C[i], &v = x.at[rows.stage[i]];
    double s = 0;
    for (int j = 0; j < WIDTH; ++j) s += c[j] * v[j];
    out[i] = s;
  }
}

void gather(const Rows& rows, const std::vector<double>& y, std::vector<Entry>& out) {
  for (Entry& e : out) e.fill(0);
  for (size_t i = 0; i < rows.d.size(); ++i) {
    Entry& e = out[rows.stage[i]];
    for (int j = 0; j < WIDTH; ++j) e[j] += rows.C[i][j] * y[i];
  }
}

void reduced(const Rows& rows, const std::vector<Entry>& g, std::vector<std::array<double, 3>>& w,
             std::array<double, 2>& common) {
  State a{};
  for (size_t k = rows.n; k-- > 0;) {
    Entry e = before(a);
    for (int j = 0; j < WIDTH; ++j) e[j] += g[k][j];
    for (int j = 0; j < STATE; ++j) a[j] = e[j];
    for (int j = 0; j < 3; ++j) w[k][j] = e[STATE + j];
  }
  common = {a[6] + rows.start[0] * a[3] + rows.start[1] * a[4] + rows.start[2] * a[5], a[7]};
}

bool Stages::factor(const Rows& rows) {
  std::array<State, STATE> P{};
  for (size_t k = rows.n; k-- > 0;) {
    // M = H + F' P F; the columns of P F first
    Block M;
    std::array<Entry, STATE> PF;
    for (int i = 0; i < STATE; ++i) PF[i] = before(P[i]);  // P is symmetric: row i of P F
    for (int j = 0; j < WIDTH; ++j) {
      State column;
      for (int i = 0; i < STATE; ++i) column[i] = PF[i][j];
      M[j] = before(column);
    }
    for (int i = 0; i < WIDTH; ++i)
      for (int j = 0; j <= i; ++j) M[i][j] += block_[k][i][j];
    Small& L = factor_[k];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j <= i; ++j) {
        double s = M[STATE + i][STATE + j];
        for (int l = 0; l < j; ++l) s -= L[i][l] * L[j][l];
        if (j < i) L[i][j] = s / L[j][j];
        else if (s > 0) L[i][i] = std::sqrt(s);
        else return false;
      }
    for (int j = 0; j < STATE; ++j) {
      double v[3] = {M[STATE][j], M[STATE + 1][j], M[STATE + 2][j]};
      back(L, v);
      for (int i = 0; i < 3; ++i) gain_[k][i][j] = v[i];
    }
    for (int i = 0; i < STATE; ++i)
      for (int j = 0; j <= i; ++j) {
        double s = M[i][j];
        for (int l = 0; l < 3; ++l) s -= M[STATE + l][i] * gain_[k][l][j];
        P[i][j] = P[j][i] = s;
      }
  }
  // the state at the begin is (0, start h, h, slack)
  State row{};
  for (int j = 0; j < STATE; ++j) {
    row[j] = P[6][j];
    for (int i = 0; i < 3; ++i) row[j] += rows.start[i] * P[3 + i][j];
  }
  common_[0][0] = row[6];
  for (int i = 0; i < 3; ++i) common_[0][0] += rows.start[i] * row[3 + i];
  common_[0][1] = common_[1][0] = row[7];
  common_[1][1] = P[7][7];
  return common_[0][0] > 0 && common_[0][0] * common_[1][1] > common_[0][1] * common_[0][1];
}

void Stages::solve(const Rows& rows, const std::vector<Entry>& g, const std::array<double, 2>& common,
                   Motion& x) const {
  State p{};
  for (size_t k = rows.n; k-- > 0;) {
    Entry m = before(p);
    for (int j = 0; j < WIDTH; ++j) m[j] += g[k][j];
    double v[3] = {m[STATE], m[STATE + 1], m[STATE + 2]};
    for (int j = 0; j < STATE; ++j) {
      p[j] = m[j];
      for (int l = 0; l < 3; ++l) p[j] -= gain_[k][l][j] * v[l];
    }
    back(factor_[k], v);
    for (int i = 0; i < 3; ++i) x.at[k][STATE + i] = v[i];
  }
  double first = p[6] + common[0], second = p[7] + common[1];
  for (int i = 0; i < 3; ++i) first += rows.start[i] * p[3 + i];
  const double ratio = common_[1][0] / common_[0][0];
  Entry& begin = x.at[0];
  begin[7] = (second - ratio * first) / (common_[1][1] - ratio * common_[0][1]);
  begin[6] = (first - common_[0][1] * begin[7]) / common_[0][0];
  for (int i = 0; i < 3; ++i) {
    begin[i] = 0;
    begin[3 + i] = rows.start[i] * begin[6];
  }
  for (size_t k = 0; k < rows.n; ++k) {
    Entry& e = x.at[k];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < STATE; ++j) e[STATE + i] -= gain_[k][i][j] * e[j];
    if (k + 1 < rows.n) follow(e, x.at[k + 1]);
  }
}

}  // namespace avs
