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

// y += f x, of n numbers.
inline void add_multiple(double f, const double *x, double *y, int64_t n) {
    int64_t i = 0;
    for (; i + W <= n; i += W) store(y + i, load(y + i) + f * load(x + i));
    for (; i < n; ++i) y[i] += f * x[i];
}
inline double dot(const double *x, const double *y, int64_t n) {
    V s = V{};
    int64_t i = 0;
    for (; i + W <= n; i += W) s += load(x + i) * load(y + i);
    double total = sum(s);
    for (; i < n; ++i) total += x[i] * y[i];
    return total;
}

// N += A A', upper triangle, of A's first n rows, m long: three columns by four in
// registers. Rows n .. n + 2 of A are read too; they and what they make in N mean nothing.
template <int LENGTH, int WIDTH> inline void add_gram(const double (*A)[LENGTH], int n, int m, V (*N)[WIDTH]) {
    for (int j = 0; j < n; j += 3)
        for (int k = j; k < n; k += 4) {
            V c[3][4] = {};
            for (int p = 0; p < m; p += W) {
                const V a0 = load(&A[j][p]), a1 = load(&A[j + 1][p]), a2 = load(&A[j + 2][p]);
#pragma GCC unroll 4
                for (int i = 0; i < 4; ++i) {
                    const V b = load(&A[k + i][p]);
                    c[0][i] += a0 * b, c[1][i] += a1 * b, c[2][i] += a2 * b;
                }
            }
#pragma GCC unroll 3
            for (int r = 0; r < 3; ++r)
#pragma GCC unroll 4
                for (int i = 0; i < 4; ++i) N[j + r][k + i] += c[r][i];
        }
}

// Lower Cholesky factor of A (n, n), rows of ld numbers, in place; false where there is none.
inline bool cholesky(double *A, int64_t n, int64_t ld) {
    for (int64_t j = 0; j < n; ++j) {
        const double s = A[j * ld + j] - dot(A + j * ld, A + j * ld, j);
        if (!(s > 0.0)) return false;
        const double pivot = root(s);
        A[j * ld + j] = pivot;
        for (int64_t i = j + 1; i < n; ++i) A[i * ld + j] = (A[i * ld + j] - dot(A + i * ld, A + j * ld, j)) / pivot;
    }
    return true;
}
// inv(L) X in place, X (n, m).
inline void forward_solve(const double *L, int64_t n, int64_t ld, double *X, int64_t m) {
    for (int64_t i = 0; i < n; ++i) {
        for (int64_t k = 0; k < i; ++k) add_multiple(-L[i * ld + k], X + k * m, X + i * m, m);
        for (int64_t j = 0; j < m; ++j) X[i * m + j] /= L[i * ld + i];
    }
}
// inv(L') X in place, X (n, m).
inline void backward_solve(const double *L, int64_t n, int64_t ld, double *X, int64_t m) {
    for (int64_t i = n - 1; i >= 0; --i) {
        for (int64_t k = i + 1; k < n; ++k) add_multiple(-L[k * ld + i], X + k * m, X + i * m, m);
        for (int64_t j = 0; j < m; ++j) X[i * m + j] /= L[i * ld + i];
    }
}

// Eigenvalues (any order) and vectors (columns of U) of a symmetric A, which is used up: Jacobi's rotations, cyclic
// (Golub and Van Loan 2013, section 8.5).
template <int N> inline void eigen(double (&A)[N][N], double (&values)[N], double (&U)[N][N]) {
    for (int i = 0; i < N; ++i)
        for (int j = 0; j < N; ++j) U[i][j] = i == j;
    for (int sweep = 0; sweep < 60; ++sweep) {
        double off = 0.0, all_of = 0.0;
        for (int i = 0; i < N; ++i)
            for (int j = 0; j < N; ++j) (i == j ? all_of : off) += A[i][j] * A[i][j];
        if (!(off > 1e-32 * all_of)) break;
        for (int p = 0; p < N; ++p)
            for (int q = p + 1; q < N; ++q) {
                if (A[p][q] == 0.0) continue;
                const double tau = (A[q][q] - A[p][p]) / (2.0 * A[p][q]);
                const double t = (tau >= 0.0 ? 1.0 : -1.0) / (magnitude(tau) + root(1.0 + tau * tau)), c = 1.0 / root(1.0 + t * t), s = t * c;
                for (int k = 0; k < N; ++k) {
                    const double x = A[k][p], y = A[k][q];
                    A[k][p] = c * x - s * y, A[k][q] = s * x + c * y;
                }
                for (int k = 0; k < N; ++k) {
                    const double x = A[p][k], y = A[q][k];
                    A[p][k] = c * x - s * y, A[q][k] = s * x + c * y;
                }
                for (int k = 0; k < N; ++k) {
                    const double x = U[k][p], y = U[k][q];
                    U[k][p] = c * x - s * y, U[k][q] = s * x + c * y;
                }
            }
    }
    for (int i = 0; i < N; ++i) values[i] = A[i][i];
}

}  // namespace
