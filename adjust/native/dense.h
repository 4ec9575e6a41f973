// Small dense products and factors, row by row, rows padded to whole vectors where it says so.
#pragma once
#include "lanes.h"

namespace {

// C (n, m) = A (n, inner) B (inner, m); the rows of B and C are read and written in whole vectors of 2 W.
template <int R, int K>
inline void product_tile(const double *A, int64_t lda, const double *B, int64_t ldb, double *C, int64_t ldc, int64_t inner) {
    V c[R][K] = {};
    for (int64_t k = 0; k < inner; ++k) {
        V b[K];
#pragma GCC unroll 2
        for (int j = 0; j < K; ++j) b[j] = load(B + k * ldb + j * W);
#pragma GCC unroll 4
        for (int r = 0; r < R; ++r) {
            const V a = all<V>(A[r * lda + k]);
#pragma GCC unroll 2
            for (int j = 0; j < K; ++j) c[r][j] += a * b[j];
        }
    }
    for (int r = 0; r < R; ++r)
        for (int j = 0; j < K; ++j) store(C + r * ldc + j * W, c[r][j]);
}
template <int K>
inline void product_columns(const double *A, int64_t lda, const double *B, int64_t ldb, double *C, int64_t ldc, int64_t n, int64_t inner) {
    int64_t i = 0;
    for (; i + 4 <= n; i += 4) product_tile<4, K>(A + i * lda, lda, B, ldb, C + i * ldc, ldc, inner);
    for (; i + 2 <= n; i += 2) product_tile<2, K>(A + i * lda, lda, B, ldb, C + i * ldc, ldc, inner);
    for (; i < n; ++i) product_tile<1, K>(A + i * lda, lda, B, ldb, C + i * ldc, ldc, inner);
}
inline int64_t padded(int64_t n) { return (n + 2 * W - 1) / (2 * W) * (2 * W); }
inline void product(const double *A, int64_t lda, const double *B, int64_t ldb, double *C, int64_t ldc, int64_t n, int64_t m, int64_t inner) {
    int64_t j = 0;
    for (; j + W < m; j += 2 * W) product_columns<2>(A, lda, B + j, ldb, C + j, ldc, n, inner);
    for (; j < m; j += W) product_columns<1>(A, lda, B + j, ldb, C + j, ldc, n, inner);
}

}  // namespace
