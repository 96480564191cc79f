// Many poses refined at once with few points, against points sampled from the model: the start of the global search.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "layout.hpp"

namespace avs {

struct CoarseRule {
  int passes;
  double gate, fall, floor;     // rejection distance of the first pass, its factor from pass to pass, its least value
  double beyond;                // a point farther than this from the sampled surface costs 1
  bool facing;                  // only sampled points that face the origin of the scan
};

// A grid around the model. Each cell knows the sampled point nearest to its middle, and the nearest of those whose normal
// is opposite to that one's: with a thin panel these are its two sides. Looking one up replaces a search, and is wrong by
// at most a cell.
class Field {
 public:
  static constexpr int64_t MOST = 32767;

  // n <= MOST points and unit normals. `across`: cells along the diagonal of the points' box.
  Field(const double* points, const double* normals, int64_t n, int across);

  // Refines `T` (rows of [R t]) by point-to-plane passes over m points; returns the mean of min(1, d^2 / beyond^2).
  double refine(const double* points, int64_t m, const CoarseRule& rule, double* T) const;

 private:
  struct Near {
    int16_t front = -1, back = -1;
  };
  struct Sample {
    float p[3], n[3];
  };
  struct Match {
    const Sample* sample;
    double e, d2;
  };

  Vec3 middle(int64_t x, int64_t y, int64_t z) const;
  double squared(int16_t id, const Vec3& p) const;
  void offer(Near& near, int16_t id, const Vec3& p) const;
  void sweep(int sx, int sy, int sz);
  const Near& at(const double* p) const;
  bool match(const double* p, const double* eye, bool facing, Match& m) const;

  std::vector<Sample> samples_;
  std::vector<Near> cells_;
  double low_[3], cell_;
  int64_t size_[3];
};

}  // namespace avs
