// What the processor and the system can do; by hand, because a compiler's own query is not to be relied on: that of
// clang links but finds nothing where its runtime library is missing.
#include <cstdint>
#if defined(__x86_64__)
#include <cpuid.h>
#endif

// 2: AVX-512 F, DQ, BW, VL; 1: AVX2 and FMA; 0: neither.
extern "C" __attribute__((visibility("default"))) int widest_instructions() {
#if defined(__x86_64__)
    unsigned a, b, c, d, b7 = 0, low = 0, high = 0;
    if (!__get_cpuid(1, &a, &b, &c, &d) || !(c >> 27 & 1)) return 0;  // does the system keep the wide registers
    asm("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    const bool fma = c >> 12 & 1;
    if (!__get_cpuid_count(7, 0, &a, &b7, &c, &d) || !fma) return 0;
    const unsigned wide = 1u << 16 | 1u << 17 | 1u << 30 | 1u << 31;
    if ((low & 0xe6) == 0xe6 && (b7 & wide) == wide) return 2;
    if ((low & 6) == 6 && (b7 >> 5 & 1)) return 1;
#endif
    return 0;
}
