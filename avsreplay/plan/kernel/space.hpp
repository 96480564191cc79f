// The target as a withdrawal sees it, and the margins of manoeuvres of constant acceleration.
#pragma once
#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "body.hpp"
#include "vector.hpp"

namespace avs {

// A manoeuvre for a range of start instants t - half .. t + half; the fields are those of ``Manoeuvres``
// (withdrawal.py), in its order.
struct Manoeuvre {
  double t, half;
  Vector3 r, v, push;
  double span, other, most;
};
static_assert(sizeof(Manoeuvre) == 14 * sizeof(double));

struct SpaceParams {
  double clearance, sigmas;               // required distance to the surface, and standard deviations added to it
  Vector3 axis;                           // of the corridor in {C}
  double tangent, mouth, reach;           // of the corridor; NaN: none
  Vector3 centre;                         // centre of mass in {C}
  double radius;                          // of the sphere about it that contains the target; 0: unknown
  double enough, slope, turn, bend, pull; // see ``Space`` in withdrawal.py
  double a_max, coast, kept_share;
};

struct Margin {
  double value, required;
};
struct Least {
  double lower, upper, at;
  Near near{};  // about the point at that time
};

class Space {
 public:
  Space(const Body* body, const SpaceParams& params) : body_(body), of_(params) {}

  // Pieces (4, n, 12) of position and rotation of {C}, highest power first, between n + 1 instants.
  void set_motion(const double* c, const double* x, size_t n);
  // Predicted 1 sigma of position and attitude (n,) at equally spaced instants from 0 to ``end``.
  void set_sigma(double end, const double* position, const double* attitude, size_t n);

  // Margin of a point, and the required distance. A margin of ``below`` or more may be replaced by a lower bound that is
  // no smaller than that.
  Margin margin(const Vector3& y, double time, double most, Near& last, double below = HUGE_VAL) const;
  // Gradient in {C} of the margin at a point.
  Vector3 gradient(const Vector3& y, double time, double most, Near& last) const;
  // Largest distance to the surface that is required of manoeuvres from a point.
  double most(double time, const Vector3& r, Near& last) const;
  // Duration of an escape until the robot recedes outside the sphere; ``m.span`` is the longest one.
  double ended(const Manoeuvre& m) const;
  // Longest duration of an escape from a state.
  double span(double time, const Vector3& r, const Vector3& v) const;
  // Margins at instants tau (n,) of a manoeuvre; those above ``below`` may be lower bounds.
  void margins(const Manoeuvre& m, const double* tau, size_t n, double below, Near& first, double* out) const;
  // Bounds of the smallest margin of a manoeuvre; where ``target`` is proven nothing is refined.
  Least least(const Manoeuvre& m, double target, Near& first) const;
  // Improve the direction d of an escape until its margin, which is returned, is ``wanted``. Without a known direction
  // (NaN) and where the margin is negative all directions are compared.
  double search(double time, const Vector3& r, const Vector3& v, double wanted, Vector3& d) const;

 private:
  struct Frame {
    Vector3 rho, drho;
    Matrix3 R, dR;
  };
  struct Node {
    double tau, margin, required, speed, bend;
    Near near;
  };
  void motion(double time, Frame& out, bool rates) const;
  Vector3 local(double time, const Vector3& r) const;
  double bend(const Vector3& q, const Vector3& w, double thrust) const;
  double required(double distance, double time) const;
  double corridor(const Vector3& y) const;
  void relative(double time, const Vector3& r, const Vector3& v, Vector3& q, Vector3& w) const;
  Node node(const Manoeuvre& m, double tau, const Near& last, const Near& other) const;
  bool recedes(const Manoeuvre& m, double tau) const;
  Least bounded(const Manoeuvre& m, double target, double more, Near& first) const;
  Least compared(const Manoeuvre& m, double floor, const Near& first) const;
  Vector3 gradient(const Manoeuvre& m, double tau, Near& last) const;
  void improve(Manoeuvre& m, double wanted, Vector3& d, Least& best, const Near& first) const;

  const Body* body_;
  SpaceParams of_;
  std::vector<double> pieces_, x_, position_, attitude_;
  size_t n_ = 0;
  double sigma_step_ = 0;
};

}  // namespace avs
