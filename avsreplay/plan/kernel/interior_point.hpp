// min c1 h + c2 slack so that C x + d lies in a product of second-order cones; a cone of dimension 1 is x >= 0.
#pragma once
#include "stages.hpp"

namespace avs {

struct Answer {
  bool solved = false;
  double h = 0, slack = 0;
  std::vector<std::array<double, 3>> w;
  int iterations = 0;
};

Answer minimise(const Rows& rows, const std::vector<int>& cones, const std::array<double, 2>& cost);

}  // namespace avs
