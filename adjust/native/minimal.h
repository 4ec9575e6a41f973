// Pose of several cameras from three rays to known points: all solutions (generalised P3P).
//
// With ray i from o_i along the unit vector d_i and the point at depth x_i, the three distances between the points give
// three quadratic equations (Nister and Stewenius, J. Math. Imaging Vis. 27, 2007). Two resultants leave a polynomial of
// degree 8 in one depth; its positive roots are bracketed by those of its derivatives, and every root is polished on the
// three equations, so that the polynomial only has to find the neighbourhood.
#pragma once
#include "vectors.h"

namespace {

constexpr int MAX_SOLUTIONS = 8;
constexpr double CLOSE = 2e-2;  // what an unpolished solution may miss the third equation by, in squared extents

template <int N> using Polynomial = std::array<double, N>;  // lowest coefficient first

inline double value_at(const double *c, int degree, double x) {
    double y = c[degree];
    for (int i = degree - 1; i >= 0; --i) y = y * x + c[i];
    return y;
}
// The root between lo and hi, where the signs differ: Newton, held by bisection.
inline double bracketed(const double *c, const double *slope_of, int degree, double lo, double hi, double at_lo) {
    double x = 0.5 * (lo + hi);
    for (int i = 0; i < 60; ++i) {
        const double f = value_at(c, degree, x), slope = value_at(slope_of, degree - 1, x);
        ((f > 0.0) == (at_lo > 0.0) ? lo : hi) = x;
        double next = slope != 0.0 ? x - f / slope : lo;
        if (!(lo < next && next < hi)) next = 0.5 * (lo + hi);
        if (magnitude(next - x) <= 1e-13 * (1.0 + magnitude(x))) return next;
        x = next;
    }
    return x;
}
// Roots of a polynomial between lo and hi, ascending, and extrema that nearly touch zero: double roots lost to rounding.
template <int N> inline int real_roots(const Polynomial<N> &c, double lo, double hi, double (&out)[2 * N]) {
    constexpr int n = N - 1;
    double chain[N][N] = {}, stops[N + 1], found[N + 1];  // chain[k]: the derivative of degree k
    for (int i = 0; i <= n; ++i) chain[n][i] = c[i];
    for (int k = n - 1; k > 0; --k)
        for (int i = 0; i <= k; ++i) chain[k][i] = chain[k + 1][i + 1] * (i + 1);
    int m = 0;
    for (int k = 1; k <= n; ++k) {
        const int count = m + 2;
        stops[0] = lo;
        for (int i = 0; i < m; ++i) stops[i + 1] = found[i];
        stops[m + 1] = hi;
        m = 0;
        for (int i = 0; i + 1 < count; ++i) {
            const double a = value_at(chain[k], k, stops[i]), b = value_at(chain[k], k, stops[i + 1]);
            if (a == 0.0) found[m++] = stops[i];
            else if ((a > 0.0) != (b > 0.0)) found[m++] = bracketed(chain[k], chain[k - 1], k, stops[i], stops[i + 1], a);
        }
        if (k < n) continue;
        int total = 0;
        for (int i = 0; i < m; ++i) out[total++] = found[i];
        for (int i = 1; i + 1 < count; ++i) {
            double size = 0.0, power = 1.0;
            for (int j = 0; j <= n; ++j, power *= magnitude(stops[i])) size += magnitude(c[j]) * power;
            if (magnitude(value_at(c.data(), n, stops[i])) < 1e-7 * size && total < 2 * N) out[total++] = stops[i];
        }
        return total;
    }
    return 0;
}

template <size_t A, size_t B> inline auto operator*(const std::array<double, A> &a, const std::array<double, B> &b) {
    std::array<double, A + B - 1> o{};
    for (size_t i = 0; i < A; ++i)
        for (size_t j = 0; j < B; ++j) o[i + j] += a[i] * b[j];
    return o;
}
template <size_t A> inline auto operator*(double f, const std::array<double, A> &a) { return std::array<double, 1>{f} * a; }
template <size_t A, size_t B> inline auto operator+(const std::array<double, A> &a, const std::array<double, B> &b) {
    std::array<double, (A > B ? A : B)> o{};
    for (size_t i = 0; i < A; ++i) o[i] += a[i];
    for (size_t i = 0; i < B; ++i) o[i] += b[i];
    return o;
}
template <size_t A, size_t B> inline auto operator-(const std::array<double, A> &a, const std::array<double, B> &b) { return a + -1.0 * b; }

typedef double Equations[3][4];  // x^2 + y^2 + k0 x y + k1 x + k2 y + k3 of the pairs 01, 12, 02

// Polynomial of degree 8 in the depth y of ray 1. Pair 01 is x^2 + B1(y) x + C1(y), pair 02 x^2 + B2(z) x + C2(z), pair 12
// z^2 + B3(y) z + C3(y).
inline Polynomial<9> octic(const Equations &k) {
    const Polynomial<2> b1{k[0][1], k[0][0]}, b3{k[1][2], k[1][0]};
    const Polynomial<3> c1{k[0][3], k[0][2], 1.0}, c3{k[1][3], k[1][1], 1.0};
    const Polynomial<1> p{k[2][1]}, q{k[2][0]}, r{k[2][3]}, s{k[2][2]};  // B2 = p + q z, C2 = r + s z + z^2
    const auto e = r - c3;  // z^2 = -B3 z - C3: C2 = e + f z
    const auto f = s - b3;
    // resultant (C1 - C2)^2 + (B1 - B2)(B1 C2 - B2 C1) as g0 + g1 z + g2 z^2
    const auto u = c1 - e;
    const auto v = b1 - p;
    const auto w0 = b1 * e - p * c1;
    const auto w1 = b1 * f - q * c1;
    const auto g0 = u * u + v * w0;
    const auto g1 = v * w1 - 2.0 * (u * f) - q * w0;
    const auto g2 = f * f - q * w1;
    const auto P = g0 - g2 * c3;
    const auto Q = g1 - g2 * b3;
    return P * P - P * Q * b3 + Q * Q * c3;
}
inline double equation(const double *k, double x, double y) { return x * x + y * y + k[0] * x * y + k[1] * x + k[2] * y + k[3]; }

// Newton on the three equations; whether it settled.
inline bool polish(const Equations &k, double *depths) {
    for (int i = 0; i < 12; ++i) {
        const double x = depths[0], y = depths[1], z = depths[2];
        const double f0 = equation(k[0], x, y), f1 = equation(k[1], y, z), f2 = equation(k[2], x, z);
        const double a = 2 * x + k[0][0] * y + k[0][1], b = 2 * y + k[0][0] * x + k[0][2];
        const double c = 2 * y + k[1][0] * z + k[1][1], d = 2 * z + k[1][0] * y + k[1][2];
        const double e = 2 * x + k[2][0] * z + k[2][1], g = 2 * z + k[2][0] * x + k[2][2];
        const double det = a * c * g + b * d * e;  // rows (a, b, 0), (0, c, d), (e, 0, g)
        if (magnitude(det) < 1e-14) return false;
        const double dx = (f0 * c * g - b * (f1 * g - d * f2)) / det;
        const double dy = (a * (f1 * g - d * f2) + d * e * f0) / det;
        const double dz = (a * c * f2 - c * e * f0 + b * e * f1) / det;
        depths[0] -= dx, depths[1] -= dy, depths[2] -= dz;
        if (magnitude(dx) + magnitude(dy) + magnitude(dz) < 1e-11 * (1.0 + magnitude(x) + magnitude(y) + magnitude(z))) return true;
    }
    return false;
}
// Columns of out: the frame of a triangle; returns the sine at its first corner.
inline double triad(const double *a, const double *b, const double *c, Mat &out) {
    Vec p, q, n, m;
    for (int i = 0; i < 3; ++i) p[i] = b[i] - a[i], q[i] = c[i] - a[i];
    const double length = root(dot3(p, p));
    for (double &x : p) x /= length;
    cross3(p, q, n);
    const double size = root(dot3(n, n));
    for (double &x : n) x /= size;
    cross3(n, p, m);
    for (int i = 0; i < 3; ++i) out[i][0] = p[i], out[i][1] = m[i], out[i][2] = n[i];
    return size / root(dot3(q, q));
}
inline double largest(const double *x) { return larger(larger(magnitude(x[0]), magnitude(x[1])), magnitude(x[2])); }
inline bool known(const double (*solutions)[3], int n, const double *depths) {
    double closest = __builtin_inf();
    for (int i = 0; i < n; ++i) {
        const Vec d = {solutions[i][0] - depths[0], solutions[i][1] - depths[1], solutions[i][2] - depths[2]};
        closest = smaller(closest, largest(d));
    }
    return closest < 1e-6 * (1.0 + largest(depths));
}

// All poses world_from_station (R, t) with points x on rays o, d at depths nearest to farthest (m); their number, zero
// for points on one line.
inline int three_point_poses(const Mat &o, const Mat &d, const Mat &x, double nearest, double farthest, Mat *R, Vec *t) {
    constexpr int PAIRS[3][2] = {{0, 1}, {1, 2}, {0, 2}};
    Mat frame, own;
    const double scale = larger(larger(distance(x[0], x[1]), distance(x[1], x[2])), distance(x[0], x[2]));
    if (!(scale > 0.0) || !(triad(x[0], x[1], x[2], frame) > 1e-3)) return 0;
    Equations k;
    for (int row = 0; row < 3; ++row) {
        const int i = PAIRS[row][0], j = PAIRS[row][1];
        const Vec apart = {(o[i][0] - o[j][0]) / scale, (o[i][1] - o[j][1]) / scale, (o[i][2] - o[j][2]) / scale};
        const double far = distance(x[i], x[j]) / scale;
        k[row][0] = -2.0 * dot3(d[i], d[j]), k[row][1] = 2.0 * dot3(d[i], apart), k[row][2] = -2.0 * dot3(d[j], apart);
        k[row][3] = dot3(apart, apart) - far * far;
    }
    double roots[18], solutions[MAX_SOLUTIONS][3];
    const int n_roots = real_roots<9>(octic(k), 0.0, farthest / scale, roots);
    int n = 0;
    for (int i = 0; i < n_roots; ++i) {
        const double y = roots[i], hx = -0.5 * (k[0][0] * y + k[0][1]), hz = -0.5 * (k[1][0] * y + k[1][2]);
        const double sx = root(larger(hx * hx - (y * y + k[0][2] * y + k[0][3]), 0.0));
        const double sz = root(larger(hz * hz - (y * y + k[1][1] * y + k[1][3]), 0.0));
        for (int side = 0; side < 4; ++side) {
            Vec depths = {hx + (side & 1 ? sx : -sx), y, hz + (side & 2 ? sz : -sz)};
            if (magnitude(equation(k[2], depths[0], depths[2])) > CLOSE * (1.0 + y * y) || !polish(k, depths)) continue;
            const double least = smaller(smaller(depths[0], depths[1]), depths[2]), most = larger(larger(depths[0], depths[1]), depths[2]);
            if (least * scale < nearest || most * scale > farthest || known(solutions, n, depths) || n == MAX_SOLUTIONS) continue;
            std::memcpy(solutions[n++], depths, sizeof depths);
        }
    }
    int kept = 0;
    for (int i = 0; i < n; ++i) {
        Mat p;
        for (int a = 0; a < 3; ++a)
            for (int b = 0; b < 3; ++b) p[a][b] = o[a][b] + d[a][b] * solutions[i][a] * scale;
        if (!(triad(p[0], p[1], p[2], own) > 1e-4)) continue;
        for (int a = 0; a < 3; ++a)
            for (int b = 0; b < 3; ++b) R[kept][a][b] = dot3(frame[a], own[b]);
        for (int a = 0; a < 3; ++a) t[kept][a] = x[0][a] - dot3(R[kept][a], p[0]);
        ++kept;
    }
    return kept;
}
inline int64_t three_point_problem(In<double, 2> o, In<double, 2> d, In<double, 2> x, double nearest, double farthest, Out<double, 3> R,
                                   Out<double, 2> t) {
    Mat origin, ray, point, turns[MAX_SOLUTIONS];
    Vec shifts[MAX_SOLUTIONS];
    std::memcpy(origin, o.data, sizeof origin), std::memcpy(ray, d.data, sizeof ray), std::memcpy(point, x.data, sizeof point);
    const int n = three_point_poses(origin, ray, point, nearest, farthest, turns, shifts);
    std::memcpy(R.data, turns, sizeof(Mat) * n), std::memcpy(t.data, shifts, sizeof(Vec) * n);
    return n;
}

}  // namespace
