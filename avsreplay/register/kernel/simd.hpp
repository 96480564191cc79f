// Eight floats and four doubles at a time, in operations that round alike on every machine.
// Included inside a namespace named after the instruction set, so that two builds of it can stand in one program.
// Where the compiler has no vector types (or AVS_PLAIN says so) plain loops do the same.
#if defined(__GNUC__) && !defined(AVS_PLAIN)
#define AVS_VECTORS 1
#else
#define AVS_VECTORS 0
#endif

struct F8 {
#if AVS_VECTORS
  typedef float Raw __attribute__((vector_size(32)));
  typedef int32_t Mask __attribute__((vector_size(32)));
  Raw v;
#else
  struct Mask {
    int32_t v[8];
  };
  float v[8];
#endif
};

struct F4 {
#if AVS_VECTORS
  typedef float Raw __attribute__((vector_size(16)));
  Raw v;
#else
  float v[4];
#endif
};

struct D4 {
#if AVS_VECTORS
  typedef double Raw __attribute__((vector_size(32)));
  typedef int64_t Mask __attribute__((vector_size(32)));
  Raw v;
#else
  struct Mask {
    int64_t v[4];
  };
  double v[4];
#endif
};

#if AVS_VECTORS
static inline F8 f8(float x) { return {x - F8::Raw{}}; }
static inline F8 operator+(F8 a, F8 b) { return {a.v + b.v}; }
static inline F8 operator-(F8 a, F8 b) { return {a.v - b.v}; }
static inline F8 operator*(F8 a, F8 b) { return {a.v * b.v}; }
static inline F8 operator/(F8 a, F8 b) { return {a.v / b.v}; }
static inline F8::Mask operator<(F8 a, F8 b) { return a.v < b.v; }
static inline F8::Mask both(F8::Mask a, F8::Mask b) { return a & b; }
static inline F8::Mask either(F8::Mask a, F8::Mask b) { return a | b; }
static inline F8 select(F8::Mask m, F8 a, F8 b) {
#if defined(__AVX__)
  return {m ? a.v : b.v};
#else
  return {(F8::Raw)(((F8::Mask)a.v & m) | ((F8::Mask)b.v & ~m))};
#endif
}
static inline F4 f4(float x) { return {x - F4::Raw{}}; }
static inline F4 operator+(F4 a, F4 b) { return {a.v + b.v}; }
static inline F4 operator-(F4 a, F4 b) { return {a.v - b.v}; }
static inline F4 operator*(F4 a, F4 b) { return {a.v * b.v}; }
static inline D4 operator+(D4 a, D4 b) { return {a.v + b.v}; }
static inline D4 operator-(D4 a, D4 b) { return {a.v - b.v}; }
static inline D4 operator*(D4 a, D4 b) { return {a.v * b.v}; }
static inline D4 operator/(D4 a, D4 b) { return {a.v / b.v}; }
static inline D4::Mask operator<(D4 a, D4 b) { return a.v < b.v; }
static inline D4::Mask both(D4::Mask a, D4::Mask b) { return a & b; }
static inline D4::Mask either(D4::Mask a, D4::Mask b) { return a | b; }
static inline D4 select(D4::Mask m, D4 a, D4 b) { return {m ? a.v : b.v}; }
#else
#define AVS_LANES8(expression) \
  F8 r;                        \
  for (int k = 0; k < 8; ++k) r.v[k] = expression; \
  return r;
#define AVS_MASK8(expression) \
  F8::Mask r;                 \
  for (int k = 0; k < 8; ++k) r.v[k] = (expression) ? -1 : 0; \
  return r;
#define AVS_SINGLES4(expression) \
  F4 r;                          \
  for (int k = 0; k < 4; ++k) r.v[k] = expression; \
  return r;
#define AVS_LANES4(expression) \
  D4 r;                        \
  for (int k = 0; k < 4; ++k) r.v[k] = expression; \
  return r;
#define AVS_MASK4(expression) \
  D4::Mask r;                 \
  for (int k = 0; k < 4; ++k) r.v[k] = (expression) ? -1 : 0; \
  return r;
