// Small dense products and factors, row by row, rows padded to whole vectors where it says so.
#pragma once
#include "lanes.h"

namespace {

// C (n, m) = A (n, inner) B (inner, m), or C += where more; the rows of B and C are read and written in whole vectors of 2 W.
template <int R, int K>
inline void product_tile(const double *A, int64_t lda, const double *B, int64_t ldb, double *C, int64_t ldc, int64_t inner, bool more) {
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
        for (int j = 0; j < K; ++j) {
            double *to = C + r * ldc + j * W;
            store(to, more ? load(to) + c[r][j] : c[r][j]);
        }
}
template <int K>
inline void product_columns(const double *A, int64_t lda, const double *B, int64_t ldb, double *C, int64_t ldc, int64_t n, int64_t inner, bool more) {
    int64_t i = 0;
    for (; i + 4 <= n; i += 4) product_tile<4, K>(A + i * lda, lda, B, ldb, C + i * ldc, ldc, inner, more);
    for (; i + 2 <= n; i += 2) product_tile<2, K>(A + i * lda, lda, B, ldb, C + i * ldc, ldc, inner, more);
    for (; i < n; ++i) product_tile<1, K>(A + i * lda, lda, B, ldb, C + i * ldc, ldc, inner, more);
}
inline int64_t padded(int64_t n) { return (n + 2 * W - 1) / (2 * W) * (2 * W); }

// As wide as the widest vectors pad it, so that room taken by one set of instructions serves every other.
constexpr int64_t WIDEST = 16;
inline int64_t padded_most(int64_t n) { return (n + WIDEST - 1) / WIDEST * WIDEST; }

constexpr int64_t DEPTH = 128;  // rows of B that are multiplied at once: of 2 W columns they stay in the nearest cache
constexpr int64_t MANY = 16;    // rows of A from which they are put side by side before
inline void product(const double *A, int64_t lda, const double *B, int64_t ldb, double *C, int64_t ldc, int64_t n, int64_t m, int64_t inner,
                    bool more = false) {
    alignas(64) double strip[DEPTH * 2 * W];
    for (int64_t k = 0; k == 0 || k < inner; k += DEPTH, more = true) {
        const int64_t some = smaller(DEPTH, inner - k);
        const double *a = A + k, *b = B + k * ldb;
        int64_t j = 0;
        for (; j + W < m; j += 2 * W) {
            if (n < MANY) {
                product_columns<2>(a, lda, b + j, ldb, C + j, ldc, n, some, more);
                continue;
            }
            for (int64_t i = 0; i < some; ++i) std::memcpy(strip + i * 2 * W, b + i * ldb + j, sizeof(double) * 2 * W);
            product_columns<2>(a, lda, strip, 2 * W, C + j, ldc, n, some, more);
        }
        for (; j < m; j += W) product_columns<1>(a, lda, b + j, ldb, C + j, ldc, n, some, more);
    }
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

// N += A A', upper triangle and a little below the diagonal, of n rows, m long (whole vectors): tiles of sums in registers.
template <int R, int C, int LENGTH, int WIDTH>
[[gnu::always_inline]] inline void add_tile(const double (*A)[LENGTH], int j, int k, int m, double (*N)[WIDTH]) {
    V c[R][C] = {};
    for (int p = 0; p < m; p += W) {
        V a[R];
#pragma GCC unroll 4
        for (int r = 0; r < R; ++r) a[r] = load(&A[j + r][p]);
#pragma GCC unroll 6
        for (int i = 0; i < C; ++i) {
            const V b = load(&A[k + i][p]);
#pragma GCC unroll 4
            for (int r = 0; r < R; ++r) c[r][i] += a[r] * b;
        }
    }
    V flat[(R * C + W - 1) / W * W] = {};
#pragma GCC unroll 4
    for (int r = 0; r < R; ++r)
#pragma GCC unroll 6
        for (int i = 0; i < C; ++i) flat[r * C + i] = c[r][i];
    alignas(64) double found[(R * C + W - 1) / W * W];
#pragma GCC unroll 12
    for (int i = 0; i < R * C; i += W) store(found + i, sums(flat + i));
#pragma GCC unroll 4
    for (int r = 0; r < R; ++r)
#pragma GCC unroll 6
        for (int i = 0; i < C; ++i) N[j + r][k + i] += found[r * C + i];
}
// The columns k .. n - 1 of R rows from j on, in tiles about equally wide.
template <int R, int LENGTH, int WIDTH> inline void add_rows(const double (*A)[LENGTH], int j, int n, int m, double (*N)[WIDTH]) {
    constexpr int most = W == 8 ? 6 : 4;
    for (int k = j; k < n;) {
        const int left = n - k, width = left / ((left + most - 1) / most);
        if (width == 1) add_tile<R, 1>(A, j, k, m, N);
        else if (width == 2) add_tile<R, 2>(A, j, k, m, N);
        else if (width == 3) add_tile<R, 3>(A, j, k, m, N);
        else if (most == 4 || width == 4) add_tile<R, 4>(A, j, k, m, N);
        else if (width == 5) add_tile<R, most - 1>(A, j, k, m, N);
        else add_tile<R, most>(A, j, k, m, N);
        k += width;
    }
}
template <int LENGTH, int WIDTH> inline void add_gram(const double (*A)[LENGTH], int n, int m, double (*N)[WIDTH]) {
    int j = 0;
    for (; j + 3 <= n; j += 3) add_rows<3>(A, j, n, m, N);
    if (n - j == 2) add_rows<2>(A, j, n, m, N);
    if (n - j == 1) add_rows<1>(A, j, n, m, N);
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
