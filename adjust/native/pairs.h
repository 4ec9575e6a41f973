// Measured pairs b_from_a of poses: residuals Log(measured^-1 b_from_a) and their derivatives; see adjust.observations.pairs.
#pragma once
#include "dense.h"
#include "vectors.h"

namespace {

typedef double Block[6][6];

// Of the inverse right Jacobian of SO(3), and of the coupling block of SE(3), by the squared angle (Sola, Deray and Atchuthan
// 2018, eqs. 144, 180). Below 0.3 rad the series are exact to the last digit, above it the closed forms lose none.
inline void motion_coefficients(double square, double (&c)[4]) {
    if (square < 0.09) {
        const double x = square;
        c[0] = 1.0 / 12 + x * (1.0 / 720 + x * (1.0 / 30240 + x * (1.0 / 1209600 + x * (1.0 / 47900160 + x * 691.0 / 1307674368000))));
        c[1] = 1.0 / 6 - x * (1.0 / 120 - x * (1.0 / 5040 - x * (1.0 / 362880 - x * (1.0 / 39916800 - x / 6227020800))));
        c[2] = 1.0 / 24 - x * (1.0 / 720 - x * (1.0 / 40320 - x * (1.0 / 3628800 - x * (1.0 / 479001600 - x / 87178291200))));
        c[3] = 1.0 / 120 - x * (1.0 / 2520 - x * (1.0 / 120960 - x * (1.0 / 9979200 - x * (1.0 / 1245404160 - x / 217945728000))));
        return;
    }
    const double x = root(square), sine = std::sin(x), cosine = std::cos(x), half = 0.5 * x;
    c[0] = (1.0 - half * std::cos(half) / std::sin(half)) / square;
    c[1] = (x - sine) / (square * x);
    c[2] = (square + 2.0 * cosine - 2.0) / (2.0 * square * square);
    c[3] = (2.0 * x - 3.0 * sine + x * cosine) / (2.0 * square * square * x);
}
inline void times3(const Mat &a, const Mat &b, Mat &out) {
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) out[i][j] = a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j];
}
inline void cross_matrix(const double *v, double sign, Mat &out) {
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) out[i][j] = sign * skew(v, i, j);
}
// Element of 1 + f [w]x [w]x, which is w w' - w^2.
inline double squared(const double *w, double square, double f, int i, int j) { return f * w[i] * w[j] + (i == j ? 1.0 - f * square : 0.0); }
// Lower left block of the right Jacobian of SE(3) at d (Barfoot 2017, eq. 7.86, at the opposite tangent).
inline void coupling(const double *d, const double (&c)[4], Mat &Q) {
    Mat P, U, PU, UP, PUP, far, near;
    cross_matrix(d, -1.0, P);
    cross_matrix(d + 3, -1.0, U);
    times3(P, U, PU), times3(U, P, UP), times3(PU, P, PUP), times3(P, PU, far), times3(UP, P, near);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            Q[i][j] = 0.5 * U[i][j] + c[1] * (PU[i][j] + UP[i][j] + PUP[i][j]) + c[2] * (far[i][j] + near[i][j] - 3.0 * PUP[i][j]);
    times3(PUP, P, far), times3(P, PUP, near);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) Q[i][j] += c[3] * (far[i][j] + near[i][j]);
}
// Right Jacobians of SO(3) or SE(3) at d (n, 3 or 6), or with `back` their inverses.
inline void right_jacobians(In<double, 2> d, int64_t back, Out<double, 3> out) {
    for (int64_t e = 0; e < d.n[0]; ++e) {
        const double *w = &d(e, 0), square = dot3(w, w), half = std::sin(0.5 * root(square));
        double c[4];
        Mat turn, Q, far, near;
        motion_coefficients(square, c);
        const double odd = back ? 0.5 : square < 1e-16 ? -0.5 : -2.0 * half * half / square;
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) out(e, i, j) = turn[i][j] = squared(w, square, c[back ? 0 : 1], i, j) + odd * skew(w, i, j);
        if (d.n[1] == 3) continue;
        coupling(w, c, Q);
        times3(turn, Q, far), times3(far, turn, near);
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                out(e, 3 + i, 3 + j) = turn[i][j], out(e, i, 3 + j) = 0.0, out(e, 3 + i, j) = back ? -near[i][j] : Q[i][j];
    }
}

