// Many poses refined at once with few points, against points sampled from the model: the start of the global search.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "hot.hpp"

namespace avs {

struct CoarseRule {
  int passes;
  double gate, fall, floor;     // rejection distance of the first pass, its factor from pass to pass, its least value
  double beyond;                // a point farther than this from the sampled surface costs 1
  bool facing;                  // only sampled points that face the origin of the scan
};

// A scan as the passes read it: (3, padded) relative to its mean.
struct CoarseScan {
  CoarseScan(const double* points, int64_t n);
  std::vector<float> x;
  int64_t points, padded;
  double mean[3];
};

// A grid around the model. Each cell holds the sampled point nearest to its middle, and the nearest of those whose normal
// is opposite to that one's: with a thin panel these are its two sides. Looking one up replaces a search, and is wrong by
// at most a cell.
class Field {
 public:
  static constexpr int64_t MOST = 32767;

  // n <= MOST points and unit normals. `across`: cells along the diagonal of the points' box.
  Field(const double* points, const double* normals, int64_t n, int across);

  // Refines `T` (rows of [R t]) by point-to-plane passes; returns the mean of min(1, d^2 / beyond^2).
  double refine(const Code& code, const CoarseScan& scan, const CoarseRule& rule, double* T) const;

 private:
  Vec3 middle(int64_t x, int64_t y, int64_t z) const;
  double squared(int16_t id, const Vec3& p) const;
  void offer(FieldCell& near, int16_t id, const Vec3& p) const;
  void sweep(int sx, int sy, int sz);

  std::vector<FieldSample> samples_;
  std::vector<FieldCell> cells_;
  double low_[3], middle_[3], cell_;
  int64_t size_[3];
};

// Which of n poses (4, 4) are different, at most `most`, the first of each kind. The same are two whose rotations R have a
// trace of R'R above `trace`, and whose points of the scan at the middle of the model are nearer than `near`.
std::vector<int64_t> different(const double* T, int64_t n, const double* middle, int64_t most, double trace, double near);

}  // namespace avs
