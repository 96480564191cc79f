// One pass of the coarse registration, four points at a time. Included inside a namespace named after the instruction set.

// The sampled points of the cells of four moved points; a lane without one has `none` 1. Where only samples that face the
// eye count, the second of a cell is taken if the first does not.
struct FieldMatch {
  D4 s[3], n[3], none;
};

static inline const FieldCell& field_cell(const FieldTable& f, const double* place) {
  int64_t at[3];
  for (int a = 0; a < 3; ++a) at[a] = place[a] > 0 ? (place[a] < (double)f.size[a] ? (int64_t)place[a] : f.size[a] - 1) : 0;
  return f.cells[(at[0] * f.size[1] + at[1]) * f.size[2] + at[2]];
}

static inline FieldMatch field_samples(const FieldTable& f, const int16_t (&id)[4]) {
  const FieldSample* s[4];
  double none[4];
  for (int k = 0; k < 4; ++k) s[k] = f.samples + (id[k] < 0 ? 0 : id[k]), none[k] = id[k] < 0;
  FieldMatch m;
  for (int a = 0; a < 3; ++a) {
    m.s[a] = d4(s[0]->p[a], s[1]->p[a], s[2]->p[a], s[3]->p[a]);
    m.n[a] = d4(s[0]->n[a], s[1]->n[a], s[2]->n[a], s[3]->n[a]);
  }
  m.none = load4(none);
  return m;
}

static inline D4 dot3(const D4 (&a)[3], const D4 (&b)[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// 1 where there is no sampled point, or it does not face the eye.
static inline D4 field_unseen(const FieldMatch& m, const D4 (&eye)[3]) {
  const D4 towards[3] = {eye[0] - m.s[0], eye[1] - m.s[1], eye[2] - m.s[2]};
  return select(d4(0) < dot3(m.n, towards), m.none, d4(1));
}

static void field_pass(const FieldTable& f, const FieldLook& look, FieldSums& out) {
  const double* T = look.T;
  const D4 zero = d4(0), one = d4(1), eye[3] = {d4(T[3]), d4(T[7]), d4(T[11])}, per_cell = d4(1 / f.cell);
  const D4 cell2 = d4(f.cell * f.cell), gate2 = d4(look.gate * look.gate), per_beyond2 = d4(1 / (look.beyond * look.beyond));
  D4 a[29] = {};
  for (int64_t i = 0; i < look.m; i += 4) {
    const D4 x[3] = {load4(look.scan + i), load4(look.scan + look.m + i), load4(look.scan + 2 * look.m + i)};
    D4 p[3];
    double place[3][4];
    for (int k = 0; k < 3; ++k) {
      p[k] = d4(T[4 * k]) * x[0] + d4(T[4 * k + 1]) * x[1] + d4(T[4 * k + 2]) * x[2] + d4(T[4 * k + 3]);
      store4(place[k], (p[k] - d4(f.low[k])) * per_cell);
    }
    const FieldCell* cell[4];
    int16_t id[4];
    for (int k = 0; k < 4; ++k) {
      const double at[3] = {place[0][k], place[1][k], place[2][k]};
      cell[k] = &field_cell(f, at), id[k] = i + k < look.points ? cell[k]->front : (int16_t)-1;
    }
    FieldMatch m = field_samples(f, id);
    if (look.facing) {
      const D4 unseen = field_unseen(m, eye);
      if (any(m.none < unseen)) {
        double other[4];
        store4(other, unseen - m.none);
        for (int k = 0; k < 4; ++k)
          if (other[k] > 0) id[k] = cell[k]->back;
        m = field_samples(f, id);
        m.none = field_unseen(m, eye);
      }
    }
    const D4 d[3] = {m.s[0] - p[0], m.s[1] - p[1], m.s[2] - p[2]}, e = dot3(m.n, d), e2 = e * e;
    const D4 rest = dot3(d, d) - e2 - cell2, d2 = e2 + select(zero < rest, rest, zero), cost = d2 * per_beyond2;
    const D4::Mask found = m.none < one;
    double share[4];
    store4(share, select(both(found, cost < one), cost, one));
    for (int k = 0; k < 4; ++k)
      if (i + k >= look.points) share[k] = 0;
    a[0] = a[0] + load4(share);
    if (look.cost_only) continue;
    const D4::Mask in = both(found, d2 < gate2);
    D4 n[3], r[3];
    for (int k = 0; k < 3; ++k) n[k] = select(in, m.n[k], zero), r[k] = p[k] - d4(f.middle[k]);
    const D4 j[6] = {r[1] * n[2] - r[2] * n[1], r[2] * n[0] - r[0] * n[2], r[0] * n[1] - r[1] * n[0], n[0], n[1], n[2]};
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