// One pair: residual, Jr^-1 of it (by_a) and Ad(b_from_a^-1) (turn); the derivative by b is -by_a turn.
inline void pair_row(In<double, 2> R_a, Vector t_a, In<double, 2> R_b, Vector t_b, In<double, 2> measured, Vector shift, double *residual,
                     Block &by_a, Block &turn) {
    Mat present, off;
    Vec place, arm, back;
    const Vec d = {t_a[0] - t_b[0], t_a[1] - t_b[1], t_a[2] - t_b[2]};
    for (int i = 0; i < 3; ++i) {
        place[i] = R_b(0, i) * d[0] + R_b(1, i) * d[1] + R_b(2, i) * d[2];
        for (int j = 0; j < 3; ++j) present[i][j] = R_b(0, i) * R_a(0, j) + R_b(1, i) * R_a(1, j) + R_b(2, i) * R_a(2, j);
    }
    for (int i = 0; i < 3; ++i) {
        arm[i] = 0.0;
        for (int k = 0; k < 3; ++k) arm[i] += measured(k, i) * (place[k] - shift[k]);
        for (int j = 0; j < 3; ++j) off[i][j] = measured(0, i) * present[0][j] + measured(1, i) * present[1][j] + measured(2, i) * present[2][j];
    }
    turn_of(off, residual);
    const double square = dot3(residual, residual);
    double c[4];
    motion_coefficients(square, c);
    Mat right, far, near, Q;
    for (int i = 0; i < 3; ++i) {
        residual[3 + i] = 0.0;
        for (int j = 0; j < 3; ++j) {
            const double even = squared(residual, square, c[0], i, j), odd = 0.5 * skew(residual, i, j);
            right[i][j] = even + odd;
            residual[3 + i] += (even - odd) * arm[j];
        }
    }
    coupling(residual, c, Q);
    times3(right, Q, far), times3(far, right, near);
    for (int i = 0; i < 3; ++i) back[i] = -(present[0][i] * place[0] + present[1][i] * place[1] + present[2][i] * place[2]);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            by_a[i][j] = by_a[3 + i][3 + j] = right[i][j], by_a[3 + i][j] = -near[i][j], by_a[i][3 + j] = turn[i][3 + j] = 0.0;
            turn[i][j] = turn[3 + i][3 + j] = present[j][i], turn[3 + i][j] = 0.0;
            for (int k = 0; k < 3; ++k) turn[3 + i][j] += skew(back, i, k) * present[j][k];
        }
}
// out = sign A B (n by n), of which A has lower zeros (upper triangular) where it says so.
inline void times6(double sign, const double *A, bool upper, const Block &B, double *out) {
    for (int i = 0; i < 6; ++i) {
        double row[6] = {};
        for (int k = upper ? i : 0; k < 6; ++k)
            for (int j = 0; j < 6; ++j) row[j] += A[6 * i + k] * B[k][j];
        for (int j = 0; j < 6; ++j) out[6 * i + j] = sign * row[j];
    }
}

struct Pairs {
    explicit Pairs(Reader &r) : a(r), b(r), R(r), t(r), measured(r), shift(r) {}
    Ints a, b;
    In<double, 3> R;
    In<double, 2> t;
    In<double, 3> measured;
    In<double, 2> shift;

    void row(int64_t e, double *residual, Block &by_a, Block &turn) const {
        pair_row(R[a[e]], t[a[e]], R[b[e]], t[b[e]], measured[e], shift[e], residual, by_a, turn);
    }
};

// Residuals, their derivatives by b and by a, and Ad(b_from_a^-1).
inline void pair_jacobians(const Pairs &pairs, Out<double, 2> residual, Out<double, 3> by_b, Out<double, 3> by_a, Out<double, 3> turn) {
    for (int64_t e = 0; e < residual.n[0]; ++e) {
        Block &A = *reinterpret_cast<Block *>(&by_a(e, 0, 0)), &Ad = *reinterpret_cast<Block *>(&turn(e, 0, 0));
        pairs.row(e, &residual(e, 0), A, Ad);
        times6(-1.0, A[0], false, Ad, &by_b(e, 0, 0));
    }
}
// Whitened residuals and derivatives by b and by a, W upper triangular.
inline void pair_rows(const Pairs &pairs, In<double, 3> W, Out<double, 2> white, Out<double, 3> by_b, Out<double, 3> by_a) {
    for (int64_t e = 0; e < white.n[0]; ++e) {
        double residual[6];
        Block A, Ad;
        pairs.row(e, residual, A, Ad);
        times6(1.0, &W(e, 0, 0), true, A, &by_a(e, 0, 0));
        times6(-1.0, &by_a(e, 0, 0), false, Ad, &by_b(e, 0, 0));
        for (int i = 0; i < 6; ++i) {
            double sum = 0.0;
            for (int j = i; j < 6; ++j) sum += W(e, i, j) * residual[j];
            white(e, i) = sum;
        }
    }
}

