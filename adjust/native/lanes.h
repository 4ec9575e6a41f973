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
inline void store(double *p, double x) { *p = x; }
// W numbers; of a plain number one.
template <class S> inline S loaded(const double *p) {
    if constexpr (std::is_same_v<S, double>) return *p;
    else return load(p);
}
inline double sum(V v) {
    double s = 0;
    for (int i = 0; i < W; ++i) s += v[i];
    return s;
}
// W rows of D numbers by columns, the first of n at p; behind the last one that again.
template <int D> inline void by_columns(const double *p, int64_t n, V (&out)[D]) {
    for (int a = 0; a < D; ++a)
        for (int i = 0; i < W; ++i) out[a][i] = p[D * (i < n ? i : n - 1) + a];
}
template <int D, int... I> [[gnu::always_inline]] inline void whole_columns(const double *p, V (&out)[D], std::integer_sequence<int, I...>) {
    for (int a = 0; a < D; ++a) out[a] = V{p[D * I + a]...};
}
template <int D> [[gnu::always_inline]] inline void columns(const double *p, int64_t n, V (&out)[D]) {
    if (n >= W) whole_columns(p, out, std::make_integer_sequence<int, W>{});
    else by_columns(p, n, out);
}
// One in the first n lanes, else zero.
[[gnu::always_inline]] inline V first_lanes(int64_t n) {
    V o = V{};
    for (int i = 0; i < W; ++i) o[i] = i < n;
    return o;
}
// The first n numbers, or W.
inline void store_lanes(double *p, int64_t n, V v) {
    if (n >= W) store(p, v);
    else
        for (int i = 0; i < n; ++i) p[i] = v[i];
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
    else return x - S{};  // of all that broadcasts a number only this is no work: 0 + x is another zero where x is -0
}
inline double root(double x) { return __builtin_sqrt(x); }
inline V root(V v) {
    V o;
    for (int i = 0; i < W; ++i) o[i] = __builtin_sqrt(v[i]);
    return o;
}
inline double magnitude(double x) { return __builtin_fabs(x); }
inline V magnitude(V v) { return v < 0.0 ? -v : v; }
inline V larger(V a, V b) { return a > b ? a : b; }
inline double where(bool mask, double a, double b) { return mask ? a : b; }
template <class M> inline V where(M mask, V a, V b) { return mask ? a : b; }
typedef int64_t Bits __attribute__((vector_size(8 * W)));

inline double exponential(double x) { return std::exp(x); }
// exp(x) to two units in the last place, for x from -700 to 700: 2^n times the series of what is left, at most log(2) / 2.
inline V exponential(V x) {
    constexpr double shift = 0x1.8p52;  // added, it leaves the nearest integer in the last bits
    constexpr double c[] = {1.0 / 479001600, 1.0 / 39916800, 1.0 / 3628800, 1.0 / 362880, 1.0 / 40320, 1.0 / 5040, 1.0 / 720,
                            1.0 / 120, 1.0 / 24, 1.0 / 6, 0.5, 1.0, 1.0};
    const V shifted = x * 1.4426950408889634 + shift, n = shifted - shift;
    const V r = (x - n * 0x1.62e42fefa3800p-1) - n * 0x1.ef35793c76730p-45;  // log(2) in two parts (Cody and Waite 1980)
    V sum = all<V>(c[0]);
#pragma GCC unroll 12
    for (int i = 1; i < 13; ++i) sum = sum * r + c[i];
    return sum * V((Bits(shifted) << 52) + (int64_t(1023) << 52));
}
inline bool any(bool mask) { return mask; }
template <int H = W / 2> [[gnu::always_inline]] inline bool any_lane(V found) {
    if constexpr (H == 0) return found[0] > 0.0;
    else return any_lane<H / 2>(folded<H>(found, found, std::make_integer_sequence<int, W>{}));
}
template <class M> [[gnu::always_inline]] inline bool any(M mask) { return any_lane(mask ? all<V>(1.0) : V{}); }

}  // namespace
