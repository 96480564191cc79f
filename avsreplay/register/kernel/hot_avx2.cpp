#define AVS_ISA avx2
#define AVS_CODE code_avx2
#define AVS_NAME "avx2"
#include "hot.inl"