// out = A B' (6 by 6).
inline void times6_transposed(const double *A, const double *B, double *out) {
    for (int i = 0; i < 6; ++i)
        for (int j = 0; j < 6; ++j) {
            double sum = 0.0;
            for (int k = 0; k < 6; ++k) sum += A[6 * i + k] * B[6 * j + k];
            out[6 * i + j] = sum;
        }
}
// out = A S A'.
inline void carried6(const double *A, bool upper, const Block &S, double *out) {
    Block left;
    times6(1.0, A, upper, S, left[0]);
    times6_transposed(left[0], A, out);
}

// From the covariance of both ends, b before a (E, 12, 12), that of b_from_a, as its residual moves, and this whitened; and the
// whitened variances of the residual were the ends not correlated. turn: the derivative by b is that by a times -turn.
inline void pair_spread(In<double, 3> ends, In<double, 3> turn, In<double, 3> by_a, In<double, 3> W, Out<double, 3> own, Out<double, 3> moved,
                        Out<double, 3> white, Out<double, 2> apart) {
    for (int64_t e = 0; e < own.n[0]; ++e) {
        const double *T = &turn(e, 0, 0), *A = &by_a(e, 0, 0), *weight = &W(e, 0, 0);
        Block bb, ba, ab, turned, half, left, alone;
        for (int i = 0; i < 6; ++i)
            for (int j = 0; j < 6; ++j) bb[i][j] = ends(e, i, j), ba[i][j] = ends(e, i, 6 + j), ab[i][j] = ends(e, 6 + i, j);
        times6(1.0, T, false, bb, turned[0]);
        times6_transposed(turned[0], T, alone[0]);
        for (int i = 0; i < 6; ++i)
            for (int j = 0; j < 6; ++j) half[i][j] = ab[i][j] - turned[i][j], alone[i][j] += ends(e, 6 + i, 6 + j);
        times6(1.0, T, false, ba, left[0]);
        times6_transposed(half[0], T, turned[0]);
        Block &now = *reinterpret_cast<Block *>(&own(e, 0, 0)), &residual = *reinterpret_cast<Block *>(&moved(e, 0, 0));
        for (int i = 0; i < 6; ++i)
            for (int j = 0; j < 6; ++j) now[i][j] = ends(e, 6 + i, 6 + j) - left[i][j] - turned[i][j];
        carried6(A, false, now, residual[0]);
        carried6(weight, true, residual, &white(e, 0, 0));
        carried6(A, false, alone, left[0]);
        carried6(weight, true, left, half[0]);
        for (int i = 0; i < 6; ++i) apart(e, i) = half[i][i];
    }
}

// The forms v' Q^-1 v of symmetric Q whose eigenvalues are all above `least`, as the trace of the inverse tells; else -1.
inline void sure_forms(In<double, 3> Q, In<double, 2> v, double least, Out<double, 1> form) {
    for (int64_t e = 0; e < form.n[0]; ++e) {
        Block L;
        double X[6][7] = {}, trace = 0.0, sum = 0.0;
        std::memcpy(L, &Q(e, 0, 0), sizeof L);
        for (int i = 0; i < 6; ++i) X[i][i] = 1.0, X[i][6] = v(e, i);
        form.data[e] = -1.0;
        if (!cholesky(L[0], 6, 6)) continue;
        forward_solve(L[0], 6, 6, X[0], 7);
        for (int i = 0; i < 6; ++i) {
            for (int j = 0; j <= i; ++j) trace += X[i][j] * X[i][j];
            sum += X[i][6] * X[i][6];
        }
        if (least * trace < 1.0) form.data[e] = sum;
    }
}

// Poses R (N, 3, 3), t (N, 3) along a tree, in place: given in those of their parents, -1 where in the world. order: parents
// first. Rotations stay so to the last digit, however long the way.
inline void compose_poses(Ints order, Ints parent, Out<double, 3> R, Out<double, 2> t) {
    for (int64_t index = 0; index < order.n[0]; ++index) {
        const int64_t n = order[index], p = parent[n];
        if (p < 0) continue;
        Mat turned, square;
        Vec shifted;
        for (int i = 0; i < 3; ++i) {
            shifted[i] = t(p, i) + R(p, i, 0) * t(n, 0) + R(p, i, 1) * t(n, 1) + R(p, i, 2) * t(n, 2);
            for (int j = 0; j < 3; ++j) turned[i][j] = R(p, i, 0) * R(n, 0, j) + R(p, i, 1) * R(n, 1, j) + R(p, i, 2) * R(n, 2, j);
        }
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                square[i][j] = i == j ? 1.5 : 0.0;
                for (int k = 0; k < 3; ++k) square[i][j] -= 0.5 * turned[k][i] * turned[k][j];
            }
        for (int i = 0; i < 3; ++i) {
            t(n, i) = shifted[i];
            for (int j = 0; j < 3; ++j) R(n, i, j) = turned[i][0] * square[0][j] + turned[i][1] * square[1][j] + turned[i][2] * square[2][j];
        }
    }
}

}  // namespace
