// The nearest few points of a cloud's point, and the least direction of that patch: its normal.
// Included inside a namespace named after the instruction set.
struct Patch {
  double d2[NEIGHBOURS];
  uint32_t lane[NEIGHBOURS];
  int n = 0;

  double worst() const { return n < NEIGHBOURS ? 1e300 : d2[n - 1]; }

  // Sorted by distance; of equals the lower id comes first.
  void add(const Store& s, double d, uint32_t l) {
    const auto after = [&](int k) { return d2[k] > d || (d2[k] == d && s.id[lane[k]] > s.id[l]); };
    if (n == NEIGHBOURS && !after(n - 1)) return;
    int k = n < NEIGHBOURS ? n++ : n - 1;
    for (; k > 0 && after(k - 1); --k) d2[k] = d2[k - 1], lane[k] = lane[k - 1];
    d2[k] = d, lane[k] = l;
  }
};

// The last block is filled up with copies of its last point: they are no neighbours.
static inline bool is_copy(const Store& s, uint32_t lane) { return lane % LANES > 0 && s.id[lane] == s.id[lane - 1]; }

static void visit(const Store& s, const Query& q, uint32_t block, Patch& patch) {
  const float limit = patch.n < NEIGHBOURS ? 3e38f : lenient(s, std::sqrt((float)patch.worst()), 0.f);
  for (unsigned lanes = bits(Points::distance2(s, block, q) < f8(limit)); lanes; lanes &= lanes - 1) {
    const uint32_t lane = LANES * block + (uint32_t)lowest_bit(lanes);
    if (!is_copy(s, lane)) patch.add(s, Points::exact2(s, lane, q), lane);
  }
}

static Patch patch_at(const Store& s, const Query& q, uint32_t own) {
  struct Todo {
    uint32_t child;
    float d2;
  } stack[STACK];
  Patch patch;
  visit(s, q, own, patch);
  int depth = 0;
  stack[depth++] = {0, 0.f};
  while (depth) {
    const Todo t = stack[--depth];
    const float limit = patch.n < NEIGHBOURS ? 3e38f : lenient(s, std::sqrt((float)patch.worst()), 0.f);
    if (!(t.d2 < limit)) continue;
    if (t.child & IS_BLOCK) {
      if ((t.child & ~IS_BLOCK) != own) visit(s, q, t.child & ~IS_BLOCK, patch);
      continue;
    }
    const F8 d = box_distance2(s.nodes[t.child], q);
    alignas(32) float d2[LANES];
    store8(d2, d);
    int nearest = depth;
    for (unsigned open = bits(d < f8(limit)); open; open &= open - 1) {
      const int k = lowest_bit(open);
      stack[depth] = {s.nodes[t.child].child[k], d2[k]};
      if (d2[k] < stack[nearest].d2) nearest = depth;
      ++depth;
    }
    if (depth > nearest) {
      const Todo last = stack[depth - 1];
      stack[depth - 1] = stack[nearest], stack[nearest] = last;
    }
  }
  return patch;
}

static inline void turn(double& u, double& v, double c, double s) {
  const double x = c * u - s * v;
  v = s * u + c * v, u = x;
}

// Unit eigenvector of the least eigenvalue of a symmetric matrix, by Jacobi's rotations.
static Vec3 least_direction(double (&A)[3][3]) {
  double V[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  for (int sweep = 0; sweep < 20; ++sweep) {
    const double off = A[0][1] * A[0][1] + A[0][2] * A[0][2] + A[1][2] * A[1][2];
    if (off <= 1e-30 * (A[0][0] * A[0][0] + A[1][1] * A[1][1] + A[2][2] * A[2][2])) break;
    for (int i = 0; i < 2; ++i)
      for (int j = i + 1; j < 3; ++j) {
        if (A[i][j] == 0) continue;
        const double theta = (A[j][j] - A[i][i]) / (2 * A[i][j]);
        const double t = (theta < 0 ? -1 : 1) / (std::fabs(theta) + std::sqrt(theta * theta + 1));
        const double c = 1 / std::sqrt(t * t + 1), r = t * c;
        for (int k = 0; k < 3; ++k) turn(A[k][i], A[k][j], c, r);
        for (int k = 0; k < 3; ++k) turn(A[i][k], A[j][k], c, r);
        for (int k = 0; k < 3; ++k) turn(V[k][i], V[k][j], c, r);
      }
  }
  const int b = A[1][1] < A[0][0] ? 1 : 0, k = A[2][2] < A[b][b] ? 2 : b;
  return {V[0][k], V[1][k], V[2][k]};
}

static Vec3 normal_at(const Store& s, uint32_t lane) {
  const Vec3& p = s.points[lane];
  const Patch patch = patch_at(s, query(s, p.x, p.y, p.z), lane / LANES);
  double mean[3] = {0, 0, 0}, A[3][3] = {};
  double at[NEIGHBOURS][3];
  for (int k = 0; k < patch.n; ++k) {
    const Vec3& o = s.points[patch.lane[k]];
    at[k][0] = o.x - p.x, at[k][1] = o.y - p.y, at[k][2] = o.z - p.z;
    for (int a = 0; a < 3; ++a) mean[a] += at[k][a] / patch.n;
  }
  for (int k = 0; k < patch.n; ++k)
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b) A[a][b] += (at[k][a] - mean[a]) * (at[k][b] - mean[b]);
  return least_direction(A);
}
