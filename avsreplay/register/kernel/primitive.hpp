// Distances to eight points or triangles at once in single precision, and to one in double.
// Included inside a namespace named after the instruction set.
// Where on its triangle a foot lies. The sides are ab, ac and bc.
enum Feature : uint8_t { FACE, SIDE_AB, SIDE_AC, SIDE_BC, CORNER };

struct Foot {
  double d2, x, y, z;
  double height;  // distance of the query from the triangle's plane: how squarely it faces
  Feature feature;
};

// Second derivative of half the squared distance to the foot's feature: sign v v' + whole I. A face: n n'; a side of
// direction t: I - t t'; a corner: I.
struct Stiffness {
  Vec3 v;
  double sign, whole;
};

struct Query {
  double x, y, z;    // in {C}
  F8 qx, qy, qz;     // relative to the model's centre
};

static inline Query query(const Store& s, double x, double y, double z) {
  return {x, y, z, f8((float)(x - s.centre.x)), f8((float)(y - s.centre.y)), f8((float)(z - s.centre.z))};
}

struct Points {
  static F8 distance2(const Store& s, uint32_t block, const Query& q) {
    const PointBlock& b = s.point_blocks[block];
    const F8 dx = load8(b.x) - q.qx, dy = load8(b.y) - q.qy, dz = load8(b.z) - q.qz;
    return dx * dx + dy * dy + dz * dz;
  }

  static Vec3 normal(const Store& s, uint32_t lane) { return s.normals[lane]; }

  static Foot foot(const Store& s, uint32_t lane, const Query& q) {
    const Vec3& p = s.points[lane];
    const double dx = p.x - q.x, dy = p.y - q.y, dz = p.z - q.z;
    return {dx * dx + dy * dy + dz * dz, p.x, p.y, p.z, 0, CORNER};
  }

  // The distance's second derivative is approximated by that to the tangent plane, as if the cloud were dense.
  static Stiffness stiffness(const Store& s, uint32_t lane, Feature) { return {s.normals[lane], 1, 0}; }

  // Squared distances that differ by no more are a tie.
  static double tie(const Store&, double) { return 0; }

  static bool faces(const Store&, uint32_t, const Vec3&) { return true; }  // a cloud has no sides

  static void prefetch_block(const Store& s, uint32_t block) {
    const char* p = reinterpret_cast<const char*>(s.point_blocks.data() + block);
    fetch(p);
    fetch(p + 64);
  }

  static void prefetch_exact(const Store& s, uint32_t lane) { fetch(s.points.data() + lane); }
};

struct Triangles {
  struct Local {
    F8 x, y, z, fx, fy;  // the query and its foot in the triangles' own planes
  };

  struct Normals {
    F8 x, y, z;
  };

  static Normals normals(const TriangleBlock& b) {
    const F8 ux = load8(b.u[0]), uy = load8(b.u[1]), uz = load8(b.u[2]);
    const F8 wx = load8(b.w[0]), wy = load8(b.w[1]), wz = load8(b.w[2]);
    return {uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx};
  }

  static Local local(const TriangleBlock& b, const Query& q) {
    const F8 dx = q.qx - load8(b.a[0]), dy = q.qy - load8(b.a[1]), dz = q.qz - load8(b.a[2]);
    Local r;
    r.x = dx * load8(b.u[0]) + dy * load8(b.u[1]) + dz * load8(b.u[2]);
    r.y = dx * load8(b.w[0]) + dy * load8(b.w[1]) + dz * load8(b.w[2]);
    const Normals n = normals(b);
    r.z = dx * n.x + dy * n.y + dz * n.z;
    place(b, r);
    return r;
  }

  // The foot in the plane: the place itself inside, else the nearest of the feet on the three sides.
  static void place(const TriangleBlock& b, Local& r) {
    const F8 zero = f8(0.f), one = f8(1.f), length = load8(b.length), cx = load8(b.cx), cy = load8(b.cy);
    const F8 bx = length - cx, rx = length - r.x;
    const F8 t = clamp8((r.x * cx + r.y * cy) / squared(cx, cy), zero, one);
    const F8 s = clamp8((rx * bx + r.y * cy) / squared(bx, cy), zero, one);
    const F8 x1 = clamp8(r.x, zero, length), x2 = t * cx, y2 = t * cy, x3 = length - s * bx, y3 = s * cy;
    const F8 e1 = squared(r.x - x1, r.y), e2 = squared(r.x - x2, r.y - y2), e3 = squared(r.x - x3, r.y - y3);
    const F8::Mask out = either(either(r.y < zero, r.x * cy - r.y * cx < zero), rx * cy - r.y * bx < zero);
    const F8::Mask second = e2 < e1;
    const F8 e12 = select(second, e2, e1), x12 = select(second, x2, x1), y12 = select(second, y2, zero);
    const F8::Mask third = e3 < e12;
    r.fx = select(out, select(third, x3, x12), r.x);
    r.fy = select(out, select(third, y3, y12), r.y);
  }

