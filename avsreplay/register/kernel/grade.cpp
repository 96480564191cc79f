#include "grade.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace avs {
namespace {

constexpr double BEYOND = 9.0 * 6;           // squared step in standard deviations: three of each of six

// The mean of J'J with rotations about the centre, in units of the rms radius.
Six scaled_information(const Six& total, int64_t count, const double (&centre)[3]) {
  const double *c = centre, skew[3][3] = {{0, -c[2], c[1]}, {c[2], 0, -c[0]}, {-c[1], c[0], 0}};
  Six shift, half, mean;
  for (int i = 0; i < 6; ++i) shift.v[i][i] = 1;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) shift.v[3 + i][j] = skew[i][j];
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j)
      for (int k = 0; k < 6; ++k) half.v[i][j] += total.v[i][k] * shift.v[k][j];
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) {
      for (int k = 0; k < 6; ++k) mean.v[i][j] += shift.v[k][i] * half.v[k][j];
      mean.v[i][j] /= (double)count;
    }
  const double radius = std::sqrt(std::max(mean.v[0][0] + mean.v[1][1] + mean.v[2][2], 0.0));
  const double scale = 1 / std::max(radius, std::numeric_limits<double>::min());
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) mean.v[i][j] *= (i < 3 ? scale : 1) * (j < 3 ? scale : 1);
  return mean;
}

bool is_observable(const Six& total, int64_t count, const double (&centre)[3], double least) {
  Six A = scaled_information(total, count, centre), V;
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < i; ++j) A.v[i][j] = A.v[j][i] = 0.5 * (A.v[i][j] + A.v[j][i]);
  eigen(A.v, V.v, 6, 1e-32);
  for (int k = 0; k < 6; ++k)
    if (!(A.v[k][k] >= least)) return false;
  return true;
}

double form(const Six& A, const double (&x)[6]) {
  double sum = 0;
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) sum += x[i] * A.v[i][j] * x[j];
  return sum;
}

// The sum of the gradients, and the Gauss-Newton step of it.
void step_of(const PatchArrays& sums, const Six& inverse, double (&gradient)[6], double (&step)[6]) {
  for (int i = 0; i < 6; ++i) gradient[i] = step[i] = 0;
  for (int64_t p = 0; p < sums.size(); ++p)
    for (int i = 0; i < 6; ++i) gradient[i] += sums.gradients[(size_t)(6 * p + i)];
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) step[i] += inverse.v[i][j] * gradient[j];
}

// The covariance of the pose with what is uncertain of the bias of the noise.
Six with_noise(const Grade& found) {
  Six P = found.covariance.P;
  for (size_t i = 0; i < 6; ++i)
    for (size_t j = 0; j < 6; ++j)
      P.v[i][j] += found.chance.v[i][j] + found.bias[i] * found.bias[j] + found.left[i] * found.left[j];
  return P;
}

double length(const double* x) { return std::sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]); }

// Whether the standard deviations are below the extent, and those of rotations below 1 rad, as their sum of squares tells.
bool is_bounded(const Six& P, double extent) {
  double trace = 0;
  for (int i = 0; i < 6; ++i) trace += P.v[i][i] * (i < 3 ? 1 : 1 / (extent * extent));
  return trace < 1;
}

// Covariance, test of halves and error of size.
void measure(const PatchArrays& sums, const Inverted& all, const GradeRule& rule, const std::array<double, 3>& camera, Grade& out) {
  const int64_t directions = (int64_t)rule.across.size() / 3;
  const double* c = out.centre;
  PatchTable table{sums.size(), sums.normals.data(), sums.gradients.data(), sums.offsets.data(), sums.errors.data(),
                   sums.places.data(), sums.counts.data(), {c[0], c[1], c[2]}, rule.extent, rule.patches.side,
                   {camera[0], camera[1], camera[2]}, {}};
  complete(table, all);
  Systematic errors;
  std::vector<double> left;
  if (rule.systematic || directions) errors = systematic_errors(table), left = unexplained(table, errors);
  out.covariance = rule.systematic ? covariance(table, errors, left) : sandwich(table.normals, table.gradients, table.m, all.root);
  if (rule.systematic) out.size = size_error(table);
  const bool single = std::all_of(sums.counts.begin(), sums.counts.end(), [](int64_t n) { return n == 1; });
  if (directions && !single) out.split = split(table, errors, left, rule.across.data(), directions);
}

// Leaves the entries of the patches that are kept.
template <class T>
void only(const std::vector<uint8_t>& keep, std::vector<T>& x) {
  const size_t each = x.size() / keep.size();
  size_t to = 0;
  for (size_t k = 0; k < keep.size(); ++k)
    if (keep[k]) std::copy(x.begin() + (int64_t)(each * k), x.begin() + (int64_t)(each * (k + 1)), x.begin() + (int64_t)(each * to++));
  x.resize(each * to);
}

}  // namespace

