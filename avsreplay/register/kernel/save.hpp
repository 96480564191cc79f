// A Store as bytes and back. Integrity (length, checksum, hash of the model) is the caller's; here every number that is
// used as an index is checked, so that no file, however made, can lead a search out of its arrays.
#pragma once
#include <string>

#include "layout.hpp"

namespace avs {

constexpr uint32_t LAYOUT = 4;  // raise with any change of what is stored or how it is built

std::string save(const Store& store);
// False where the bytes are no sound Store of `primitives` faces or points of a surface with `ids` of them.
bool restore(const char* data, size_t size, int64_t primitives, int64_t ids, bool mesh, Store& store);

}  // namespace avs
