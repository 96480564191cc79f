#define AVS_ISA base
#define AVS_CODE code_base
#define AVS_NAME "baseline"
#include "hot.inl"
