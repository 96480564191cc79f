// Which faces face the eye of a pass, decided for whole subtrees where their bounds allow it.
// Included inside a namespace named after the instruction set.
struct Classifier {
  const Store& s;
  Facing& f;
  F8 x, y, z, error;

  Classifier(const Store& store, Facing& facing) : s(store), f(facing) {
    const Vec3 e{f.eye.x - s.centre.x, f.eye.y - s.centre.y, f.eye.z - s.centre.z};
    const double far = std::sqrt(e.x * e.x + e.y * e.y + e.z * e.z);
    x = f8((float)e.x), y = f8((float)e.y), z = f8((float)e.z);
    error = f8((float)(1.0001 * f.margin + 2e-6 * (far + s.extent)));
  }

  void fill(uint32_t node, uint32_t end, uint32_t first, uint32_t last, uint8_t byte) {
    std::memset(f.alive.data() + node, byte, end - node);
    std::memset(f.may.data() + first, byte, last - first);
    std::memset(f.sure.data() + first, byte, last - first);
  }

  static F8 larger(F8 e, const float* lo, const float* hi) { return max8(e * load8(lo), e * load8(hi)); }
  static F8 smaller(F8 e, const float* lo, const float* hi) { return min8(e * load8(lo), e * load8(hi)); }

  // The blocks [first, last) below `node`, whose subtree ends before node `end`. Returns whether any lane may face.
  bool node(uint32_t at, uint32_t end, uint32_t first, uint32_t last) {
    const NodeSides& b = s.sides[at];
    const F8 top = larger(x, b.n_lo[0], b.n_hi[0]) + larger(y, b.n_lo[1], b.n_hi[1]) + larger(z, b.n_lo[2], b.n_hi[2]);
    const F8 low = smaller(x, b.n_lo[0], b.n_hi[0]) + smaller(y, b.n_lo[1], b.n_hi[1]) + smaller(z, b.n_lo[2], b.n_hi[2]);
    const unsigned away = bits(top - load8(b.h_lo) < f8(0.f) - error), all = bits(error < low - load8(b.h_hi));
    const uint32_t capacity = child_capacity(last - first);
    unsigned alive = 0;
    for (int k = 0; k < LANES && s.nodes[at].child[k] != NO_CHILD; ++k) {
      const uint32_t child = s.nodes[at].child[k], next = k + 1 < LANES ? s.nodes[at].child[k + 1] : NO_CHILD;
      const uint32_t mid = last - first > capacity ? first + capacity : last;
      if (child & IS_BLOCK) {
        alive |= (away >> k & 1 ? clear(first) : lanes(first)) ? 1u << k : 0u;
      } else {
        // Leaves may stand between two nodes only at the end, so the next child that is a node ends this subtree.
        const uint32_t over = next != NO_CHILD && !(next & IS_BLOCK) ? next : end;
        if ((away | all) >> k & 1)
          fill(child, over, first, mid, all >> k & 1 ? 0xff : 0);
        alive |= (all >> k & 1 || (!(away >> k & 1) && node(child, over, first, mid))) ? 1u << k : 0u;
      }
      first = mid;
    }
    f.alive[at] = (uint8_t)alive;
    return alive != 0;
  }

  bool clear(uint32_t block) {
    f.may[block] = f.sure[block] = 0;
    return false;
  }

  bool lanes(uint32_t block) {
    const TriangleBlock& b = s.triangle_blocks[block];
    const Triangles::Normals n = Triangles::normals(b);
    const F8 v = (x - load8(b.a[0])) * n.x + (y - load8(b.a[1])) * n.y + (z - load8(b.a[2])) * n.z;
    f.may[block] = (uint8_t)(~bits(v < f8(0.f) - error) & 255u);
    f.sure[block] = (uint8_t)bits(error < v);
    return f.may[block] != 0;
  }
};

// Fills `f` for an eye, or for no eye at all: then every lane counts.
static void face(const Store& s, const Vec3* eye, double margin, Facing& f) {
  f.may.resize(s.blocks), f.sure.resize(s.blocks), f.alive.resize(s.nodes.size());
  f.eye = eye ? *eye : Vec3{0, 0, 0}, f.margin = margin;
  Classifier c(s, f);
  if (eye && s.mesh)
    c.node(0, (uint32_t)s.nodes.size(), 0, s.blocks);
  else
    c.fill(0, (uint32_t)s.nodes.size(), 0, s.blocks, 0xff);
  f.may[s.blocks - 1] &= s.last_valid, f.sure[s.blocks - 1] &= s.last_valid;
}
