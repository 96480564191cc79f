// A Store as bytes and back. Integrity (length, checksum, hash of the model) is the caller's; here every number that is
// used as an index is checked, so that no file can make a search read outside of its arrays.
#pragma once
#include <string>

#include "layout.hpp"

namespace avs {

constexpr uint32_t LAYOUT = 8;  // raise with any change of what is stored or how it is built

std::string save(const Store& store);
// Detects damage, not intended changes; of the bytes in the order of this machine.
uint64_t checksum(const char* data, size_t size);
// False where the bytes are no sound Store of a surface with `ids` faces or points.
bool restore(const char* data, size_t size, int64_t ids, bool mesh, Store& store);

}  // namespace avs
