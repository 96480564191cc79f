// One step of the pose from the sums of a pass. Coordinates are relative to the model's centre.
#pragma once
#include "hot.hpp"

namespace avs {

struct Step {
  double D[12];       // rows of [R t]: the new pose is D T
  double turn, move;  // angle [rad]; how far the inliers' centroid moves [m]
  double length;      // how far an inlier is expected to move at most [m]; not set by `horn_step`
};

// Horn 1987 (equations section 6): M of the cross-covariance, scalar first; its largest eigenvector.
Step horn_step(const Sums& sums);
// One Gauss-Newton step of sum (n . (foot - D p))^2 about the inliers' centroid; false where nothing is observable.
// Directions whose information is below 1e-6 of the largest are left as they are. `longest`: the step is shortened so that
// no inlier is expected to move farther [m].
bool plane_step(const Sums& sums, double longest, Step& step);

// d = [turn; shift] about `centre`; a turn times `radius` is a length. `slope`: derivative of half the cost along -d.
struct Motion {
  double d[6], centre[3], radius, slope;
};
// One Newton step of the sum of squared distances of the inliers, whose stationary points are the fixed points of Horn's
// iteration: the gradient from Horn's moments, the second derivative from each foot's face, edge or vertex. False where
// nothing is observable.
bool newton_motion(const Sums& sums, Motion& motion);
// The motion as a step, shortened to `longest`; false where it is not finite.
bool to_step(Motion motion, double longest, Step& step);
void compose(const double* D, double* T);  // T = D T, both rows of [R t]

}  // namespace avs
