// Rows of a programme whose variables form stages, and the linear systems of its interior-point method.
//
// At stage k the variables are (r, q, h, slack | w): position, velocity, two numbers common to all stages, and the
// thrust that leads to stage k + 1,
//     r' = r + q + w / 2,   q' = q + w.
// The motion begins at r = 0, q = start h. Free are w of every stage, h and slack. A row belongs to one stage:
//     s = C (r, q, h, slack, w) + d.
#pragma once
#include <array>
#include <cstddef>
#include <vector>

namespace avs {

constexpr int STATE = 8;           // r, q, h, slack
constexpr int WIDTH = STATE + 3;   // and w
using Entry = std::array<double, WIDTH>;
using State = std::array<double, STATE>;

struct Rows {
  size_t n;                     // stages
  std::array<double, 3> start;  // q at the begin for h = 1
  std::vector<int> stage;       // of each row
  std::vector<Entry> C;
  std::vector<double> d;
};

// Variables of all stages: what is free, and the states that follow.
struct Motion {
  std::vector<Entry> at;
  explicit Motion(size_t n) : at(n) {}
};

// out := C x, without d.
void apply(const Rows& rows, const Motion& x, std::vector<double>& out);

// out := C' y, as one entry per stage.
void gather(const Rows& rows, const std::vector<double>& y, std::vector<Entry>& out);

// Gradient by the free variables (w of every stage; h and slack in ``common``) of entries per stage.
void reduced(const Rows& rows, const std::vector<Entry>& g, std::vector<std::array<double, 3>>& w,
             std::array<double, 2>& common);

// Riccati recursion for min 1/2 x' H x - g' x with one symmetric block H per stage (lower triangle).
class Stages {
 public:
  explicit Stages(size_t n) : gain_(n), factor_(n), block_(n) {}
  using Block = std::array<Entry, WIDTH>;
  std::vector<Block>& blocks() { return block_; }
  bool factor(const Rows& rows);
  // ``common`` is added to the gradient by h and slack.
  void solve(const Rows& rows, const std::vector<Entry>& g, const std::array<double, 2>& common, Motion& x) const;

 private:
  using Gain = std::array<State, 3>;
  std::vector<Gain> gain_;                                // K of w = k - K (r, q, h, slack)
  std::vector<std::array<std::array<double, 3>, 3>> factor_;  // Cholesky factor of the block of w
  std::vector<Block> block_;
  double common_[2][2];
};

}  // namespace avs
