// Tests and reliability of image points, one after the other: what Python has in adjust.testing.single_tests, for two
// components in closed form.
#pragma once
#include "lanes.h"

namespace {

constexpr double CONTROLLED = 1e-6;  // share of an error that must show in the residuals to be told from rounding

// Points first .. last - 1 with residuals v px, whitened A Q A' (00, 01, 11), square root information W (00, 01, 11).
struct AdjustedPoints {
    explicit AdjustedPoints(Reader &r) : v(r), M(r), W(r), used(r) {}
    In<double, 2> v, M, W;
    In<bool, 1> used;
};

inline double not_a_number() { return __builtin_nan(""); }

// Eigenvalues k of the cofactors K (ascending) with unit vectors (x, y) and (-y, x).
struct Directions {
    double k[2], x, y;

    Directions(double a, double b, double c, bool used) {
        const double mean = 0.5 * (a + c), d = 0.5 * (a - c), half = root(d * d + b * b);
        const double of_M[2] = {mean + half, mean - half};
        for (int i = 0; i < 2; ++i) k[i] = used ? 1.0 - of_M[i] : 1.0 / (1.0 + larger(of_M[i], 0.0));
        x = 1.0, y = 0.0;
        if (half <= 0.0) return;
        if (d >= 0.0) x = root(0.5 * (1.0 + d / half)), y = 0.5 * b / (half * x);
        else y = (b < 0.0 ? -1.0 : 1.0) * root(0.5 * (1.0 - d / half)), x = 0.5 * b / (half * y);
    }
    Directions(const AdjustedPoints &P, int64_t i) : Directions(P.M(i, 0), P.M(i, 1), P.M(i, 2), P.used[i]) {}
    bool controlled(int i) const { return k[i] > CONTROLLED; }
    int freedom() const { return int(controlled(0)) + int(controlled(1)); }
    // x' K y for unit vectors along the axes: 00, 01, 11.
    void cofactors(double *K) const {
        K[0] = k[0] * x * x + k[1] * y * y, K[1] = (k[0] - k[1]) * x * y, K[2] = k[0] * y * y + k[1] * x * x;
    }
};

// Inverse of an upper triangular W.
struct Back {
    double b00, b01, b11;

    Back(const AdjustedPoints &P, int64_t i) : b00(1.0 / P.W(i, 0)), b11(1.0 / P.W(i, 2)) { b01 = -P.W(i, 1) * b00 * b11; }
    void times(double x, double y, double *out) const { out[0] = b00 * x + b01 * y, out[1] = b11 * y; }
};

// Redundancy numbers of the whitened components (0 where not used), residuals over their sigmas, and v' inv(Q_vv) v; nan
// where nothing controls the point (Baarda 1968; Foerstner 1979).
inline void residual_tests(int64_t first, int64_t last, AdjustedPoints P, Out<double, 2> redundancy, Out<double, 2> standardized,
                           Out<double, 1> test) {
    for (int64_t i = first; i < last; ++i) {
        const bool used = P.used[i];
        const double sign = used ? -1.0 : 1.0, v0 = P.v(i, 0), v1 = P.v(i, 1), w00 = P.W(i, 0), w01 = P.W(i, 1), w11 = P.W(i, 2);
        const double q00 = 1.0 + sign * P.M(i, 0), q01 = sign * P.M(i, 1), q11 = 1.0 + sign * P.M(i, 2);
        redundancy(i, 0) = used ? q00 : 0.0, redundancy(i, 1) = used ? q11 : 0.0;
        const double e0 = w00 * v0 + w01 * v1, e1 = w11 * v1, det = q00 * q11 - q01 * q01;
        test.data[i] = det > 1e-9 ? (q11 * e0 * e0 - 2 * q01 * e0 * e1 + q00 * e1 * e1) / det : not_a_number();
        const Back b(P, i);  // the covariance of the residuals in pixels is inv(W) Q inv(W)'
        const double su = root(larger(0.0, b.b00 * b.b00 * q00 + 2 * b.b00 * b.b01 * q01 + b.b01 * b.b01 * q11));
        const double sv = root(larger(0.0, b.b11 * b.b11 * q11));
        standardized(i, 0) = su > 1e-9 * b.b00 ? v0 / su : not_a_number();
        standardized(i, 1) = sv > 1e-9 * b.b11 ? v1 / sv : not_a_number();
    }
}

// Of the listed blocks (points ptr[b] .. ptr[b + 1] - 1): components in use, their redundancy, their weighted square sum.
inline void sums_of_blocks(Ints which, Ints ptr, AdjustedPoints P, Out<double, 2> sums) {
    for (int64_t k = 0; k < which.n[0]; ++k) {
        double n = 0.0, redundancy = 0.0, squares = 0.0;
        for (int64_t i = ptr[which[k]]; i < ptr[which[k] + 1]; ++i) {
            if (!P.used[i]) continue;
            const double e0 = P.W(i, 0) * P.v(i, 0) + P.W(i, 1) * P.v(i, 1), e1 = P.W(i, 2) * P.v(i, 1);
            n += 2.0, redundancy += (1.0 - P.M(i, 0)) + (1.0 - P.M(i, 2)), squares += e0 * e0 + e1 * e1;
        }
        sums(which[k], 0) = n, sums(which[k], 1) = redundancy, sums(which[k], 2) = squares;
    }
}

// Distance of the farthest point of each listed block from its centre; zero without points.
inline void farthest_points(Ints which, Ints ptr, In<double, 2> uv, In<double, 2> centre, Out<double, 1> farthest) {
    for (int64_t k = 0; k < which.n[0]; ++k) {
        const int64_t b = which[k];
        double most = 0.0;
        for (int64_t i = ptr[b]; i < ptr[b + 1]; ++i) {
            const double x = uv(i, 0) - centre(b, 0), y = uv(i, 1) - centre(b, 1);
            most = larger(most, x * x + y * y);
        }
        farthest.data[b] = root(most);
    }
}

// Controlled directions of every point.
inline void controlled_directions(int64_t first, int64_t last, AdjustedPoints P, Out<int64_t, 1> freedom) {
    for (int64_t i = first; i < last; ++i) freedom.data[i] = Directions(P, i).freedom();
}

// Length of the least detectable bias in sigmas, along the weakest direction that is controlled, and how far it moves the unknowns.
struct LeastBias {
    int freedom;
    double weakest, size, moved;