  static F8 squared(F8 x, F8 y) { return x * x + y * y; }

  static F8 distance2(const Store& s, uint32_t block, const Query& q) {
    const Local r = local(s.triangle_blocks[block], q);
    return squared(r.x - r.fx, r.y - r.fy) + r.z * r.z;
  }

  static Vec3 normal(const Store& s, uint32_t lane) { return s.triangles[lane].n(); }

  static Foot foot(const Store& s, uint32_t lane, const Query& q) {
    const Triangle& t = s.triangles[lane];
    const double dx = q.x - t.a.x, dy = q.y - t.a.y, dz = q.z - t.a.z;
    const double x = dx * t.u.x + dy * t.u.y + dz * t.u.z, y = dx * t.w.x + dy * t.w.y + dz * t.w.z;
    const Vec3 n = t.n();
    const double z = dx * n.x + dy * n.y + dz * n.z;
    double fx = x, fy = y, e = 0;
    Feature feature = FACE;
    const double bx = t.length - t.cx, rx = t.length - x;
    if (y < 0 || x * t.cy - y * t.cx < 0 || rx * t.cy - y * bx < 0) e = on_sides(t, x, y, fx, fy, feature);
    return {z * z + e, t.a.x + fx * t.u.x + fy * t.w.x, t.a.y + fx * t.u.y + fy * t.w.y,
            t.a.z + fx * t.u.z + fy * t.w.z, std::fabs(z), feature};
  }

  // Rounding sets the distances to the faces of a common side apart; this is well above it.
  static double tie(const Store& s, double d2) { return 1e-10 * d2 + s.tie2; }

  static bool faces(const Store& s, uint32_t lane, const Vec3& eye) {
    const Triangle& t = s.triangles[lane];
    const Vec3 n = t.n();
    return (eye.x - t.a.x) * n.x + (eye.y - t.a.y) * n.y + (eye.z - t.a.z) * n.z > 0;
  }

  static double unit(double t) { return t < 0 ? 0 : t > 1 ? 1 : t; }

  static double on_sides(const Triangle& t, double x, double y, double& fx, double& fy, Feature& feature) {
    const double bx = t.length - t.cx, rx = t.length - x;
    fx = x < 0 ? 0 : x > t.length ? t.length : x;
    fy = 0;
    double e = (x - fx) * (x - fx) + y * y;
    const double p = unit((x * t.cx + y * t.cy) / (t.cx * t.cx + t.cy * t.cy));
    const double r = unit((rx * bx + y * t.cy) / (bx * bx + t.cy * t.cy));
    const double side[2][2] = {{p * t.cx, p * t.cy}, {t.length - r * bx, r * t.cy}};
    double along = fx / t.length;
    feature = SIDE_AB;
    for (int k = 0; k < 2; ++k) {
      const double* f = side[k];
      const double d = (x - f[0]) * (x - f[0]) + (y - f[1]) * (y - f[1]);
      if (d < e) e = d, fx = f[0], fy = f[1], feature = k == 0 ? SIDE_AC : SIDE_BC, along = k == 0 ? p : r;
    }
    if (!(along > 0 && along < 1)) feature = CORNER;
    return e;
  }

  static Stiffness stiffness(const Store& s, uint32_t lane, Feature feature) {
    const Triangle& t = s.triangles[lane];
    if (feature == FACE) return {t.n(), 1, 0};
    if (feature == CORNER) return {{0, 0, 0}, 0, 1};
    const double x = feature == SIDE_AB ? 1 : feature == SIDE_AC ? t.cx : t.length - t.cx;
    const double y = feature == SIDE_AB ? 0 : feature == SIDE_AC ? t.cy : -t.cy, inv = 1 / std::sqrt(x * x + y * y);
    return {{inv * (x * t.u.x + y * t.w.x), inv * (x * t.u.y + y * t.w.y), inv * (x * t.u.z + y * t.w.z)}, -1, 1};
  }

  static void prefetch_block(const Store& s, uint32_t block) {
    const char* p = reinterpret_cast<const char*>(s.triangle_blocks.data() + block);
    for (size_t k = 0; k < sizeof(TriangleBlock); k += 64) fetch(p + k);
  }

  static void prefetch_exact(const Store& s, uint32_t lane) {
    const char* p = reinterpret_cast<const char*>(s.triangles.data() + lane);
    fetch(p);
    fetch(p + 64);
  }
};
