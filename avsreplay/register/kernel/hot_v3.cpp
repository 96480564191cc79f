#define AVS_ISA v3
#define AVS_CODE code_v3
#define AVS_NAME "x86-64-v3"
#include "hot.inl"
