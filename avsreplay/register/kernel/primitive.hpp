// Distances to eight points or triangles at once in single precision, and to one in double.
// Included inside a namespace named after the instruction set.
// The feet of four points on a primitive each.
struct Four {
  D4 d2, foot[3];
  D4 height;             // distance of the point from the triangle's plane: how squarely it faces
  D4 v[3], sign, whole;  // of the stiffness
};

// What is asked of `Four` beside the foot. The stiffness is the second derivative of half the squared distance to the part
// of the primitive where the foot is, sign v v' + whole I. A face: n n'; a side of direction t: I - t t'; a corner: I.
enum class Ask { FOOT, NORMAL, STIFFNESS };  // NORMAL: v = n, as for a face

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

  // The distance's second derivative is approximated by that to the tangent plane, as if the cloud were dense.
  static Four feet(const Store& s, const uint32_t (&lane)[4], const D4 (&p)[3], Ask ask) {
    const auto of = [&](const Many<Vec3>& all, double Vec3::*x) {
      return d4(all[lane[0]].*x, all[lane[1]].*x, all[lane[2]].*x, all[lane[3]].*x);
    };
    const D4 x = of(s.points, &Vec3::x), y = of(s.points, &Vec3::y), z = of(s.points, &Vec3::z), zero = d4(0);
    const D4 dx = x - p[0], dy = y - p[1], dz = z - p[2];
    Four r{dx * dx + dy * dy + dz * dz, {x, y, z}, zero, {zero, zero, zero}, d4(1), zero};
    if (ask != Ask::FOOT) r.v[0] = of(s.normals, &Vec3::x), r.v[1] = of(s.normals, &Vec3::y), r.v[2] = of(s.normals, &Vec3::z);
    return r;
  }

  static double exact2(const Store& s, uint32_t lane, const Query& q) {
    const Vec3& p = s.points[lane];
    const double dx = p.x - q.x, dy = p.y - q.y, dz = p.z - q.z;
    return dx * dx + dy * dy + dz * dz;
  }

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
  struct Normals {
    F8 x, y, z;
  };

  static Normals normals(const TriangleBlock& b) {
    const F8 ux = load8(b.u[0]), uy = load8(b.u[1]), uz = load8(b.u[2]);
    const F8 wx = load8(b.w[0]), wy = load8(b.w[1]), wz = load8(b.w[2]);
    return {uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx};
  }

  static F8 squared(F8 x, F8 y) { return x * x + y * y; }

  static F8 distance2(const Store& s, uint32_t block, const Query& q) {
    const TriangleBlock& b = s.triangle_blocks[block];
    const F8 dx = q.qx - load8(b.a[0]), dy = q.qy - load8(b.a[1]), dz = q.qz - load8(b.a[2]);
    const Normals n = normals(b);
    const F8 z = dx * n.x + dy * n.y + dz * n.z;
    return beside(b, dx * load8(b.u[0]) + dy * load8(b.u[1]) + dz * load8(b.u[2]),
                  dx * load8(b.w[0]) + dy * load8(b.w[1]) + dz * load8(b.w[2])) + z * z;
  }

  // Squared distances of the places (x, y) of the planes from the triangles: zero inside, else to the nearest side. Both
  // angles at the longest side are acute. Where y < 0 this side is therefore the nearest, and otherwise the one on the same
  // side of the altitude, which is mirrored so that it begins at the origin.
  static F8 beside(const TriangleBlock& b, F8 x, F8 y) {
    const F8 zero = f8(0.f), one = f8(1.f), length = load8(b.length), cx = load8(b.cx), cy = load8(b.cy);
    const F8::Mask left = x < cx;
    const F8 along = select(left, x, length - x), end = select(left, cx, length - cx);
    const F8 t = clamp8((along * end + y * cy) / squared(end, cy), zero, one);
    const F8 outside = select(along * cy < y * end, squared(along - t * end, y - t * cy), zero);
    return select(y < zero, squared(min8(along, zero), y), outside);
  }

  static Four feet(const Store& s, const uint32_t (&lane)[4], const D4 (&p)[3], Ask ask) {
    const Triangle *t[4] = {&s.triangles[lane[0]], &s.triangles[lane[1]], &s.triangles[lane[2]], &s.triangles[lane[3]]};
    const auto number = [&](double Triangle::*x) { return d4(t[0]->*x, t[1]->*x, t[2]->*x, t[3]->*x); };
    const auto part = [&](Vec3 Triangle::*v, double Vec3::*x) {
      return d4(t[0]->*v.*x, t[1]->*v.*x, t[2]->*v.*x, t[3]->*v.*x);
    };
    const D4 ax = part(&Triangle::a, &Vec3::x), ay = part(&Triangle::a, &Vec3::y), az = part(&Triangle::a, &Vec3::z);
    const D4 ux = part(&Triangle::u, &Vec3::x), uy = part(&Triangle::u, &Vec3::y), uz = part(&Triangle::u, &Vec3::z);
    const D4 wx = part(&Triangle::w, &Vec3::x), wy = part(&Triangle::w, &Vec3::y), wz = part(&Triangle::w, &Vec3::z);
    const D4 length = number(&Triangle::length), cx = number(&Triangle::cx), cy = number(&Triangle::cy), zero = d4(0);
    const D4 dx = p[0] - ax, dy = p[1] - ay, dz = p[2] - az, x = dx * ux + dy * uy + dz * uz, y = dx * wx + dy * wy + dz * wz;
    const D4 n[3] = {uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx}, z = dx * n[0] + dy * n[1] + dz * n[2];
    const D4 bx = length - cx, rx = length - x;
    const D4::Mask out = either(either(y < zero, x * cy - y * cx < zero), rx * cy - y * bx < zero);
    D4 fx = x, fy = y, e = zero;
    Four r{zero, {zero, zero, zero}, select(z < zero, zero - z, z), {n[0], n[1], n[2]}, d4(1), zero};
    if (any(out)) {
      const Side side = nearest_side(length, cx, cy, x, y, ask == Ask::STIFFNESS);
      fx = select(out, side.x, x), fy = select(out, side.y, y), e = select(out, side.e, zero);
      if (ask == Ask::STIFFNESS) {
        const D4 u[3] = {ux, uy, uz}, w[3] = {wx, wy, wz};
        const auto other = [&](D4 inside, D4 between) { return select(out, select(side.between, between, zero), inside); };
        for (int k = 0; k < 3; ++k) r.v[k] = other(n[k], side.tx * u[k] + side.ty * w[k]);
        r.sign = other(d4(1), d4(-1)), r.whole = select(out, d4(1), zero);
      }
    }
    r.d2 = z * z + e;
    r.foot[0] = ax + fx * ux + fy * wx, r.foot[1] = ay + fx * uy + fy * wy, r.foot[2] = az + fx * uz + fy * wz;
    return r;
  }

  // Rounding sets the distances to the faces of a common side apart; this is well above it.
  static double tie(const Store& s, double d2) { return 1e-10 * d2 + s.tie2; }

  static bool faces(const Store& s, uint32_t lane, const Vec3& eye) {
    const Triangle& t = s.triangles[lane];
    const Vec3 n = t.n();
    return (eye.x - t.a.x) * n.x + (eye.y - t.a.y) * n.y + (eye.z - t.a.z) * n.z > 0;
  }

  // The nearest place on the three sides, and its squared distance in the plane. Where `directed`: the unit direction of its
  // side, and whether it lies between the ends of that side.
  struct Side {
    D4 x, y, e, tx, ty;
    D4::Mask between;
  };

  static inline Side nearest_side(D4 length, D4 cx, D4 cy, D4 x, D4 y, bool directed) {
    const D4 zero = d4(0), one = d4(1), bx = length - cx, rx = length - x;
    const auto unit = [&](D4 t, D4 most) { return select(t < zero, zero, select(most < t, most, t)); };
    const D4 p = unit((x * cx + y * cy) / (cx * cx + cy * cy), one), q = unit((rx * bx + y * cy) / (bx * bx + cy * cy), one);
    const D4 x1 = unit(x, length), x2 = p * cx, y2 = p * cy, x3 = length - q * bx, y3 = q * cy;
    const D4 e1 = (x - x1) * (x - x1) + y * y, e2 = (x - x2) * (x - x2) + (y - y2) * (y - y2);
    const D4 e3 = (x - x3) * (x - x3) + (y - y3) * (y - y3);
    const D4::Mask second = e2 < e1;
    const D4 e12 = select(second, e2, e1);
    const D4::Mask third = e3 < e12;
    const auto of = [&](D4 ab, D4 ac, D4 bc) { return select(third, bc, select(second, ac, ab)); };
    Side side{of(x1, x2, x3), of(zero, y2, y3), of(e1, e2, e3), zero, zero, third};
    if (!directed) return side;
    const D4 along = of(x1 / length, p, q), tx = of(one, cx, bx), ty = of(zero, cy, zero - cy);
    const D4 inverse = one / sqrt4(tx * tx + ty * ty);
    side.tx = inverse * tx, side.ty = inverse * ty, side.between = both(zero < along, along < one);
    return side;
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