static inline F8 f8(float x) { AVS_LANES8(x) }
static inline F8 operator+(F8 a, F8 b) { AVS_LANES8(a.v[k] + b.v[k]) }
static inline F8 operator-(F8 a, F8 b) { AVS_LANES8(a.v[k] - b.v[k]) }
static inline F8 operator*(F8 a, F8 b) { AVS_LANES8(a.v[k] * b.v[k]) }
static inline F8 operator/(F8 a, F8 b) { AVS_LANES8(a.v[k] / b.v[k]) }
static inline F8::Mask operator<(F8 a, F8 b) { AVS_MASK8(a.v[k] < b.v[k]) }
static inline F8::Mask both(F8::Mask a, F8::Mask b) { AVS_MASK8(a.v[k] && b.v[k]) }
static inline F8::Mask either(F8::Mask a, F8::Mask b) { AVS_MASK8(a.v[k] || b.v[k]) }
static inline F8 select(F8::Mask m, F8 a, F8 b) { AVS_LANES8(m.v[k] ? a.v[k] : b.v[k]) }
static inline F4 f4(float x) { AVS_SINGLES4(x) }
static inline F4 operator+(F4 a, F4 b) { AVS_SINGLES4(a.v[k] + b.v[k]) }
static inline F4 operator-(F4 a, F4 b) { AVS_SINGLES4(a.v[k] - b.v[k]) }
static inline F4 operator*(F4 a, F4 b) { AVS_SINGLES4(a.v[k] * b.v[k]) }
static inline D4 operator+(D4 a, D4 b) { AVS_LANES4(a.v[k] + b.v[k]) }
static inline D4 operator-(D4 a, D4 b) { AVS_LANES4(a.v[k] - b.v[k]) }
static inline D4 operator*(D4 a, D4 b) { AVS_LANES4(a.v[k] * b.v[k]) }
static inline D4 operator/(D4 a, D4 b) { AVS_LANES4(a.v[k] / b.v[k]) }
static inline D4::Mask operator<(D4 a, D4 b) { AVS_MASK4(a.v[k] < b.v[k]) }
static inline D4::Mask both(D4::Mask a, D4::Mask b) { AVS_MASK4(a.v[k] && b.v[k]) }
static inline D4::Mask either(D4::Mask a, D4::Mask b) { AVS_MASK4(a.v[k] || b.v[k]) }
static inline D4 select(D4::Mask m, D4 a, D4 b) { AVS_LANES4(m.v[k] ? a.v[k] : b.v[k]) }
#undef AVS_LANES8
#undef AVS_MASK8
#undef AVS_SINGLES4
#undef AVS_LANES4
#undef AVS_MASK4
#endif

static inline F8 load8(const float* p) {
  F8 r;
  std::memcpy(&r, p, sizeof r);
  return r;
}
static inline void store8(float* p, F8 a) { std::memcpy(p, &a, sizeof a); }
static inline F4 load4(const float* p) {
  F4 r;
  std::memcpy(&r, p, sizeof r);
  return r;
}
static inline D4 load4(const double* p) {
  D4 r;
  std::memcpy(&r, p, sizeof r);
  return r;
}
static inline void store4(double* p, D4 a) { std::memcpy(p, &a, sizeof a); }
static inline D4 d4(double a, double b, double c, double d) {
#if AVS_VECTORS
  return {D4::Raw{a, b, c, d}};
#else
  return {{a, b, c, d}};
#endif
}
static inline D4 d4(double x) { return d4(x, x, x, x); }

static inline D4 sqrt4(D4 a) {
#if AVS_VECTORS && defined(__AVX__)
  return {(D4::Raw)_mm256_sqrt_pd((__m256d)a.v)};
#else
  double t[4];
  store4(t, a);
  for (int k = 0; k < 4; ++k) t[k] = std::sqrt(t[k]);
  return load4(t);
#endif
}

static inline bool any(D4::Mask m) {
#if AVS_VECTORS && defined(__AVX__)
  return _mm256_movemask_pd((__m256d)m) != 0;
#else
  int64_t t[4];
  std::memcpy(t, &m, sizeof t);
  return (t[0] | t[1] | t[2] | t[3]) != 0;
#endif
}

#if AVS_VECTORS && defined(__SSE2__) && !defined(__AVX__)
struct Halves {
  __m128 low, high;
};
static inline Halves halves(F8 a) {
  Halves r;
  std::memcpy(&r, &a, sizeof r);
  return r;
}
static inline F8 whole(Halves a) {
  F8 r;
  std::memcpy(&r, &a, sizeof r);
  return r;
}
#endif

// The second operand where they are equal or one is not a number, as minps and maxps do.
static inline F8 min8(F8 a, F8 b) {
#if AVS_VECTORS && defined(__AVX__)
  return {(F8::Raw)_mm256_min_ps((__m256)a.v, (__m256)b.v)};
#elif AVS_VECTORS && defined(__SSE2__)
  const Halves x = halves(a), y = halves(b);
  return whole({_mm_min_ps(x.low, y.low), _mm_min_ps(x.high, y.high)});
#else
  return select(a < b, a, b);
#endif
}
static inline F8 max8(F8 a, F8 b) {
#if AVS_VECTORS && defined(__AVX__)
  return {(F8::Raw)_mm256_max_ps((__m256)a.v, (__m256)b.v)};
#elif AVS_VECTORS && defined(__SSE2__)
  const Halves x = halves(a), y = halves(b);
  return whole({_mm_max_ps(x.low, y.low), _mm_max_ps(x.high, y.high)});
#else
  return select(b < a, a, b);
#endif
}
static inline F4 max4(F4 a, F4 b) {
#if AVS_VECTORS && defined(__SSE2__)
  return {(F4::Raw)_mm_max_ps((__m128)a.v, (__m128)b.v)};
#else
  F4 r;
  for (int k = 0; k < 4; ++k) r.v[k] = b.v[k] < a.v[k] ? a.v[k] : b.v[k];
  return r;
#endif
}
static inline float sum3(F4 a) { return a.v[0] + a.v[1] + a.v[2]; }
static inline F8 clamp8(F8 x, F8 lo, F8 hi) { return min8(max8(x, lo), hi); }

