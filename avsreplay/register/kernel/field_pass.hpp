// One pass of the coarse registration, eight points at a time. Included inside a namespace named after the instruction set.
// Single precision suffices: all places are relative to the middle of the grid or of the scan.

// The sampled points of the cells of eight moved points; a lane without one has `none` 1. Where only samples that face the
// eye count, the second of a cell is taken if the first does not.
struct FieldMatch {
  F8 s[3], n[3], none;
};

// The number of the cell of each place, in cells from the corner of the grid.
static inline void field_cells(const FieldTable& f, const F8 (&place)[3], int32_t (&cell)[8]) {
  F8 at[3];
  for (int a = 0; a < 3; ++a) at[a] = clamp8(place[a], f8(0.f), f8((float)f.size[a] - 1.f));
#if AVS_VECTORS && defined(__AVX2__)
  const __m256i x = _mm256_cvttps_epi32((__m256)at[0].v), y = _mm256_cvttps_epi32((__m256)at[1].v), z = _mm256_cvttps_epi32((__m256)at[2].v);
  const __m256i row = _mm256_add_epi32(_mm256_mullo_epi32(x, _mm256_set1_epi32(f.size[1])), y);
  const __m256i number = _mm256_add_epi32(_mm256_mullo_epi32(row, _mm256_set1_epi32(f.size[2])), z);
  std::memcpy(cell, &number, sizeof number);
#else
  float x[8], y[8], z[8];
  store8(x, at[0]), store8(y, at[1]), store8(z, at[2]);
  for (int k = 0; k < 8; ++k) cell[k] = ((int32_t)x[k] * f.size[1] + (int32_t)y[k]) * f.size[2] + (int32_t)z[k];
#endif
}

static inline FieldMatch field_samples(const FieldTable& f, const int32_t (&id)[8]) {
  FieldMatch m;
  float none[8];
  int32_t from[8];
  for (int k = 0; k < 8; ++k) none[k] = id[k] < 0 ? 1.f : 0.f, from[k] = id[k] < 0 ? 0 : id[k];
  m.none = load8(none);
#if AVS_VECTORS && defined(__AVX2__)
  // A transpose of eight rows; a gather is slower.
  __m256 r[8], t[8];
  for (int k = 0; k < 8; ++k) r[k] = _mm256_load_ps(f.samples[from[k]].p);
  for (int k = 0; k < 8; k += 2) t[k] = _mm256_unpacklo_ps(r[k], r[k + 1]), t[k + 1] = _mm256_unpackhi_ps(r[k], r[k + 1]);
  for (int k = 0; k < 8; k += 4) {
    r[k] = _mm256_shuffle_ps(t[k], t[k + 2], 0x44), r[k + 1] = _mm256_shuffle_ps(t[k], t[k + 2], 0xee);
    r[k + 2] = _mm256_shuffle_ps(t[k + 1], t[k + 3], 0x44);
  }
  // The halves of a row are the place and the normal.
  for (int a = 0; a < 3; ++a) {
    m.s[a] = {(F8::Raw)_mm256_permute2f128_ps(r[a], r[4 + a], 0x20)};
    m.n[a] = {(F8::Raw)_mm256_permute2f128_ps(r[a], r[4 + a], 0x31)};
  }
#else
  float at[6][8];
  for (int k = 0; k < 8; ++k)
    for (int a = 0; a < 3; ++a) at[a][k] = f.samples[from[k]].p[a], at[3 + a][k] = f.samples[from[k]].n[a];
  for (int a = 0; a < 3; ++a) m.s[a] = load8(at[a]), m.n[a] = load8(at[3 + a]);
#endif
  return m;
}

static inline F8 dot3(const F8 (&a)[3], const F8 (&b)[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// 1 where there is no sampled point, or it does not face the eye.
static inline F8 field_unseen(const FieldMatch& m, const F8 (&eye)[3]) {
  const F8 towards[3] = {eye[0] - m.s[0], eye[1] - m.s[1], eye[2] - m.s[2]};
  return select(f8(0.f) < dot3(m.n, towards), m.none, f8(1.f));
}

static void field_pass(const FieldTable& f, const FieldLook& look, FieldSums& out) {
  const float* T = look.T;
  const F8 zero = f8(0.f), one = f8(1.f), eye[3] = {f8(look.eye[0]), f8(look.eye[1]), f8(look.eye[2])}, per_cell = f8(1.f / f.cell);
  const F8 cell2 = f8(f.cell * f.cell), gate2 = f8(look.gate * look.gate), per_beyond2 = f8(1.f / (look.beyond * look.beyond));
  F8 a[29];
  for (F8& sum : a) sum = zero;
  for (int64_t i = 0; i < look.m; i += 8) {
    const F8 x[3] = {load8(look.scan + i), load8(look.scan + look.m + i), load8(look.scan + 2 * look.m + i)};
    F8 p[3], place[3];
    for (int k = 0; k < 3; ++k) {
      p[k] = f8(T[4 * k]) * x[0] + f8(T[4 * k + 1]) * x[1] + f8(T[4 * k + 2]) * x[2] + f8(T[4 * k + 3]);
      place[k] = (p[k] - f8(f.low[k])) * per_cell;
    }
    int32_t cell[8], id[8];
    field_cells(f, place, cell);
    for (int k = 0; k < 8; ++k) id[k] = i + k < look.points ? f.cells[cell[k]].front : -1;
    FieldMatch m = field_samples(f, id);
    if (look.facing) {
      const F8 unseen = field_unseen(m, eye);
      if (unsigned other = bits(m.none < unseen)) {
        for (; other; other &= other - 1) id[lowest_bit(other)] = f.cells[cell[lowest_bit(other)]].back;
        m = field_samples(f, id);
        m.none = field_unseen(m, eye);
      }
    }
    const F8 d[3] = {m.s[0] - p[0], m.s[1] - p[1], m.s[2] - p[2]}, e = dot3(m.n, d), e2 = e * e;
    const F8 d2 = e2 + max8(dot3(d, d) - e2 - cell2, zero), cost = d2 * per_beyond2;
    const F8::Mask found = m.none < one;
    F8 share = select(both(found, cost < one), cost, one);
    if (i + 8 > look.points) share = select(expand(0xffu >> (8 - (look.points - i))), share, zero);
    a[0] = a[0] + share;
    if (look.cost_only) continue;
    const F8::Mask in = both(found, d2 < gate2);
    F8 n[3];
    for (int k = 0; k < 3; ++k) n[k] = select(in, m.n[k], zero);
    const F8 j[6] = {p[1] * n[2] - p[2] * n[1], p[2] * n[0] - p[0] * n[2], p[0] * n[1] - p[1] * n[0], n[0], n[1], n[2]};
    a[1] = a[1] + select(in, one, zero);
    int t = 2;
    for (int row = 0; row < 6; ++row)
      for (int column = 0; column <= row; ++column, ++t) a[t] = a[t] + j[row] * j[column];
    for (int row = 0; row < 6; ++row, ++t) a[t] = a[t] + j[row] * e;
  }
  out.unexplained = sum_in_order(a[0]), out.matched = sum_in_order(a[1]);
  for (int k = 0; k < 21; ++k) out.info[k] = sum_in_order(a[2 + k]);
  for (int k = 0; k < 6; ++k) out.gradient[k] = sum_in_order(a[23 + k]);
}