PatchArrays::PatchArrays(const std::vector<PatchSums>& patches) {
  const size_t m = patches.size();
  normals.resize(36 * m), gradients.resize(6 * m), offsets.resize(6 * m), errors.resize(m), places.resize(3 * m), counts.resize(m), number.resize(m);
  for (size_t k = 0; k < m; ++k) {
    const PatchSums& from = patches[k];
    for (size_t r = 0; r < 6; ++r) {
      std::copy(from.rows[r], from.rows[r] + 6, normals.data() + 36 * k + 6 * r);
      gradients[6 * k + r] = from.rows[r][6], offsets[6 * k + r] = from.rows[r][7];
    }
    for (size_t a = 0; a < 3; ++a) places[3 * k + a] = from.last[a] / (double)from.points;
    errors[k] = from.last[3], counts[k] = from.points, number[k] = (int64_t)k;
  }
}

void PatchArrays::without(const std::vector<std::array<double, 7>>& expected) {
  for (size_t p = 0; p < counts.size(); ++p) {
    const std::array<double, 7>& mean = expected[(size_t)number[p]];
    for (size_t i = 0; i < 6; ++i) gradients[6 * p + i] -= mean[i];
    errors[p] -= mean[6];
  }
}

bool PatchArrays::drop(const Inverted& all) {
  std::vector<uint8_t> keep(counts.size(), 1);
  drop_dominant(normals.data(), counts.data(), size(), all, keep.data());
  if (std::find(keep.begin(), keep.end(), 0) == keep.end()) return false;
  for (std::vector<double>* each : {&normals, &gradients, &offsets, &errors, &places}) only(keep, *each);
  only(keep, counts), only(keep, number);
  return true;
}

Grade grade(const Store& s, const Code& code, const View& v, const double* T, const GradeRule& rule, Team& team,
            const Matches* matches) {
  PatchRule patches = rule.patches;
  patches.facing = patches.facing && faces_camera(s, code, v, T, rule.tested, rule.least_facing);
  const Matcher matcher(s, code, v, T, patches, matches);
  const NoiseRule& simulated = rule.simulated;
  const int64_t stride = simulated.numbers.empty() ? 0 : std::min(std::max(simulated.least, v.n / simulated.many), simulated.most);
  const Evidence e = evidence(matcher, code, v, patches, team, stride);
  const double nan = std::numeric_limits<double>::quiet_NaN();
  Grade out;
  out.points = e.points, out.inliers = e.inliers, out.split = nan;
  out.rms = e.inliers ? std::sqrt(e.sum_d2 / (double)e.inliers) : nan;
  out.noise = rule.noise > 0 ? rule.noise : std::max(SIGMA_PER_MEDIAN * e.median, rule.noise_floor);
  std::copy(e.centre, e.centre + 3, out.centre);
  out.overlap = (double)e.inliers >= std::max(rule.least_inliers, rule.least_ratio * (double)e.points);
  PatchArrays sums(e.patches);
  out.total = total(sums.normals.data(), sums.size());
  Inverted all = inverted(out.total);
  const Inverted whole_scan = all;
  double gradient[6] = {}, step[6] = {};
  step_of(sums, whole_scan.inverse, gradient, step);
  for (int i = 0; i < 6; ++i) out.statistic += step[i] * gradient[i];
  out.statistic /= out.noise * out.noise;
  if (out.overlap && sums.drop(all)) all = inverted(out.total = total(sums.normals.data(), sums.size()));
  for (const int64_t count : sums.counts) out.used += count;
  if (!out.overlap) return out;
  const bool close = (double)e.inliers >= rule.least_close * (double)e.points;
  out.well_off = close ? count_beyond(s, code, v, T, patches.facing, rule.beyond, rule.part, e.off) : (int64_t)e.off.size();
  out.observable = is_observable(out.total, out.used, out.centre, rule.least_information);
  if (out.observable && stride > 0 && patches.facing) {  // by the points alone that can be of their faces
    patches.noise = out.noise;
    PatchArrays sure(evidence(matcher, code, v, patches, team, 0).patches);
    const Six information = total(sure.normals.data(), sure.size());
    const int64_t used = std::accumulate(sure.counts.begin(), sure.counts.end(), (int64_t)0);
    out.observable = used > 0 && is_observable(information, used, out.centre, rule.least_information);
    if (!out.observable) sums = std::move(sure), out.total = information, out.used = used;
  }
  if (!out.observable) {
    out.patches = std::move(sums);
    return out;
  }
  out.measured = true;
  const NoiseEffect noise = noise_effect(s, code, matcher.look(), e, patches.side, whole_scan, out.noise, simulated);
  if (!noise.patches.empty()) {
    std::copy(noise.bias, noise.bias + 6, out.bias.begin());
    std::copy(noise.left, noise.left + 6, out.left.begin());
    out.chance = noise.chance;
    PatchArrays whole(e.patches);
    whole.without(noise.patches), sums.without(noise.patches);
    step_of(whole, whole_scan.inverse, gradient, step);
  }
  std::array<double, 3> camera{nan, nan, nan};
  if (patches.facing) camera = {T[3], T[7], T[11]};
  measure(sums, all, rule, camera, out);
  out.bounded = is_bounded(out.covariance.P, rule.extent);
  const bool large = length(step) > rule.turn || length(step + 3) > rule.move;
  out.beyond = large && form(pseudo_inverse(with_noise(out)), step) > BEYOND;
  return out;
}

}  // namespace avs