static inline F8 sqrt8(F8 a) {
#if AVS_VECTORS && defined(__AVX__)
  return {(F8::Raw)_mm256_sqrt_ps((__m256)a.v)};
#elif AVS_VECTORS && defined(__SSE2__)
  const Halves x = halves(a);
  return whole({_mm_sqrt_ps(x.low), _mm_sqrt_ps(x.high)});
#else
  float t[8];
  store8(t, a);
  for (int k = 0; k < 8; ++k) t[k] = std::sqrt(t[k]);
  return load8(t);
#endif
}

// The high bits of eight words from bit `SHIFT` on, as numbers.
template <int SHIFT>
static inline F8 high_bits8(const uint32_t* p) {
#if AVS_VECTORS
  typedef uint32_t Words __attribute__((vector_size(32)));
  Words words;
  std::memcpy(&words, p, sizeof words);
  return {__builtin_convertvector((F8::Mask)(words >> SHIFT), F8::Raw)};
#else
  F8 r;
  for (int k = 0; k < 8; ++k) r.v[k] = (float)(int32_t)(p[k] >> SHIFT);
  return r;
#endif
}

// Bit k is set where lane k of the mask is.
static inline unsigned bits(F8::Mask m) {
#if AVS_VECTORS && defined(__AVX__)
  return (unsigned)_mm256_movemask_ps((__m256)m);
#elif AVS_VECTORS && defined(__SSE2__)
  __m128 half[2];
  std::memcpy(half, &m, sizeof m);
  return (unsigned)(_mm_movemask_ps(half[0]) | _mm_movemask_ps(half[1]) << 4);
#else
  int32_t t[8];
  std::memcpy(t, &m, sizeof t);
  unsigned r = 0;
  for (int k = 0; k < 8; ++k) r |= (t[k] ? 1u : 0u) << k;
  return r;
#endif
}

static inline float least(F8 a) {
#if AVS_VECTORS && defined(__AVX__)
  __m128 m = _mm_min_ps(_mm256_castps256_ps128((__m256)a.v), _mm256_extractf128_ps((__m256)a.v, 1));
  m = _mm_min_ps(m, _mm_movehl_ps(m, m));
  return _mm_cvtss_f32(_mm_min_ss(m, _mm_movehdup_ps(m)));
#elif AVS_VECTORS && defined(__SSE2__)
  const Halves x = halves(a);
  __m128 m = _mm_min_ps(x.low, x.high);
  m = _mm_min_ps(m, _mm_movehl_ps(m, m));
  return _mm_cvtss_f32(_mm_min_ss(m, _mm_shuffle_ps(m, m, 1)));
#else
  float t[8];
  store8(t, a);
  float m = t[0];
  for (int k = 1; k < 8; ++k) m = t[k] < m ? t[k] : m;
  return m;
#endif
}

// The mask whose lane k is set where bit k is.
static inline F8::Mask expand(unsigned bits) {
#if AVS_VECTORS
  const F8::Mask each = {1, 2, 4, 8, 16, 32, 64, 128}, all = each - each + (int32_t)bits;
  return (all & each) == each;
#else
  F8::Mask r;
  for (int k = 0; k < 8; ++k) r.v[k] = bits >> k & 1u ? -1 : 0;
  return r;
#endif
}

static inline double sum_in_order(D4 a) {
  double t[4];
  std::memcpy(t, &a, sizeof t);
  return ((t[0] + t[1]) + t[2]) + t[3];
}

static inline double sum_in_order(F8 a) {
  float t[8];
  store8(t, a);
  double sum = 0;
  for (const float x : t) sum += (double)x;
  return sum;
}

static inline int lowest_bit(unsigned m) {
#if defined(__GNUC__)
  return __builtin_ctz(m);
#else
  int k = 0;
  while (!(m >> k & 1u)) ++k;
  return k;
#endif
}

static inline void fetch(const void* p) {
#if defined(__GNUC__)
  __builtin_prefetch(p);
#else
  (void)p;
#endif
}
