// Gradients of patches without the effect of their own leverage. Included inside a namespace named after the instruction set.

constexpr double SMALL = 0.6;           // trace below which the power series of (I - A)^-1/2 is used
constexpr double LEAST_TERM = 1e-12;    // the series ends with terms below this

// A matrix or a vector of each of four patches.
struct FourMatrices {
  D4 v[6][6];
};
struct FourVectors {
  D4 v[6];
};

static inline FourVectors four_vectors(const double* of, const int64_t (&patch)[4]) {
  FourVectors x;
  for (int i = 0; i < 6; ++i) x.v[i] = d4(of[6 * patch[0] + i], of[6 * patch[1] + i], of[6 * patch[2] + i], of[6 * patch[3] + i]);
  return x;
}

// W' N_p W of four patches.
static inline FourMatrices four_congruences(const double* normals, const int64_t (&patch)[4], const double* W) {
  FourMatrices B, A;
  for (int i = 0; i < 6; ++i) {
    D4 row[6];
    for (int k = 0; k < 6; ++k) {
      const int at = 6 * i + k;
      row[k] = d4(normals[36 * patch[0] + at], normals[36 * patch[1] + at], normals[36 * patch[2] + at], normals[36 * patch[3] + at]);
    }
    for (int j = 0; j < 6; ++j) {
      B.v[i][j] = d4(0);
      for (int k = 0; k < 6; ++k) B.v[i][j] = B.v[i][j] + row[k] * d4(W[6 * k + j]);
    }
  }
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j <= i; ++j) {
      D4 sum = d4(0);
      for (int k = 0; k < 6; ++k) sum = sum + d4(W[6 * k + i]) * B.v[k][j];
      A.v[i][j] = A.v[j][i] = sum;
    }
  return A;
}

// (I - A)^-1/2 W' g with A = W' N_p W, for each of m patches, (m, 6). `done` is 0 where the trace of A is not small, and
// nothing is written there.
static void reduce(const double* normals, const double* gradients, int64_t m, const double* W, double* out, uint8_t* done) {
  const D4 zero = d4(0);
  for (int64_t p = 0; p < m; p += 4) {
    const int64_t last = m - 1, patch[4] = {p, std::min(p + 1, last), std::min(p + 2, last), std::min(p + 3, last)};
    const FourVectors g = four_vectors(gradients, patch);
    const FourMatrices A = four_congruences(normals, patch, W);
    FourVectors sum, term;
    D4 trace = zero;
    for (int j = 0; j < 6; ++j) {
      D4 x = zero;
      for (int i = 0; i < 6; ++i) x = x + d4(W[6 * i + j]) * g.v[i];
      sum.v[j] = term.v[j] = x, trace = trace + A.v[j][j];
    }
    const D4::Mask small = trace < d4(SMALL);
    D4 largest = trace;  // of the powers of A
    for (int n = 1; any(both(small, d4(LEAST_TERM) < largest)); ++n, largest = largest * trace) {
      const D4::Mask left = d4(LEAST_TERM) < largest;
      const D4 factor = d4((2 * n - 1) / (2.0 * n));
      FourVectors next;
      for (int i = 0; i < 6; ++i) {
        D4 x = zero;
        for (int k = 0; k < 6; ++k) x = x + A.v[k][i] * term.v[k];
        next.v[i] = x * factor;
      }
      for (int i = 0; i < 6; ++i) sum.v[i] = select(left, sum.v[i] + next.v[i], sum.v[i]);
      term = next;
    }
    double lanes[6][4], is_small[4];
    for (int i = 0; i < 6; ++i) store4(lanes[i], sum.v[i]);
    store4(is_small, select(small, d4(1), zero));
    for (int k = 0; k < 4 && p + k < m; ++k) {
      done[p + k] = is_small[k] > 0;
      if (done[p + k])
        for (int i = 0; i < 6; ++i) out[6 * (p + k) + i] = lanes[i][k];
    }
  }
}
