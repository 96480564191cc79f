// The first face on a part of a ray. Included inside a namespace named after the instruction set.
class Segment {
 public:
  Segment(const Store& s, const Vec3& eye, const double* d, double from, double to) : s_(s), eye_(eye), d_{d[0], d[1], d[2]}, from_(from), to_(to) {
    const double relative[3] = {eye.x - s.centre.x, eye.y - s.centre.y, eye.z - s.centre.z};
    half_ = f8((float)(0.5 * (to - from)));
    for (int k = 0; k < 3; ++k) {
      const float middle = (float)(relative[k] + 0.5 * (from + to) * d[k]), reach = (float)(0.5 * (to - from) * std::fabs(d[k])) + s.slack;
      middle_[k] = f8(middle), direction_[k] = f8((float)d[k]), low_[k] = f8(middle - reach), high_[k] = f8(middle + reach);
    }
  }

  Hit first() {
    uint32_t stack[STACK];
    int depth = 0;
    stack[depth++] = 0;
    while (depth) {
      const uint32_t child = stack[--depth];
      if (child & IS_BLOCK) {
        block(child & ~IS_BLOCK);
        continue;
      }
      const Node& n = s_.nodes[child];
      F8::Mask out = either(high_[0] < load8(n.lo[0]), load8(n.hi[0]) < low_[0]);
      for (int k = 1; k < 3; ++k) out = either(out, either(high_[k] < load8(n.lo[k]), load8(n.hi[k]) < low_[k]));
      for (unsigned open = ~bits(out) & 0xffu; open; open &= open - 1) {
        const uint32_t next = n.child[lowest_bit(open)];
        if (next != NO_CHILD) stack[depth++] = next;
      }
    }
    return {to_, lane_};
  }

 private:
  // Measures exactly the lanes near which the segment crosses their planes.
  void block(uint32_t number) {
    const TriangleBlock& b = s_.triangle_blocks[number];
    const Triangles::Normals n = Triangles::normals(b);
    const F8 x = middle_[0] - load8(b.a[0]), y = middle_[1] - load8(b.a[1]), z = middle_[2] - load8(b.a[2]);
    const F8 height = x * n.x + y * n.y + z * n.z, slope = direction_[0] * n.x + direction_[1] * n.y + direction_[2] * n.z;
    const F8 zero = f8(0.f), slack = f8(4.f * s_.slack), fall = max8(slope, zero - slope), reach = fall * half_ + slack;
    const unsigned valid = number + 1 == s_.blocks ? s_.last_valid : 0xffu;
    const F8::Mask apart = either(height < zero - reach, reach < height);
    unsigned open = ~bits(apart) & valid;
    if (!open) return;
    const F8 t = clamp8((zero - height) / select(fall < f8(1e-3f), f8(1e-3f), slope), zero - half_, half_);
    const F8 qx = x + t * direction_[0], qy = y + t * direction_[1], qz = z + t * direction_[2];
    const F8 d2 = Triangles::beside(b, qx * load8(b.u[0]) + qy * load8(b.u[1]) + qz * load8(b.u[2]), qx * load8(b.w[0]) + qy * load8(b.w[1]) + qz * load8(b.w[2]));
    const F8 room = slack + slack / max8(fall, f8(1e-3f));  // of the crossing, which is uncertain where the ray is along the face
    open &= bits(either(d2 < room * room, fall < f8(1e-3f)));
    for (; open; open &= open - 1) measure((int32_t)(LANES * number) + lowest_bit(open));
  }

  // A side belongs to both of its faces.
  void measure(int32_t lane) {
    const Triangle& t = s_.triangles[(size_t)lane];
    const Vec3 n = t.n(), to{t.a.x - eye_.x, t.a.y - eye_.y, t.a.z - eye_.z};
    const double range = (n.x * to.x + n.y * to.y + n.z * to.z) / (n.x * d_[0] + n.y * d_[1] + n.z * d_[2]);
    if (!(range > from_ && range < to_)) return;
    const double p[3] = {range * d_[0] - to.x, range * d_[1] - to.y, range * d_[2] - to.z}, least = -s_.tie * t.length;
    const double x = p[0] * t.u.x + p[1] * t.u.y + p[2] * t.u.z, y = p[0] * t.w.x + p[1] * t.w.y + p[2] * t.w.z;
    if (y >= -s_.tie && x * t.cy - y * t.cx >= least && (t.length - x) * t.cy - y * (t.length - t.cx) >= least) to_ = range, lane_ = lane;
  }

  const Store& s_;
  const Vec3 eye_;
  const double d_[3], from_;
  double to_;
  int32_t lane_ = -1;
  F8 middle_[3], direction_[3], half_, low_[3], high_[3];
};

static Hit first_face(const Store& s, const Vec3& eye, const double* d, double from, double to) { return Segment(s, eye, d, from, to).first(); }
