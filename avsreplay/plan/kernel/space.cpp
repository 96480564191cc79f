#include "space.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace avs {
namespace {

constexpr double RADIAN = 3.14159265358979323846 / 180;
constexpr int COMPARED = 32;    // instants at which the directions of an escape are compared
constexpr double DENSER = 1.3;  // power of the share of its duration: they are denser at the begin
constexpr int INTERVALS = 7;    // intervals of a manoeuvre at the begin; the first one is before it
constexpr int HALVINGS = 15;    // largest number of halvings of one of them
constexpr int SIDES = 6;        // directions around another one
constexpr std::array<double, 3> TILTS{20 * RADIAN, 40 * RADIAN, 60 * RADIAN};   // of directions around the fixture's axis
constexpr int REFINED = 3;             // halvings of the time beside the smallest margin of those instants
constexpr int TURNS = 8;               // largest number of turns that improve a direction
constexpr double LARGEST_TURN = 0.5;   // of a direction [rad]
constexpr double SMALLEST_SHARE = 0.02; // of a turn that is tried
constexpr double MOTION_FACTOR = 1.5;  // see path.py

Vector3 unit(const Vector3& a) { return (1 / std::max(norm(a), 1e-9)) * a; }

// Six directions around d, tilted by an angle.
std::array<Vector3, SIDES> tilted(const Vector3& d, double angle) {
  const size_t least = static_cast<size_t>(
      std::min_element(d.begin(), d.end(), [](double a, double b) { return std::abs(a) < std::abs(b); }) - d.begin());
  Vector3 e{};
  e[least] = 1;
  const Vector3 side = unit(cross(d, e)), other = cross(d, side);
  std::array<Vector3, SIDES> out;
  for (int k = 0; k < SIDES; ++k) {
    const double at = k * 60 * RADIAN;
    out[static_cast<size_t>(k)] =
        std::cos(angle) * d + std::sin(angle) * (std::cos(at) * side + std::sin(at) * other);
  }
  return out;
}

// Directions that are compared where none is known: outward, towards faces and corners of a cube, along the fixture's
// axis and around it.
std::vector<Vector3> directions(const Vector3& outward, const Vector3& along) {
  std::vector<Vector3> out{outward};
  for (int x = -1; x <= 1; ++x)
    for (int y = -1; y <= 1; ++y)
      for (int z = -1; z <= 1; ++z)
        if (const int count = std::abs(x) + std::abs(y) + std::abs(z); count == 1 || count == 3)
          out.push_back(unit({double(x), double(y), double(z)}));
  out.push_back(along);
  for (double angle : TILTS)
    for (const Vector3& d : tilted(along, angle)) out.push_back(d);
  return out;
}

Vector3 position(const Manoeuvre& m, double tau) { return m.r + tau * m.v + (0.5 * tau * tau) * m.push; }

}  // namespace

void Space::set_motion(const double* c, const double* x, size_t n) {
  n_ = n;
  x_.assign(x, x + n + 1);
  pieces_.resize(n * 48);
  for (size_t k = 0; k < n; ++k)
    for (size_t power = 0; power < 4; ++power)
      std::copy_n(c + (power * n + k) * 12, 12, pieces_.data() + k * 48 + power * 12);
}

void Space::set_sigma(double end, const double* position, const double* attitude, size_t n) {
  position_.assign(position, position + n);
  attitude_.assign(attitude, attitude + n);
  sigma_step_ = end / static_cast<double>(n - 1);
}

void Space::motion(double time, Frame& out, bool rates) const {
  const double guess = (time - x_[0]) / (x_[n_] - x_[0]) * static_cast<double>(n_);
  size_t k = guess > 0 ? std::min(static_cast<size_t>(guess), n_ - 1) : 0;
  while (k > 0 && time < x_[k]) --k;
  while (k + 1 < n_ && time >= x_[k + 1]) ++k;
  const double s = time - x_[k], s2 = s * s, s3 = s2 * s;
  const double *c3 = pieces_.data() + k * 48, *c2 = c3 + 12, *c1 = c2 + 12, *c0 = c1 + 12;
  std::array<double, 12> values;
  const auto spread = [&](Vector3& first, Matrix3& rest) {
    for (size_t i = 0; i < 3; ++i) {
      first[i] = values[i];
      for (size_t j = 0; j < 3; ++j) rest[i][j] = values[3 + 3 * i + j];
    }
  };
  for (size_t j = 0; j < 12; ++j) values[j] = c0[j] + c1[j] * s + c2[j] * s2 + c3[j] * s3;
  spread(out.rho, out.R);
  if (!rates) return;
  for (size_t j = 0; j < 12; ++j) values[j] = c1[j] + c2[j] * s * 2 + c3[j] * s2 * 3;
  spread(out.drho, out.dR);
}

