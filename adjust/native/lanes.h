// W numbers side by side: the vector extension of GCC and Clang, no intrinsics.
#pragma once
#include "arrays.h"

namespace {

#if defined(__AVX512F__)
constexpr int W = 8;
#elif defined(__AVX2__)
constexpr int W = 4;
#else
constexpr int W = 2;  // SSE2, NEON
#endif
typedef double V __attribute__((vector_size(8 * W)));
typedef double Unaligned __attribute__((vector_size(8 * W), aligned(8), may_alias));

inline V load(const double *p) { return *reinterpret_cast<const Unaligned *>(p); }
inline void store(double *p, V v) { *reinterpret_cast<Unaligned *>(p) = v; }
inline double sum(V v) {
    double s = 0;
    for (int i = 0; i < W; ++i) s += v[i];
    return s;
}
// x in every lane; a plain number has one.
template <class S> inline S all(double x) {
    if constexpr (std::is_same_v<S, double>) return x;
    else return S{} + x;
}
inline double root(double x) { return __builtin_sqrt(x); }
inline V root(V v) {
    V o;
    for (int i = 0; i < W; ++i) o[i] = __builtin_sqrt(v[i]);
    return o;
}
inline double magnitude(double x) { return __builtin_fabs(x); }
inline V magnitude(V v) { return v < 0.0 ? -v : v; }
inline double where(bool mask, double a, double b) { return mask ? a : b; }
template <class M> inline V where(M mask, V a, V b) { return mask ? a : b; }
template <class M> inline bool any(M mask) {
    bool found = false;
    for (int i = 0; i < W; ++i) found |= mask[i] != 0;
    return found;
}

}  // namespace
