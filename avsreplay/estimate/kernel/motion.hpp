// Rotation in the inertia ratios (eq:dot_omega, Eq:F), free or under a constant torque: attitude, rate, their derivatives
// and their noise.
#pragma once
#include <vector>

namespace avs {

// A body: sigma1..3, the variance its rate gets from the disturbance torque [rad2/s3], by axis of {B}, the largest
// relative error of derivatives and noise in a piece of the flow (the state itself is always exact to 1e-12), and the
// angular acceleration in {B} by a constant torque [rad/s2]; `driven`: the derivative by it is computed.
struct Body {
  double sigma[3];
  double push[3];
  double tail = 1e-12;
  double drive[3] = {0, 0, 0};
  bool driven = false;
};

// Attitude [x y z w] of {B} and rate in {B} [rad/s].
struct Turn {
  double q[4];
  double w[3];
};

// A turn, the derivative S of (dq_v, w) by (dq_v, w, sigma1..3) at the start, the covariance Q the torque has added, and
// the derivative D of (dq_v, w) by the angular acceleration in {B} since the start of the drive, without such noise.
struct Flow {
  Turn at;
  double S[6][9];
  double Q[6][6];
  double D[6][3];
};

// The flow over no time.
Flow begin(const Turn& at);

// On by h seconds, of either sign, cut where more than SUBSTEP rad are turned; noise grows with |h|.
void advance(Turn& at, const Body& body, double h);
void advance(Flow& flow, const Body& body, double h);

constexpr double SUBSTEP = 0.2;  // rad

// Any instant of one motion. Knots are laid down SUBSTEP apart as far as they have been asked for.
class Path {
 public:
  Path(const Turn& start, const Body& body);
  Turn at(double t);

 private:
  Body body_;
  double spacing_;  // s
  std::vector<Turn> knots_;
};

}  // namespace avs
