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
// Lane i, by its bit H: a or b there and H lanes away.
template <int H, int... I> [[gnu::always_inline]] inline V folded(V a, V b, std::integer_sequence<int, I...>) {
#if __has_builtin(__builtin_shufflevector)
    return __builtin_shufflevector(a, b, (I & H ? W + I : I)...) + __builtin_shufflevector(a, b, (I & H ? W + (I ^ H) : I ^ H)...);
#else
    return V{(I & H ? b[I] + b[I ^ H] : a[I] + a[I ^ H])...};
#endif
}
// The sums of the lanes of W vectors, one in each lane.
template <int H = W / 2> [[gnu::always_inline]] inline V sums(const V *v) {
    if constexpr (H == 0) return *v;
    else return folded<H>(sums<H / 2>(v), sums<H / 2>(v + H), std::make_integer_sequence<int, W>{});
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

}  // namespace
