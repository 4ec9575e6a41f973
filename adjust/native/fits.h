// Least-squares fits of a few parameters to the pixels of a window, by Levenberg and Marquardt (Marquardt 1963).
#pragma once
#include "dense.h"

namespace {

constexpr int WINDOW = 256;  // pixels evaluated together

template <int N> struct Normals {  // of N parameters: matrix, right side, sum of squared residuals
    double H[N][N], g[N], cost;
};

// (H + damping diag(H)) X = B solved in place for the leading n rows, B (n, K), scaled to a unit diagonal; false where the
// matrix is not positive definite.
template <int N, int K> inline bool scaled_solve(const double (&H)[N][N], int n, double damping, double (&B)[N][K]) {
    double d[N], A[N][N], inverse[N];  // of the factor's diagonal
    for (int i = 0; i < n; ++i) d[i] = H[i][i] > 0.0 ? 1.0 / root(H[i][i]) : 0.0;
    for (int i = 0; i < n; ++i) {
        for (int j = 0; j <= i; ++j) A[i][j] = H[i][j] * d[i] * d[j];
        A[i][i] += damping + 1e-12;
        for (double &b : B[i]) b *= d[i];
    }
    for (int i = 0; i < n; ++i)
        for (int j = 0; j <= i; ++j) {
            double total = A[i][j];
            for (int k = 0; k < j; ++k) total -= A[i][k] * A[j][k];
            if (i == j && !(total > 1e-14)) return false;
            if (i == j) inverse[i] = 1.0 / root(total);
            else A[i][j] = total * inverse[j];
        }
    for (int c = 0; c < K; ++c) {
        for (int i = 0; i < n; ++i) {
            for (int k = 0; k < i; ++k) B[i][c] -= A[i][k] * B[k][c];
            B[i][c] *= inverse[i];
        }
        for (int i = n - 1; i >= 0; --i) {
            for (int k = i + 1; k < n; ++k) B[i][c] -= A[k][i] * B[k][c];
            B[i][c] *= inverse[i];
        }
    }
    for (int i = 0; i < n; ++i)
        for (double &b : B[i]) b *= d[i];
    return true;
}

constexpr double LARGEST_WINDOW = 1e4;  // px, half of its width
// Whether a place (px) lies on an image: false also where it is no number.
inline bool lies_on(In<float, 2> image, double u, double v) {
    return u >= -0.5 && v >= -0.5 && u <= double(image.n[1]) - 0.5 && v <= double(image.n[0]) - 0.5;
}

// Pixels of a window: places x, y from its centre, and grey values.
struct Pixels {
    const double *x, *y, *value;
    int n;
};

// Normal equations of the window: row(x, y, derivatives) gives the predicted grey value.
template <int N, class Row> inline void add_pixels(const Pixels &w, const Row &row, Normals<N> &out) {
    alignas(64) double A[N + 1][WINDOW];
    double sums[N + 1][N + 1] = {};
    for (int lo = 0; lo < w.n; lo += WINDOW) {
        const int m = w.n - lo < WINDOW ? w.n - lo : WINDOW, full = (m + W - 1) / W * W;
        if constexpr (std::is_invocable_v<Row, V, V, V *>) {  // places are there up to whole vectors
            for (int i = 0; i < full; i += W) {
                V d[N];
                store(A[N] + i, load(w.value + lo + i) - row(load(w.x + lo + i), load(w.y + lo + i), d));
                for (int j = 0; j < N; ++j) store(A[j] + i, d[j]);
            }
        } else for (int i = 0; i < m; ++i) {
            double d[N];
            A[N][i] = w.value[lo + i] - row(w.x[lo + i], w.y[lo + i], d);
            for (int j = 0; j < N; ++j) A[j][i] = d[j];
        }
        for (int i = m; i < full; ++i)
            for (int j = 0; j <= N; ++j) A[j][i] = 0.0;
        add_gram(A, N + 1, full, sums);
    }
    for (int a = 0; a < N; ++a) {
        for (int b = a; b < N; ++b) out.H[a][b] = out.H[b][a] = sums[a][b];
        out.g[a] = sums[a][N];
    }
    out.cost = sums[N][N];
}

// The first n_free of N parameters p, in place, with the normal equations at, which are those of the start and then of a
// place as near the end as the last step is short; false without convergence. The first two are the place (px), which may
// be off by tolerance: the end is where the step that would follow is shorter, by the rate at which steps shrink (Hairer
// and Wanner 1996, IV.8). evaluate(p, out) makes the normal equations, clamp(p) keeps parameters where they mean something.
template <int N, class Evaluate, class Clamp>
inline bool levenberg_marquardt(double (&p)[N], int n_free, double tolerance, const Evaluate &evaluate, const Clamp &clamp, Normals<N> &at) {
    double damping = 1e-3, before = 0.0, trial[N], step[N][1];
    Normals<N> there;
    for (int iteration = 0; iteration < 40; ++iteration) {
        for (int i = 0; i < N; ++i) trial[i] = p[i], step[i][0] = at.g[i];
        if (!scaled_solve(at.H, n_free, damping, step)) {
            damping = larger(damping * 10.0, 1e-6);
            continue;
        }
        double gain = 0.0;  // of the squares, as the equations foretell it
        for (int i = 0; i < n_free; ++i) trial[i] += step[i][0], gain += step[i][0] * at.g[i];
        clamp(trial);
        const double moved = magnitude(trial[0] - p[0]) + magnitude(trial[1] - p[1]), left = gain < before ? gain / before : 1.0;
        const bool last = moved * root(left) < tolerance && gain * left <= 0.05 * tolerance * at.cost + 1e-12;
        if (!last) evaluate(trial, there);
        if (last || there.cost <= at.cost) {
            std::memcpy(p, trial, sizeof p);
            if (last) return at.cost = larger(at.cost - gain, 0.0), true;
            at = there;
            damping *= 0.2, before = gain;
        } else {
            if (moved < tolerance) return true;
            damping *= 6.0, before = 0.0;
        }
    }
    return false;
}

// Covariance (2, 2) of the place, with the residuals' variance; false where there is none.
template <int N> inline bool place_covariance(const Normals<N> &at, int n_free, double variance, double *cov) {
    double unit[N][2] = {};
    unit[0][0] = unit[1][1] = 1.0;
    if (!scaled_solve(at.H, n_free, 0.0, unit)) return false;
    for (int a = 0; a < 2; ++a)
        for (int b = 0; b < 2; ++b) cov[2 * a + b] = variance * unit[a][b];
    return true;
}

// The same where the residuals' variance differs from pixel to pixel, as where the model fails on the few that tell the
// place: each pixel by its own residual, as if the fit had been made without it (HC3 of MacKinnon and White 1985).
template <int N, class Row> inline bool place_covariance_by_pixel(const Normals<N> &at, int n_free, const Pixels &w, const Row &row, double *cov) {
    double inverse[N][N] = {};
    for (int i = 0; i < N; ++i) inverse[i][i] = 1.0;
    if (!scaled_solve(at.H, n_free, 0.0, inverse)) return false;
    cov[0] = cov[1] = cov[2] = cov[3] = 0.0;
    for (int i = 0; i < w.n; ++i) {
        double d[N], leverage = 0.0, pull[2] = {};
        const double left = w.value[i] - row(w.x[i], w.y[i], d);
        for (int a = 0; a < n_free; ++a)
            for (int b = 0; b < n_free; ++b) {
                const double part = inverse[a][b] * d[b];
                leverage += d[a] * part;
                if (a < 2) pull[a] += part;
            }
        const double without = left / larger(1.0 - leverage, 0.05);
        for (int a = 0; a < 2; ++a)
            for (int b = 0; b < 2; ++b) cov[2 * a + b] += without * without * pull[a] * pull[b];
    }
    return true;
}

}  // namespace