    LeastBias(const Directions &d, bool used, Vector lambda0) : freedom(d.freedom()) {
        constexpr double none = __builtin_inf();
        weakest = d.controlled(0) ? d.k[0] : freedom ? d.k[1] : none, size = freedom ? root(lambda0[freedom - 1] / weakest) : none;
        moved = !used ? 0.0 : freedom ? size * root(larger(1.0 - weakest, 0.0)) : none;
    }
};

// External reliability of every point. lambda0: of tests with one and two components.
inline void external_reliability(int64_t first, int64_t last, AdjustedPoints P, Vector lambda0, Out<double, 1> external) {
    for (int64_t i = first; i < last; ++i) external.data[i] = LeastBias(Directions(P, i), P.used[i], lambda0).moved;
}

// The columns of TestColumns, by these names. lambda0: of tests with one and two components.
inline void point_tests(int64_t first, int64_t last, AdjustedPoints P, Vector lambda0, Out<double, 1> redundancy, Out<double, 1> least,
                        Out<double, 1> statistic, Out<double, 1> detectable, Out<double, 1> external, Out<double, 2> w, Out<double, 2> error,
                        Out<double, 2> detectable_component, Out<double, 2> bias) {
    constexpr double none = __builtin_inf();
    for (int64_t i = first; i < last; ++i) {
        const bool used = P.used[i];
        const double w00 = P.W(i, 0), w01 = P.W(i, 1), w11 = P.W(i, 2);
        double e[2] = {w00 * P.v(i, 0) + w01 * P.v(i, 1), w11 * P.v(i, 1)};
        const Directions d(P, i);
        const Back back(P, i);
        double K[3] = {1.0 - P.M(i, 0), -P.M(i, 1), 1.0 - P.M(i, 2)};
        if (!used) {
            d.cofactors(K);
            const double e0 = e[0];
            e[0] = K[0] * e0 + K[1] * e[1], e[1] = K[1] * e0 + K[2] * e[1];
        }
        const double along[2] = {d.x * e[0] + d.y * e[1], -d.y * e[0] + d.x * e[1]};
        double over[2] = {}, T = 0.0;
        for (int j = 0; j < 2; ++j)
            if (d.controlled(j)) over[j] = along[j] / d.k[j], T += along[j] * over[j];
        const auto [freedom, weakest, size, moved] = LeastBias(d, used, lambda0);
        redundancy.data[i] = used ? K[0] + K[2] : 0.0;
        least.data[i] = smaller(larger(d.k[0], 0.0), 1.0);
        statistic.data[i] = freedom ? T : not_a_number();
        back.times(-d.x * over[0] + d.y * over[1], -d.y * over[0] - d.x * over[1], &error(i, 0));
        detectable.data[i] = size;
        external.data[i] = moved;
        double x = d.x, y = d.y;
        if (!d.controlled(0)) x = -d.y, y = d.x;
        const double turn = (magnitude(x) >= magnitude(y) ? x : y) < 0.0 ? -size : size;  // the largest component is positive
        back.times(turn * x, turn * y, &bias(i, 0));
        if (!freedom) error(i, 0) = error(i, 1) = bias(i, 0) = bias(i, 1) = not_a_number();
        const double numerator[2] = {w00 * e[0], w01 * e[0] + w11 * e[1]}, own[2] = {w00 * w00, w01 * w01 + w11 * w11};
        const double information[2] = {w00 * w00 * K[0], w01 * w01 * K[0] + 2 * w01 * w11 * K[1] + w11 * w11 * K[2]};
        for (int j = 0; j < 2; ++j) {
            const bool seen = information[j] > CONTROLLED * own[j];
            w(i, j) = seen ? -numerator[j] / root(information[j]) : not_a_number();
            detectable_component(i, j) = seen ? root(lambda0[0] / information[j]) : none;
        }
    }
}

}  // namespace
