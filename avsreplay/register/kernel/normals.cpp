#include <algorithm>

#include "build.hpp"

namespace avs {

void build_normals(Store& s, const Code& code, Team& team) {
  const int64_t lanes = (int64_t)s.points.size();
  team.each((lanes + CHUNK - 1) / CHUNK, [&](int64_t k) {
    code.normals(s, k * CHUNK, std::min(lanes, (k + 1) * CHUNK), s.normals.data());
  });
}

}  // namespace avs
