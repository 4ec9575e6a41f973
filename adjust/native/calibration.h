// The lens of one camera and the poses of what it sees, together: least squares with the poses eliminated (Schur
// complement; Triggs et al., Bundle adjustment, 2000), with Huber weights.
#pragma once
#include "lenses.h"
#include "views.h"

namespace {

constexpr double NOT_SEEN = 2e12;  // px^2: a point behind the camera must never look like an improvement
constexpr int MAX_ROW = 6 + MAX_LENS + 1;

struct Calibration {
    int64_t kind;
    const double *constants;
    In<double, 2> directions;  // columns: what of the lens may move
    Ints ptr;
    In<double, 2> x, uv;

    int n_free() const { return int(directions.n[1]); }
    int row() const { return 6 + n_free() + 1; }
    int64_t views() const { return ptr.n[0] - 1; }

    // f(place, how many, points in the camera, u, v) of the points of view b, W at a time, the last one again behind the end.
    template <class F> [[gnu::always_inline]] void each(int64_t b, const double *pose, F &&f) const {
        const int64_t first = ptr[b], last = ptr[b + 1];
        for (int64_t lo = first; lo < last; lo += W) {
            const int m = int(smaller(last - lo, int64_t(W)));
            V in[5], q[3];
            for (int i = 0; i < W; ++i) {
                const int64_t k = lo + smaller(int64_t(i), int64_t(m - 1));
                for (int a = 0; a < 3; ++a) in[a][i] = x(k, a);
                for (int a = 0; a < 2; ++a) in[3 + a][i] = uv(k, a);
            }
            for (int a = 0; a < 3; ++a) q[a] = pose[4 * a] * in[0] + pose[4 * a + 1] * in[1] + pose[4 * a + 2] * in[2] + pose[4 * a + 3];
            f(lo, m, q, in[3], in[4]);
        }
    }
    // Squares (N) of the distances in the image.
    void squares(const double *lens, const double *poses, double *out) const {
        with_lens(kind, [&]<class Lens>(Lens) {
            const auto p = parameters<Lens>(lens);
            for (int64_t b = 0; b < views(); ++b)
                each(b, poses + 16 * b, [&](int64_t lo, int m, const V (&q)[3], V u, V v) {
                    const auto [r, s] = lens_residual<Lens>(p, constants, q, u, v);
                    const V square = r * r + s * s;
                    for (int i = 0; i < m; ++i) {
                        const bool seen = std::isfinite(square[i]) && (q[2][i] > 0.0 || std::is_same_v<Lens, Fisheye>);
                        out[lo + i] = seen ? square[i] : NOT_SEEN;
                    }
                });
        });
    }
    // Normal equations: of every view six rows of pose, lens and right side; of the lens the sum over all, row by row.
    void normal_equations(const double *lens, const double *poses, const double *weights, double *views_out, double (&sum)[MAX_ROW][MAX_ROW]) const {
        const int n = row(), free = n_free();
        alignas(64) double A[MAX_ROW][2 * VIEW_CHUNK];
        std::memset(sum, 0, sizeof sum);
        for (int64_t b = 0; b < views(); ++b) {
            double N[MAX_ROW][MAX_ROW] = {};
            int at = 0;
            each(b, poses + 16 * b, [&](int64_t lo, int m, const V (&q)[3], V u, V v) {
                V r[2], d[2][N_COLUMNS], half;
                for (int i = 0; i < W; ++i) half[i] = i < m ? root(weights[lo + i]) : 0.0;
                with_lens(kind, [&]<class Lens>(Lens) { lens_row<Lens>(lens, constants, q, u, v, r, d); });
                for (int s = 0; s < 2; ++s, at += W) {
                    V g[3];
                    for (int a = 0; a < 3; ++a) g[a] = half * d[s][MAX_LENS + a];
                    for (int a = 0; a < 3; ++a) {  // by a turn, then by a shift, in the camera's frame
                        const int k = (a + 1) % 3, l = (a + 2) % 3;
                        store(&A[a][at], q[k] * g[l] - q[l] * g[k]), store(&A[3 + a][at], g[a]);
                    }
                    for (int j = 0; j < free; ++j) {
                        V c = V{};
                        for (int k = 0; k < directions.n[0]; ++k)
                            if (directions(k, j) != 0.0) c += directions(k, j) * d[s][k];
                        store(&A[6 + j][at], half * c);
                    }
                    store(&A[n - 1][at], half * r[s]);
                }
                if (at == 2 * VIEW_CHUNK || lo + m == ptr[b + 1]) add_gram(A, n, std::exchange(at, 0), N);
            });
            for (int i = 0; i < n; ++i)
                for (int j = i; j < n; ++j)
                    if (i < 6) views_out[(6 * b + i) * n + j] = N[i][j];
                    else sum[i - 6][j - 6] += N[i][j];
        }
    }
    // The lens' equations without the poses, from normal equations damped by a share of their diagonal: by row the left
    // and the right side. solved: per view the factor of its pose block, and inv(factor) times the rest. False where a
    // pose is not determined.
    bool reduced(const double *views_in, const double (&sum)[MAX_ROW][MAX_ROW], double damping, double *solved, double (&out)[MAX_ROW][MAX_ROW]) const {
        const int n = row(), free = n_free();
        double most = 0.0;
        for (int64_t i = 0; i < 6 * views(); ++i) most = larger(most, views_in[i * n + i % 6]);
        std::memcpy(out, sum, sizeof out);
        for (int i = 0; i < free; ++i) out[i][i] += damping * sum[i][i];
        for (int64_t b = 0; b < views(); ++b) {
            const double *in = views_in + 6 * b * n;
            double L[36], *factor = solved + 6 * b * n, Z[6 * (MAX_LENS + 1)];
            for (int i = 0; i < 6; ++i) {
                for (int j = 0; j < i; ++j) L[6 * i + j] = in[j * n + i];
                L[6 * i + i] = (1.0 + damping) * in[i * n + i] + (damping > 0.0 ? 1e-14 * most : 0.0);
                std::memcpy(Z + i * (free + 1), in + i * n + 6, sizeof(double) * (free + 1));
            }
            if (!cholesky(L, 6, 6)) return false;
            forward_solve(L, 6, 6, Z, free + 1);
            for (int i = 0; i < 6; ++i) {
                for (int j = 0; j < free; ++j)
                    for (int k = j; k <= free; ++k) out[j][k] -= Z[i * (free + 1) + j] * Z[i * (free + 1) + k];
                std::memcpy(factor + i * n, L + 6 * i, sizeof(double) * 6);
                std::memcpy(factor + i * n + 6, Z + i * (free + 1), sizeof(double) * (free + 1));
            }
        }
        return true;
    }
    // The pose of view b, moved as its solved equations and the step of the lens say.
    void move(int64_t b, const double *solved, const double *by_lens, const Pose &pose, Pose &out) const {
        const int n = row();
        const double *in = solved + 6 * b * n;
        double step[6];
        for (int i = 0; i < 6; ++i) {
            step[i] = -in[i * n + n - 1];
            for (int j = 0; j < n_free(); ++j) step[i] -= in[i * n + 6 + j] * by_lens[j];
        }
        backward_solve(in, 6, n, step, 1);
        moved(pose, step, out);
    }
};

// The pseudo-inverse of a symmetric matrix (upper triangle, n rows) on a unit diagonal: what is below `least` of the
// largest eigenvalue is left out. False where anything was.
inline bool inverted(const double (&A)[MAX_ROW][MAX_ROW], int n, double least, double (&out)[MAX_ROW][MAX_ROW]) {
    double B[MAX_LENS][MAX_LENS] = {}, values[MAX_LENS], U[MAX_LENS][MAX_LENS], unit[MAX_LENS], most = 0.0;
    for (int i = 0; i < n; ++i) unit[i] = 1.0 / root(larger(magnitude(A[i][i]), 1e-300));
    for (int i = 0; i < n; ++i)
        for (int j = i; j < n; ++j) B[i][j] = B[j][i] = A[i][j] * unit[i] * unit[j];
    eigen(B, values, U);
    for (int k = 0; k < MAX_LENS; ++k) most = larger(most, values[k]);
    bool whole = true;
    std::memset(out, 0, sizeof out);
    for (int k = 0; k < n; ++k) {  // those of the rows behind n are zero and stay where they are
        if (!(values[k] > least * most)) {
            whole = false;
            continue;
        }
        for (int i = 0; i < n; ++i)
            for (int j = 0; j < n; ++j) out[i][j] += U[i][k] * U[j][k] / values[k] * unit[i] * unit[j];
    }
    return whole;
}
// Huber's weights (n) of distances with these squares, at three times their median: convex, since points far out under an
// unfinished distortion must not be taken for gross errors. room: n numbers.
inline void huber(const double *squares, int64_t n, double *weights, double *room) {
    for (int64_t i = 0; i < n; ++i) room[i] = weights[i] = root(squares[i]);
    const double limit = larger(n ? 3.0 * median(room, n) : 0.0, 1e-9);
    for (int64_t i = 0; i < n; ++i) weights[i] = limit / larger(weights[i], limit);
}

// Lens values + directions p and the poses (B, 4, 4) camera_from_target that fit best, in place, by Levenberg-Marquardt;
// squares (N) of what is left, px^2, and the covariance (p, p) of the free components for residuals of variance one,
// infinite where they are not determined. work: 3 N + B (16 + 12 (p + 7)) numbers.
inline void fit_lens(int64_t kind, Out<double, 1> values, Vector constants, In<double, 2> directions, Ints ptr, In<double, 2> x, In<double, 2> uv,
                     int64_t iterations, Out<double, 3> poses, Out<double, 1> squares, Out<double, 2> cov, Out<double, 1> work) {
    const Calibration c{kind, constants.data, directions, ptr, x, uv};
    const int64_t N = x.n[0], B = c.views(), n_values = values.n[0];
    const int free = c.n_free();
    double *weights = work.data, *room = weights + N, *next = room + N, *trial = next + N, *blocks = trial + 16 * B, *solved = blocks + 6 * B * c.row();
    double sum[MAX_ROW][MAX_ROW], left[MAX_ROW][MAX_ROW], inverse[MAX_ROW][MAX_ROW], lens[MAX_LENS], step[MAX_LENS], damping = 1e-6;
    c.squares(values.data, poses.data, squares.data);
    for (int64_t n = 0; n <= iterations; ++n) {
        huber(squares.data, N, weights, room);
        c.normal_equations(values.data, poses.data, weights, blocks, sum);
        const double cost = dot(weights, squares.data, N);
        double gain = 0.0;
        for (int attempt = 0; attempt < 6 && n < iterations; ++attempt, damping = larger(damping, 1e-8) * 10.0) {
            if (!c.reduced(blocks, sum, damping, solved, left)) continue;
            inverted(left, free, 1e-13, inverse);
            for (int i = 0; i < free; ++i) {
                step[i] = 0.0;
                for (int j = 0; j < free; ++j) step[i] -= inverse[i][j] * left[j][free];
            }
            for (int64_t i = 0; i < n_values; ++i) lens[i] = values.data[i] + dot(directions.data + i * free, step, free);
            for (int64_t b = 0; b < B; ++b) {
                Pose pose, there;
                copy_pose(poses[b], pose);
                c.move(b, solved, step, pose, there);
                std::memcpy(trial + 16 * b, there, sizeof there);
            }
            c.squares(lens, trial, next);
            const double there = dot(weights, next, N);
            if (!(there < cost)) continue;
            gain = cost - there;
            damping *= 0.1;
            std::memcpy(values.data, lens, sizeof(double) * n_values);
            std::memcpy(poses.data, trial, sizeof(double) * 16 * B);
            std::memcpy(squares.data, next, sizeof(double) * N);
            break;
        }
        if (n == iterations || gain < 1e-4 * cost) break;
    }
    const bool whole = c.reduced(blocks, sum, 0.0, solved, left) && inverted(left, free, 1e-15, inverse);
    for (int i = 0; i < free; ++i)
        for (int j = 0; j < free; ++j) cov(i, j) = whole ? inverse[i][j] : i == j ? __builtin_inf() : 0.0;
}

}  // namespace
