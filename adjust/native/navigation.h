// The pose of an epoch from beacons: rows of spots, Gauss-Newton, and hypotheses of which spot is which beacon.
//
// pixel = lens(camera_from_station * station_from_world * x_in_world); residuals are predicted minus observed, px.
// Derivatives by poses are in GTSAM's tangent (rotation, translation, in the frame on the right).
#pragma once
#include "dense.h"
#include "lenses.h"
#include "vectors.h"

namespace {

// The calibrated head and the beacons. F (p + 3m, r): square root of the covariance of cameras (lens, then pose, from row
// lens_at) and beacons (from row beacon_at).
struct System {
    explicit System(Reader &r)
        : kinds(r), lenses(r), constants(r), camera_R(r), camera_t(r), x_in_world(r), lens_at(r), n_lens(r),
          beacon_at(taken<int64_t>(r)), F(r) {}
    Ints kinds;
    In<double, 2> lenses, constants;
    In<double, 3> camera_R;
    In<double, 2> camera_t, x_in_world;
    Ints lens_at, n_lens;
    int64_t beacon_at;
    In<double, 2> F;

    int64_t common() const { return F.n[1]; }
};
struct Spots {
    explicit Spots(Reader &r) : camera(r), beacon(r), uv(r) {}
    Ints camera, beacon;
    In<double, 2> uv;
};

// Residual (2n,), H (2n, 6) by world_from_station and M (2n, r) by the unit errors of the calibration; whether all beacons
// lie in front of their cameras (a fisheye sees behind itself).
inline bool rows_of_spots(const System &S, const Pose &pose, const Spots &spots, double *residual, double *H, double *M) {
    const int64_t r = S.common();
    bool in_front = true;
    std::memset(M, 0, sizeof(double) * 2 * spots.camera.n[0] * r);
    for (int64_t i = 0; i < spots.camera.n[0]; ++i) {
        const int64_t c = spots.camera[i], b = spots.beacon[i];
        const double *R = &S.camera_R(c, 0, 0), *x = &S.x_in_world(b, 0);
        double q[3], p[3], by_station[3][6], by_camera[3][6], by_beacon[3][3], d[2][N_COLUMNS] = {}, res[2];
        into(pose[0], 4, &pose[0][3], 4, x, q);
        into(R, 3, &S.camera_t(c, 0), 1, q, p);
        in_front &= S.kinds[c] == 1 || p[2] > 0.0;
        with_lens(S.kinds[c], [&]<class Lens>(Lens) {
            lens_row<Lens>(&S.lenses(c, 0), &S.constants(c, 0), p, spots.uv(i, 0), spots.uv(i, 1), res, d);
        });
        for (int a = 0; a < 3; ++a)
            for (int j = 0; j < 3; ++j) {
                double turn = 0.0, world = 0.0;
                for (int k = 0; k < 3; ++k) turn += R[3 * k + a] * skew(q, k, j), world += R[3 * k + a] * pose[j][k];
                by_station[a][j] = turn, by_station[a][3 + j] = -R[3 * j + a], by_beacon[a][j] = world;
                by_camera[a][j] = skew(p, a, j), by_camera[a][3 + j] = a == j ? -1.0 : 0.0;
            }
        for (int e = 0; e < 2; ++e) {
            const double *g = d[e] + MAX_LENS;
            double *m = M + (2 * i + e) * r;
            const auto chained = [&](const double *column, int ld) { return g[0] * column[0] + g[1] * column[ld] + g[2] * column[2 * ld]; };
            residual[2 * i + e] = res[e];
            for (int j = 0; j < 6; ++j) H[6 * (2 * i + e) + j] = chained(&by_station[0][j], 6);
            for (int64_t j = 0; j < S.n_lens[c]; ++j)
                if (d[e][j] != 0.0) add_multiple(d[e][j], &S.F(S.lens_at[c] + j, 0), m, r);
            for (int j = 0; j < 6; ++j) add_multiple(chained(&by_camera[0][j], 6), &S.F(S.lens_at[c] + S.n_lens[c] + j, 0), m, r);
            for (int j = 0; j < 3; ++j) add_multiple(chained(&by_beacon[0][j], 3), &S.F(S.beacon_at + 3 * b + j, 0), m, r);
        }
    }
    return in_front;
}
inline int64_t spot_rows(const System &S, In<double, 2> pose, const Spots &spots, Out<double, 1> residual, Out<double, 2> H, Out<double, 2> M) {
    Pose at;
    copy_pose(pose, at);
    return rows_of_spots(S, at, spots, residual.data, H.data, M.data);
}

// Knowledge of the pose: rows of its tangent of which something is known.
struct PriorRows {
    explicit PriorRows(Reader &r) : pose(r), B(r), rows(r) {}
    In<double, 2> pose, B;
    Ints rows;
};

constexpr int MAX_ITERATIONS = 30;
constexpr double SETTLED = 1e-4, WEAK = 1e-9;
enum State : int64_t { DONE, OPEN, UNSETTLED };

struct Fit {
    const System &S;
    const Spots &spots;
    const PriorRows &prior;
    In<double, 2> R;
    int64_t n, r;
    double *L, *W, *w, *trial_residual, *trial_H, *trial_M;

