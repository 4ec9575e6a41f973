// Numbers with derivatives whose pattern of zeros is part of the type: Jet<S, M> has the derivatives of the bits in M.
//
// Forward differentiation (Griewank and Walther 2008, chapter 3); what is zero by its type costs nothing.
#pragma once
#include "lanes.h"

namespace {

constexpr int count(unsigned m) { return std::popcount(m); }
constexpr int bit(unsigned m, size_t i) { return i == 0 ? std::countr_zero(m) : bit(m & (m - 1), i - 1); }

template <class S, unsigned M> struct Jet {
    S v;
    S d[count(M) ? count(M) : 1];
};

template <unsigned M, int B> constexpr bool has = (M >> B) & 1u;
template <unsigned M, int B> constexpr int place = has<M, B> ? count(M & ((1u << B) - 1)) : 0;  // of bit B among those of M
template <unsigned M> using Places = std::make_index_sequence<count(M)>;

template <int B, class S, unsigned M> [[gnu::always_inline]] inline S derivative(const Jet<S, M> &f) { return has<M, B> ? f.d[place<M, B>] : S{}; }

template <class K> concept Plain = std::is_same_v<K, double> || std::is_same_v<K, V>;

// A function of two jets: its value, its derivatives fa and fb by them. One function for all bits: one for each takes half of the build.
template <size_t... I, class S, unsigned A, unsigned B>
[[gnu::always_inline]] inline auto joined(S v, S fa, const Jet<S, A> &a, S fb, const Jet<S, B> &b, std::index_sequence<I...>) {
    Jet<S, A | B> o;
    o.v = v;
    ((o.d[I] = !has<B, bit(A | B, I)>   ? fa * a.d[place<A, bit(A | B, I)>]
               : !has<A, bit(A | B, I)> ? fb * b.d[place<B, bit(A | B, I)>]
                                        : fa * a.d[place<A, bit(A | B, I)>] + fb * b.d[place<B, bit(A | B, I)>]), ...);
    return o;
}
template <class S, unsigned A, unsigned B>
[[gnu::always_inline]] inline auto joined(S v, S fa, const Jet<S, A> &a, S fb, const Jet<S, B> &b) {
    return joined(v, fa, a, fb, b, Places<(A | B)>{});
}
// A function of one jet: its value and its derivative.
template <class S, unsigned A> [[gnu::always_inline]] inline Jet<S, A> chained(S v, S f, const Jet<S, A> &a) {
    Jet<S, A> o;
    o.v = v;
    [&]<size_t... I>(std::index_sequence<I...>) __attribute__((always_inline)) { ((o.d[I] = f * a.d[I]), ...); }(Places<A>{});
    return o;
}
template <class S, unsigned A> [[gnu::always_inline]] inline Jet<S, A> shifted(S v, const Jet<S, A> &a) {
    Jet<S, A> o = a;
    o.v = v;
    return o;
}

template <class S, unsigned A, unsigned B> [[gnu::always_inline]] inline auto operator+(const Jet<S, A> &a, const Jet<S, B> &b) {
    return joined(a.v + b.v, all<S>(1), a, all<S>(1), b);
}
template <class S, unsigned A, unsigned B> [[gnu::always_inline]] inline auto operator-(const Jet<S, A> &a, const Jet<S, B> &b) {
    return joined(a.v - b.v, all<S>(1), a, all<S>(-1), b);
}
template <class S, unsigned A, unsigned B> [[gnu::always_inline]] inline auto operator*(const Jet<S, A> &a, const Jet<S, B> &b) {
    return joined(a.v * b.v, b.v, a, a.v, b);
}
template <class S, unsigned A, unsigned B> [[gnu::always_inline]] inline auto operator/(const Jet<S, A> &a, const Jet<S, B> &b) {
    const S i = 1.0 / b.v, q = a.v * i;
    return joined(q, i, a, -q * i, b);
}
template <class S, unsigned A> [[gnu::always_inline]] inline auto operator-(const Jet<S, A> &a) { return chained(-a.v, all<S>(-1), a); }
template <Plain K, class S, unsigned A> [[gnu::always_inline]] inline auto operator+(K s, const Jet<S, A> &a) { return shifted<S>(s + a.v, a); }
template <Plain K, class S, unsigned A> [[gnu::always_inline]] inline auto operator+(const Jet<S, A> &a, K s) { return shifted<S>(a.v + s, a); }
template <Plain K, class S, unsigned A> [[gnu::always_inline]] inline auto operator-(const Jet<S, A> &a, K s) { return shifted<S>(a.v - s, a); }
template <Plain K, class S, unsigned A> [[gnu::always_inline]] inline auto operator-(K s, const Jet<S, A> &a) { return chained<S>(s - a.v, all<S>(-1), a); }
template <Plain K, class S, unsigned A> [[gnu::always_inline]] inline auto operator*(K s, const Jet<S, A> &a) { return chained<S>(s * a.v, all<S>(1) * s, a); }
template <Plain K, class S, unsigned A> [[gnu::always_inline]] inline auto operator*(const Jet<S, A> &a, K s) { return chained<S>(s * a.v, all<S>(1) * s, a); }
template <Plain K, class S, unsigned A> [[gnu::always_inline]] inline auto operator/(K s, const Jet<S, A> &a) {
    const S i = 1.0 / a.v, q = s * i;
    return chained<S>(q, -q * i, a);
}
template <class S, unsigned A> [[gnu::always_inline]] inline auto root(const Jet<S, A> &a) {
    const S r = root(a.v);
    return chained<S>(r, 0.5 / r, a);
}
// Polynomial with coefficients c, highest last.
template <Plain S, size_t N> [[gnu::always_inline]] inline S polynomial(const double (&c)[N], S a) {
    S p = all<S>(c[N - 1]);
    for (int i = int(N) - 2; i >= 0; --i) p = p * a + c[i];
    return p;
}
template <class S, unsigned A, size_t N> [[gnu::always_inline]] inline auto polynomial(const double (&c)[N], const Jet<S, A> &a) {
    S p = all<S>(c[N - 1]), d = all<S>(0);
    for (int i = int(N) - 2; i >= 0; --i) {
        d = d * a.v + p;
        p = p * a.v + c[i];
    }
    return chained<S>(p, d, a);
}
// A depth that can be divided by: SMALLEST_DEPTH where it is nearer to zero (m). Derivatives as if it were not moved.
constexpr double SMALLEST_DEPTH = 1e-12;
template <Plain S> [[gnu::always_inline]] inline S divisible(S z) { return where(magnitude(z) < SMALLEST_DEPTH, all<S>(SMALLEST_DEPTH), z); }
template <class S, unsigned A> [[gnu::always_inline]] inline auto divisible(const Jet<S, A> &z) { return shifted<S>(divisible(z.v), z); }

}  // namespace
