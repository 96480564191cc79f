// Where rays from an eye first meet the faces of a mesh.
#pragma once
#include "layout.hpp"

namespace avs {

// directions: (n, 3) unit vectors in {C}. ranges: (n) distance from the eye to the first face, whichever side it shows; infinite
// where the ray meets none. Returns the work in point searches.
int64_t cast(const Store& store, const Vec3& eye, const double* directions, int64_t n, double* ranges);

}  // namespace avs