    // Residual, H and M of spots, then of the prior; whether all beacons are in front.
    bool rows(const Pose &pose, double *residual, double *H, double *M) const {
        const int64_t first = 2 * spots.camera.n[0], k = prior.rows.n[0];
        const bool in_front = rows_of_spots(S, pose, spots, residual, H, M);
        if (!k) return in_front;
        Pose before;
        double step[6], J[6][6];
        copy_pose(prior.pose, before);
        step_between(before, pose, step);
        step_derivative(step, J);
        for (int64_t i = 0; i < k; ++i) {
            const int64_t row = prior.rows[i];
            residual[first + i] = step[row];
            std::memcpy(H + 6 * (first + i), J[row], sizeof J[row]);
            for (int64_t j = 0; j < r; ++j) M[(first + i) * r + j] = -prior.B(row, j);
        }
        return in_front;
    }
    double squares(const double *residual) const {
        std::memcpy(w, residual, sizeof(double) * n);
        forward_solve(L, n, n, w, 1);
        return dot(w, w, n);
    }
    // The factor L (n, n) of R + M M', covariance C (6, 6), step (6,); false where a direction is open.
    bool solved(const double *residual, const double *H, const double *M, double (&C)[6][6], double (&step)[6]) const {
        for (int64_t i = 0; i < n; ++i)
            for (int64_t j = 0; j <= i; ++j) L[i * n + j] = R(i, j) + dot(M + i * r, M + j * r, r);
        if (!cholesky(L, n, n)) return false;
        std::memcpy(W, H, sizeof(double) * 6 * n);
        forward_solve(L, n, n, W, 6);
        double N[6][6] = {}, scale[6], values[6], U[6][6], right[6] = {};
        for (int64_t i = 0; i < n; ++i)
            for (int a = 0; a < 6; ++a)
                for (int b = 0; b < 6; ++b) N[a][b] += W[6 * i + a] * W[6 * i + b];
        for (int i = 0; i < 6; ++i) {
            scale[i] = 1.0 / root(N[i][i]);
            if (!(scale[i] > 0.0 && scale[i] < __builtin_inf())) return false;
        }
        for (int i = 0; i < 6; ++i)
            for (int j = 0; j < 6; ++j) {
                N[i][j] *= scale[i] * scale[j];
                if (!(magnitude(N[i][j]) < __builtin_inf())) return false;
            }
        eigen(N, values, U);
        for (double v : values)
            if (v < WEAK) return false;
        for (int i = 0; i < 6; ++i)
            for (int j = 0; j < 6; ++j) {
                double s = 0.0;
                for (int k = 0; k < 6; ++k) s += U[i][k] * U[j][k] / values[k];
                C[i][j] = s * scale[i] * scale[j];
            }
        squares(residual);  // leaves inv(L) residual in w
        for (int64_t i = 0; i < n; ++i)
            for (int a = 0; a < 6; ++a) right[a] += W[6 * i + a] * w[i];
        for (int i = 0; i < 6; ++i) {
            step[i] = 0.0;
            for (int j = 0; j < 6; ++j) step[i] -= C[i][j] * right[j];
        }
        return true;
    }
};

// The pose by Gauss-Newton from start (4, 4): residual (n,), H (n, 6), M (n, r), covariance C (6, 6) and gain (6, n) at
// the solution. R (n, n): covariance of spots and prior without the errors common to all epochs. numbers: whether all
// beacons are in front, v' inv(Sigma) v, ln det Sigma, ln det C. work: scratch, n (n + 14 + r) numbers.
inline int64_t gauss_newton(const System &S, In<double, 2> start, const Spots &spots, In<double, 2> R, const PriorRows &prior, Out<double, 2> pose_out,
                            Out<double, 1> residual, Out<double, 2> H, Out<double, 2> M, Out<double, 2> C_out, Out<double, 2> gain,
                            Out<double, 1> numbers, Out<double, 1> work) {
    const int64_t n = M.n[0], r = M.n[1];
    double *at = work.data;
    const auto room = [&](int64_t size) { return std::exchange(at, at + size); };
    const Fit fit{S, spots, prior, R, n, r, room(n * n), room(6 * n), room(n), room(n), room(6 * n), room(n * r)};
    Pose pose;
    double C[6][6], step[6];
    copy_pose(start, pose);
    bool in_front = fit.rows(pose, residual.data, H.data, M.data), converged = false;
    for (int iteration = 0; iteration < MAX_ITERATIONS; ++iteration) {
        if (!fit.solved(residual.data, H.data, M.data, C, step)) return OPEN;
        for (int64_t i = 0; i < n; ++i) fit.trial_residual[i] = H(i, 0) * step[0] + H(i, 1) * step[1] + H(i, 2) * step[2] + H(i, 3) * step[3] + H(i, 4) * step[4] + H(i, 5) * step[5];
        const double size = root(fit.squares(fit.trial_residual)), limit = smaller(1.0, 0.5 / larger(root(dot3(step, step)), 0.5));
        for (double &s : step) s *= limit;
        const double before = fit.squares(residual.data);
        bool moved = false;
        for (int half = 0; half < 6 && !moved; ++half) {
            Pose trial;
            retracted(pose, step, trial);
            const bool front = fit.rows(trial, fit.trial_residual, fit.trial_H, fit.trial_M);
            if (fit.squares(fit.trial_residual) <= before * (1.0 + 1e-9) + 1e-9 && (front || !in_front)) {
                std::memcpy(pose, trial, sizeof pose);
                std::memcpy(residual.data, fit.trial_residual, sizeof(double) * n);
                std::memcpy(H.data, fit.trial_H, sizeof(double) * 6 * n);
                std::memcpy(M.data, fit.trial_M, sizeof(double) * n * r);
                in_front = front, moved = true;
            } else {
                for (double &s : step) s *= 0.5;
            }
        }
        if (size < SETTLED || !moved) {
            converged = size < 1e-2;
            break;
        }
    }
    std::memcpy(pose_out.data, pose, sizeof pose);
    numbers.data[0] = in_front;
    if (!converged) return UNSETTLED;
    if (!fit.solved(residual.data, H.data, M.data, C, step)) return OPEN;
    std::memcpy(C_out.data, C, sizeof C);
    backward_solve(fit.L, n, n, fit.W, 6);
    for (int a = 0; a < 6; ++a)
        for (int64_t i = 0; i < n; ++i) {
            double g = 0.0;
            for (int b = 0; b < 6; ++b) g -= C[a][b] * fit.W[6 * i + b];
            gain(a, i) = g;
        }
    numbers.data[1] = fit.squares(residual.data);
    numbers.data[2] = numbers.data[3] = 0.0;
    for (int64_t i = 0; i < n; ++i) numbers.data[2] += 2.0 * std::log(fit.L[i * n + i]);
    if (!cholesky(C[0], 6, 6)) return OPEN;
    for (int i = 0; i < 6; ++i) numbers.data[3] += 2.0 * std::log(C[i][i]);
    return DONE;
}

// One of the many poses that explain too few spots, nearest to a start in a way (damped steps). work: scratch,
// n (n + 14 + r) numbers for n = twice the spots.
inline void some_pose(const System &S, In<double, 2> start, const Spots &spots, Out<double, 2> pose_out, Out<double, 1> work) {
    const int64_t n = 2 * spots.camera.n[0], r = S.common();
    double *at = work.data;
    const auto room = [&](int64_t size) { return std::exchange(at, at + size); };
    double *A = room(n * n), *H = room(6 * n), *H_new = room(6 * n), *residual = room(n), *trial = room(n), *M = room(n * r), *w = trial;
    double damping = 1e-3;
    Pose pose, next;
    copy_pose(start, pose);
    rows_of_spots(S, pose, spots, residual, H, M);
    for (int iteration = 0; iteration < 60; ++iteration) {
        double trace = 0.0, step[6] = {};
        for (int64_t i = 0; i < n; ++i) {
            for (int64_t j = 0; j < n; ++j) A[i * n + j] = dot(H + 6 * i, H + 6 * j, 6);
            trace += A[i * n + i];
        }
        for (int64_t i = 0; i < n; ++i) A[i * n + i] += damping * trace / double(n);
        if (!cholesky(A, n, n)) break;
        std::memcpy(w, residual, sizeof(double) * n);
        forward_solve(A, n, n, w, 1);
        backward_solve(A, n, n, w, 1);
        for (int64_t i = 0; i < n; ++i)
            for (int a = 0; a < 6; ++a) step[a] -= H[6 * i + a] * w[i];
        const double limit = smaller(1.0, 0.3 / larger(root(dot(step, step, 6)), 1e-12));
        for (double &s : step) s *= limit;
        retracted(pose, step, next);
        const bool in_front = rows_of_spots(S, next, spots, trial, H_new, M);
        if (!(in_front && dot(trial, trial, n) < dot(residual, residual, n))) {
            damping *= 10.0;
            continue;
        }
        std::memcpy(pose, next, sizeof pose);
        std::memcpy(residual, trial, sizeof(double) * n);
        std::memcpy(H, H_new, sizeof(double) * 6 * n);
        damping *= 0.3;
        double worst = 0.0;
        for (int64_t i = 0; i < n; ++i) worst = larger(worst, magnitude(residual[i]));
        if (worst < 1e-9) break;
    }
    std::memcpy(pose_out.data, pose, sizeof pose);
}

}  // namespace
