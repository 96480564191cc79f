#include "hot.hpp"

namespace avs {

const Code& code(bool portable) {
#if defined(AVS_HAS_AVX2)
  static const bool fast = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("bmi2");
  if (fast && !portable) return code_avx2();
#endif
  (void)portable;
  return code_base();
}

}  // namespace avs
