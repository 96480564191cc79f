// Which cells are near a block. Included inside a namespace named after the instruction set.
template <class Kind>
static float to_block(const Store& s, uint32_t block, const double* at) {
  return std::sqrt(least(Kind::distance2(s, block, query(s, at[0], at[1], at[2]))));
}

// The range of bricks that can hold a place within `band` of the block.
static void brick_range(const Store& s, uint32_t block, double band, int32_t (&lo)[3], int32_t (&hi)[3]) {
  const Box& b = s.boxes[block];
  const double low[3] = {s.low.x, s.low.y, s.low.z}, centre[3] = {s.centre.x, s.centre.y, s.centre.z};
  for (int k = 0; k < 3; ++k) {
    const double side = BRICK * s.cell, first = (centre[k] + b.lo[k] - band - low[k]) / side;
    const double last = (centre[k] + b.hi[k] + band - low[k]) / side;
    lo[k] = first > 0 ? (int32_t)first : 0;
    hi[k] = last < s.size[k] - 1 ? (int32_t)last : s.size[k] - 1;
  }
}

template <class Kind>
static bool cells_kind(const Store& s, uint32_t block, float band, size_t most, std::vector<Near>& out) {
  const double side = BRICK * s.cell;
  const float brick_radius = (float)(0.8660255 * side) + s.slack, radius = cell_radius(s);
  int32_t lo[3], hi[3], b[3];
  brick_range(s, block, band, lo, hi);
  for (b[0] = lo[0]; b[0] <= hi[0]; ++b[0])
    for (b[1] = lo[1]; b[1] <= hi[1]; ++b[1])
      for (b[2] = lo[2]; b[2] <= hi[2]; ++b[2]) {
        const double corner[3] = {s.low.x + b[0] * side, s.low.y + b[1] * side, s.low.z + b[2] * side};
        const double middle[3] = {corner[0] + 0.5 * side, corner[1] + 0.5 * side, corner[2] + 0.5 * side};
        if (to_block<Kind>(s, block, middle) > brick_radius + band) continue;
        const uint64_t brick = ((uint64_t)b[0] * (uint64_t)s.size[1] + (uint64_t)b[1]) * (uint64_t)s.size[2] + (uint64_t)b[2];
        for (int k = 0; k < WORDS; ++k) {
          const int at[3] = {k / (BRICK * BRICK), k / BRICK % BRICK, k % BRICK};
          double p[3];
          for (int a = 0; a < 3; ++a) p[a] = corner[a] + (at[a] + 0.5) * s.cell;
          const float d = to_block<Kind>(s, block, p);
          if (d > radius + band) continue;
          out.push_back({brick * WORDS + (uint64_t)k, block, std::min((uint32_t)(d / s.step * 0.9999f), STEPS)});
        }
        if (out.size() > most) return false;
      }
  return true;
}