Vector3 Space::local(double time, const Vector3& r) const {
  Frame frame;
  motion(time, frame, false);
  return transposed(frame.R, r - frame.rho);
}

double Space::required(double distance, double time) const {
  if (position_.empty()) return of_.clearance;
  const double at = std::clamp(time / sigma_step_, 0.0, static_cast<double>(position_.size() - 1));
  const size_t k = std::min(static_cast<size_t>(at), position_.size() - 2);
  const double share = at - static_cast<double>(k);
  const auto between = [&](const std::vector<double>& of) { return of[k] + share * (of[k + 1] - of[k]); };
  return of_.clearance + of_.sigmas * (between(position_) + between(attitude_) * distance);
}

// Margin inside the corridor, to its side and its end.
double Space::corridor(const Vector3& y) const {
  if (std::isnan(of_.tangent)) return -INFINITE;
  const double along = dot(y, of_.axis), across = norm(y - along * of_.axis);
  return std::min(of_.tangent * along + of_.mouth - across, of_.reach - norm(y));
}

Margin Space::margin(const Vector3& y, double time, double most, Near& last, double below) const {
  const double required = std::min(this->required(norm(y), time), most), inside = corridor(y);
  double gap = norm(y - of_.centre) - of_.radius;
  const bool unknown = body_ && (gap - required < std::min(of_.enough, below) || of_.radius == 0) && inside < below;
  if (unknown) gap = body_->at_least(y, below + required, last);
  return {std::max(gap - required, inside), required};
}

// Bound of the acceleration in the axes of {C} at a position and velocity relative to the grasp point.
double Space::bend(const Vector3& q, const Vector3& w, double thrust) const {
  return thrust + of_.pull + 2 * of_.turn * norm(w) + (of_.turn * of_.turn + of_.bend) * norm(q);
}

double Space::most(double time, const Vector3& r, Near& last) const {
  const Vector3 y = local(time, r);
  if (!(corridor(y) > 0)) return INFINITE;
  const double gap = body_ ? body_->signed_distance(y, last) : norm(y - of_.centre) - of_.radius;
  return of_.kept_share * std::max(gap, 0.0);
}

void Space::relative(double time, const Vector3& r, const Vector3& v, Vector3& q, Vector3& w) const {
  Frame frame;
  motion(time, frame, true);
  q = r - frame.rho - times(frame.R, of_.centre);
  w = v - frame.drho - times(frame.dR, of_.centre);
}

double Space::span(double time, const Vector3& r, const Vector3& v) const {
  if (of_.radius == 0) return of_.coast;
  Vector3 q, w;
  relative(time, r, v, q, w);
  const double speed2 = dot(w, w), far = 2 * (of_.radius + of_.clearance + of_.enough);
  return (std::sqrt(speed2) + std::sqrt(2 * speed2 + 4 * of_.a_max * far)) / of_.a_max;
}

// From then on the distance to the centre of mass grows, under the same acceleration and in the brake that follows.
bool Space::recedes(const Manoeuvre& m, double tau) const {
  Vector3 q, w;
  relative(m.t + tau, position(m, tau), m.v + tau * m.push, q, w);
  const double dv = m.half * m.other, dr = dv * (std::abs(tau) + m.half), a = norm(m.push), distance = norm(q);
  const double needed = std::min(required(distance, m.t + tau), m.most) + of_.enough;
  return distance - dr >= of_.radius + needed && dot(q, w) >= distance * dv + norm(w) * dr && dot(w, m.push) >= a * dv &&
         dot(q, m.push) >= a * dr;
}

double Space::ended(const Manoeuvre& m) const {
  if (of_.radius == 0) return m.span;
  for (int i = 1; i <= COMPARED; ++i) {
    const double tau = m.span * i / COMPARED;
    if (recedes(m, tau)) return tau;
  }
  return m.span;
}

void Space::margins(const Manoeuvre& m, const double* tau, size_t n, double below, Near& first, double* out) const {
  Near last = first;
  for (size_t i = 0; i < n; ++i) {
    const double time = m.t + tau[i];
    out[i] = margin(local(time, position(m, tau[i])), time, m.most, last, below).value;
    if (i == 0) first = last;
  }
}

