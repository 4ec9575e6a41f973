// Unit vectors that are nearly parallel, among many; see adjust.statistics.weakness.
#pragma once
#include "lanes.h"

namespace {

constexpr int64_t SINGLE = 2 * W;  // single numbers in a vector
typedef float Singles __attribute__((vector_size(8 * W), aligned(4), may_alias));
constexpr double ROUNDED = 1e-5;  // more than products of single numbers can be wrong by
constexpr int TOGETHER = 4;        // vectors that are compared with others at once

inline Singles singles(const float *p) { return *reinterpret_cast<const Singles *>(p); }
inline double dot(const float *x, const float *y, int64_t n) {
    Singles s = {};
    int64_t i = 0;
    for (; i + SINGLE <= n; i += SINGLE) s += singles(x + i) * singles(y + i);
    double total = 0.0;
    for (int64_t k = 0; k < SINGLE; ++k) total += double(s[k]);
    for (; i < n; ++i) total += double(x[i]) * double(y[i]);
    return total;
}

// Pairs j < i with first <= j < last and i < end whose |u_i . u_j| is at least so much, into found (i, j, that) as far as there
// is room; returns how many there are. u: (N, d) unit vectors. head: (h, N + more) in other axes their largest components,
// rest: the lengths of what is left: |u_i . u_j| <= |head_i . head_j| + rest_i rest_j.
inline int64_t parallel_pairs(int64_t first, int64_t last, int64_t end, In<float, 2> u, In<float, 2> head, In<float, 1> rest, double least,
                              Out<double, 2> found) {
    const int64_t h = head.n[0], wide = head.n[1];
    int64_t n = 0;
    const auto compare = [&](int64_t i, int64_t j) {
        const double size = magnitude(dot(&u(i, 0), &u(j, 0), u.n[1]));
        if (size < least) return;
        if (n < found.n[0]) found(n, 0) = double(i), found(n, 1) = double(j), found(n, 2) = size;
        ++n;
    };
    for (int64_t begin = first; begin < last; begin += TOGETHER) {
        int64_t j[TOGETHER];
        for (int r = 0; r < TOGETHER; ++r) j[r] = smaller(begin + r, last - 1);
        const int64_t some = smaller(TOGETHER, last - begin);
        for (int64_t i = begin + 1; i < end; i += 2 * SINGLE) {
            Singles sum[TOGETHER][2] = {}, bound[TOGETHER][2];
            for (int64_t k = 0; k < h; ++k) {
                const float *row = head.data + k * wide;
                const Singles a = singles(row + i), b = singles(row + i + SINGLE);
#pragma GCC unroll 4
                for (int r = 0; r < TOGETHER; ++r) sum[r][0] += row[j[r]] * a, sum[r][1] += row[j[r]] * b;
            }
            Singles most = {};
#pragma GCC unroll 4
            for (int r = 0; r < TOGETHER; ++r)
#pragma GCC unroll 2
                for (int v = 0; v < 2; ++v) {
                    const Singles s = sum[r][v];
                    bound[r][v] = (s < 0.0f ? -s : s) + rest[j[r]] * singles(rest.data + i + v * SINGLE);
                    most = bound[r][v] > most ? bound[r][v] : most;
                }
            if (!any(Bits(most >= float(least - ROUNDED)) != 0)) continue;
            for (int64_t r = 0; r < some; ++r)
                for (int64_t k = 0; k < 2 * SINGLE; ++k)
                    if (double(bound[r][k / SINGLE][k % SINGLE]) >= least - ROUNDED && i + k > j[r] && i + k < end) compare(i + k, j[r]);
        }
    }
    return n;
}

}  // namespace
