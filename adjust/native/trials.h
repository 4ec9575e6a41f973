// Least squares of many complete networks of rotations, one after the other: the parametric form, station 0 held; see
// adjust.relay.monte_carlo.
#pragma once
#include "dense.h"
#include "vectors.h"

namespace {

// out = A' B.
inline void transposed_times(const Mat &A, const Mat &B, Mat &out) {
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) out[i][j] = A[0][i] * B[0][j] + A[1][i] * B[1][j] + A[2][i] * B[2][j];
}
// f(e, a, b) of all pairs, in the order (0, 1), (0, 2), ..., (1, 2), ...
template <class F> inline void each_pair(int64_t n, F &&f) {
    int64_t e = 0;
    for (int64_t a = 0; a < n; ++a)
        for (int64_t b = a + 1; b < n; ++b) f(e++, a, b);
}

// One network: measured b_from_a and their information (E, 3, 3), stations 0_from_i in X.
struct Trial {
    In<double, 3> measured, information;
    int64_t n;
    Mat *X;

    // b_from_a of the stations, and how it is turned against the measured one, rad.
    void residual(int64_t e, int64_t a, int64_t b, Mat &b_from_a, Vec &r) const {
        Mat m, d;
        std::memcpy(m, &measured(e, 0, 0), sizeof m);
        transposed_times(X[b], X[a], b_from_a);
        transposed_times(m, b_from_a, d);
        turn_of(d, r);
    }
    // Normal equations H (3 (n - 1) squared; lower) x = g of steps that turn a station in the frame of 0: the residual
    // Log(m' X_b' X_a) changes by Jr^-1 X_a' (d_a - d_b).
    void equations(double *H, double *g) const {
        const int64_t size = 3 * (n - 1);
        std::memset(H, 0, sizeof(double) * size * size);
        std::memset(g, 0, sizeof(double) * size);
        each_pair(n, [&](int64_t e, int64_t a, int64_t b) {
            Mat turn, by, J, PJ, S;
            Vec r, t;
            residual(e, a, b, turn, r);
            turn_derivative(r, by);
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) J[i][j] = dot3(by[i], X[a][j]);
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) {
                    PJ[i][j] = 0.0;
                    for (int k = 0; k < 3; ++k) PJ[i][j] += information(e, i, k) * J[k][j];
                }
            transposed_times(J, PJ, S);
            for (int i = 0; i < 3; ++i) t[i] = PJ[0][i] * r[0] + PJ[1][i] * r[1] + PJ[2][i] * r[2];
            for (int i = 0; i < 3; ++i) {
                double *low = H + (3 * (b - 1) + i) * size, *high = H + (3 * (a - 1) + i) * size;
                for (int j = 0; j < 3; ++j) {
                    low[3 * (b - 1) + j] += S[i][j];
                    if (a > 0) high[3 * (a - 1) + j] += S[i][j], low[3 * (a - 1) + j] -= S[i][j];
                }
                g[3 * (b - 1) + i] += t[i];
                if (a > 0) g[3 * (a - 1) + i] -= t[i];
            }
        });
    }
    // Gauss-Newton from the measured pairs of station 0, in place; the iterations, most + 1 where it does not settle.
    int64_t adjust(double limit, int64_t most, double *H, double *g) const {
        const int64_t size = 3 * (n - 1);
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                X[0][i][j] = i == j;
                for (int64_t b = 1; b < n; ++b) X[b][i][j] = measured(b - 1, j, i);
            }
        for (int64_t iteration = 1; iteration <= most; ++iteration) {
            equations(H, g);
            if (!cholesky(H, size, size)) break;
            forward_solve(H, size, size, g, 1);
            backward_solve(H, size, size, g, 1);
            double largest = 0.0;
            for (int64_t i = 0; i < size; ++i) largest = larger(largest, magnitude(g[i]));
            for (int64_t b = 1; b < n; ++b) {
                Mat turn, old;
                turn_by(g + 3 * (b - 1), turn);
                std::memcpy(old, X[b], sizeof old);
                for (int i = 0; i < 3; ++i)
                    for (int j = 0; j < 3; ++j) X[b][i][j] = turn[i][0] * old[0][j] + turn[i][1] * old[1][j] + turn[i][2] * old[2][j];
            }
            if (largest < limit) return iteration;
            if (!(largest < 10.0)) break;
        }
        return most + 1;
    }
};

// Adjusted pairs, v'Pv and iterations of each listed trial. work: 9 n + 9 (n - 1)^2 + 3 (n - 1) numbers.
inline void adjust_trials(Ints which, In<double, 4> measured, In<double, 4> information, int64_t n, double limit, int64_t most,
                          Out<double, 4> adjusted, Out<double, 1> omega, Out<int64_t, 1> iterations, Out<double, 1> work) {
    double *H = work.data + 9 * n, *g = H + 9 * (n - 1) * (n - 1);
    for (int64_t i = 0; i < which.n[0]; ++i) {
        const int64_t t = which[i];
        const Trial trial{measured[t], information[t], n, reinterpret_cast<Mat *>(work.data)};
        iterations.data[t] = trial.adjust(limit, most, H, g);
        double total = 0.0;
        each_pair(n, [&](int64_t e, int64_t a, int64_t b) {
            Mat turn;
            Vec r;
            trial.residual(e, a, b, turn, r);
            for (int j = 0; j < 3; ++j) total += r[j] * dot3(&information(t, e, j, 0), r);
            std::memcpy(&adjusted(t, e, 0, 0), turn, sizeof turn);
        });
        omega.data[t] = total;
    }
}

}  // namespace