Space::Node Space::node(const Manoeuvre& m, double tau, const Near& a, const Near& b) const {
  Frame frame;
  motion(m.t + tau, frame, true);
  const Vector3 q = position(m, tau) - frame.rho, w = m.v + tau * m.push - frame.drho;
  const Vector3 y = transposed(frame.R, q);
  Near last = body_ ? body_->nearer(y, a, b) : a;
  const Margin found = margin(y, m.t + tau, m.most, last);
  return {tau, found.value, found.required, norm(transposed(frame.R, w) + transposed(frame.dR, q)),
          bend(q, w, norm(m.push)), last};
}

// What is required differs over the range of start instants: the distance in the corridor by the way of the path, and
// outside it all is required.
Least Space::least(const Manoeuvre& m, double target, Near& first) const {
  if (m.half == 0 || m.most == INFINITE) return bounded(m, target, 0, first);
  Frame frame;
  motion(m.t, frame, true);
  const Vector3 q = m.r - frame.rho, w = m.v - frame.drho;
  const double speed = norm(transposed(frame.R, w) + transposed(frame.dR, q));
  const double way = m.half * (speed + 0.5 * MOTION_FACTOR * m.half * bend(q, w, of_.a_max));
  Least found = bounded(m, target, of_.kept_share * way, first);
  if (corridor(transposed(frame.R, q)) <= of_.slope * way) {
    Manoeuvre outside = m;
    outside.most = INFINITE;
    found.lower = std::min(found.lower, bounded(outside, target, 0, first).lower);
  }
  return found;
}

// Bounds for one requirement that is larger by at most ``more``.
Least Space::bounded(const Manoeuvre& m, double target, double more, Near& first) const {
  struct Interval {
    Node a, b;
    int halvings;
  };
  std::array<Node, INTERVALS + 1> nodes;
  std::array<Interval, INTERVALS + HALVINGS + 1> stack;
  Least found{INFINITE, INFINITE, 0};
  // before the begin of the manoeuvre are those that begin earlier, of which only a bound is known
  const auto seen = [&](const Node& node) {
    if (node.tau >= 0 && node.margin < found.upper) {
      found.upper = node.margin;
      found.at = node.tau;
    }
  };
  for (size_t i = 0; i <= INTERVALS; ++i) {
    const Near& last = i ? nodes[i - 1].near : first;
    nodes[i] = node(m, i ? m.span * static_cast<double>(i - 1) / (INTERVALS - 1) : -m.half, last, last);
    seen(nodes[i]);
  }
  first = nodes[0].near;
  size_t depth = 0;
  for (size_t i = INTERVALS; i-- > 0;) stack[depth++] = {nodes[i], nodes[i + 1], 0};
  while (depth) {
    const Interval of = stack[--depth];
    const Node &a = of.a, &b = of.b;
    const double h = b.tau - a.tau;
    const double length = 0.5 * h * (a.speed + b.speed) + 0.25 * MOTION_FACTOR * h * h * std::max(a.bend, b.bend);
    const double strayed = of_.slope * m.half * m.other * (std::max(std::abs(a.tau), std::abs(b.tau)) + m.half) + more;
    const double bound =
        0.5 * (a.margin + b.margin - of_.slope * length - std::abs(a.required - b.required)) - strayed;
    // a smaller range of start instants is needed where the range takes too much
    const bool helps = std::min(a.margin, b.margin) - strayed >= target && found.upper >= target;
    if (bound >= target || of.halvings == HALVINGS || !helps) {
      found.lower = std::min(found.lower, bound);
      continue;
    }
    const Node middle = node(m, 0.5 * (a.tau + b.tau), a.near, b.near);
    seen(middle);
    stack[depth++] = {middle, b, of.halvings + 1};
    stack[depth++] = {a, middle, of.halvings + 1};
  }
  found.lower = std::min(found.lower, found.upper);
  return found;
}

// About the smallest margin of a manoeuvre after its begin, at most ``enough``, and its time; at most ``floor`` where it
// is not larger.
Least Space::compared(const Manoeuvre& m, double floor, const Near& first) const {
  static const std::array<double, COMPARED> shares = [] {
    std::array<double, COMPARED> out{};
    for (size_t i = 0; i < COMPARED; ++i) out[i] = std::pow(static_cast<double>(i + 1) / COMPARED, DENSER);
    return out;
  }();
  Near last = first;
  Least found{-INFINITE, of_.enough, m.span};
  size_t least = 0;
  const auto see = [&](double tau) {
    const double time = m.t + tau;
    const double value = margin(local(time, position(m, tau)), time, m.most, last, found.upper).value;
    const bool smaller = value < found.upper;
    if (smaller) found = {-INFINITE, value, tau, last};
    return smaller;
  };
  for (size_t i = 0; i < COMPARED && found.upper > floor; ++i)
    if (see(m.span * shares[i])) least = i;
  // between the instants beside the smallest margin
  double step = 0.5 * m.span * (shares[std::min<size_t>(least + 1, COMPARED - 1)] - shares[least]);
  for (int i = 0; i < REFINED && found.upper > floor && found.upper < of_.enough; ++i, step *= 0.5)
    for (double side : {-step, step}) see(std::clamp(found.at + side, 0.0, m.span));
  return found;
}

// Gradient in {A} of the margin at an instant of a manoeuvre.
Vector3 Space::gradient(const Manoeuvre& m, double tau, Near& last) const {
  Frame frame;
  motion(m.t + tau, frame, false);
  const Vector3 y = transposed(frame.R, position(m, tau) - frame.rho);
  return times(frame.R, gradient(y, m.t + tau, m.most, last));
}

Vector3 Space::gradient(const Vector3& y, double time, double most, Near& last) const {
  const double required = std::min(this->required(norm(y), time), most);
  Vector3 away = y - of_.centre;
  double gap = norm(away) - of_.radius;
  if (body_ && (gap - required < of_.enough || of_.radius == 0)) {
    Vector3 foot;
    gap = body_->signed_distance(y, last, &foot);
    away = gap < 0 ? foot - y : y - foot;
  }
  if (corridor(y) <= gap - required) return unit(away);
  const double along = dot(y, of_.axis), across = norm(y - along * of_.axis);
  if (of_.tangent * along + of_.mouth - across > of_.reach - norm(y)) return -1.0 * unit(y);
  return of_.tangent * of_.axis - unit(y - along * of_.axis);
}

// Turn the direction so that the margin at the worst instant grows to what is wanted, or by a part of that turn; several
// times, as then another instant is the worst.
void Space::improve(Manoeuvre& m, double wanted, Vector3& d, Least& best, const Near& first) const {
  double share = 1;
  for (int turn = 0; turn < TURNS && best.upper < wanted && share > SMALLEST_SHARE; ++turn) {
    m.push = of_.a_max * d;
    const Vector3 slope = gradient(m, best.at, best.near), across = slope - dot(slope, d) * d;
    // the position at the instant changes by a tau^2 / 2 times the change of the direction
    const double rate = 0.5 * of_.a_max * best.at * best.at * dot(across, across);
    if (!(rate > 0)) return;
    const double size = std::min((wanted - best.upper) / rate, LARGEST_TURN / norm(across));
    const Vector3 other = unit(d + (share * size) * across);
    m.push = of_.a_max * other;
    const Least found = compared(m, best.upper, first);
    if (found.upper > best.upper) {
      best = found;
      d = other;
      share = std::min(2 * share, 1.0);
    } else {
      share *= 0.3;
    }
  }
}

double Space::search(double time, const Vector3& r, const Vector3& v, double wanted, Vector3& d) const {
  Near first;
  Manoeuvre m{time, 0, r, v, {}, span(time, r, v), 0, most(time, r, first)};
  wanted = std::min(wanted, of_.enough);
  Vector3 q, w;
  relative(time, r, v, q, w);
  Frame frame;
  motion(time, frame, false);
  if (body_ && !first.known) body_->signed_distance(transposed(frame.R, r - frame.rho), first);
  const Vector3 outward = unit(q), along = std::isnan(of_.tangent) ? outward : times(frame.R, of_.axis);
  Least best{-INFINITE, -INFINITE, 0};
  const auto compare = [&](const std::vector<Vector3>& every) {
    bool better = false;
    for (const Vector3& other : every) {
      m.push = of_.a_max * other;
      const Least found = compared(m, best.upper, first);
      if (found.upper > best.upper) {
        best = found;
        d = other;
        better = true;
      }
    }
    if (better) improve(m, wanted, d, best, first);
  };
  if (!std::isnan(d[0])) compare({Vector3(d)});
  if (best.upper < std::min(wanted, 0.0)) compare(directions(outward, along));
  return best.upper;
}

}  // namespace avs
