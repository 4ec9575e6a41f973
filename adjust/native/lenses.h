// The lens models, each written once: values alone or with derivatives, by the type of the numbers given.
//
// residual(p, c, X, Y, Z, u, v): predicted minus observed, px, of a point X, Y, Z in the camera (m; x right, y down,
// z forward) seen at u, v. p: the parameters in the order of adjust.lenses.models. c: pixel size (mm), image centre u and v (px),
// balance radius (mm). A new model is one such function and one line in with_lens below.
#pragma once
#include "jets.h"

namespace {

constexpr int MAX_LENS = 14;          // room for the parameters of a model
constexpr int N_COLUMNS = MAX_LENS + 3;  // and for the three of the point

// Brown (1971) with OpenCV's rational radial part.
struct Brown {
    static constexpr int n = 13;
    template <class P, class Q0, class Q1, class Q2, class U>
    [[gnu::always_inline]] static auto residual(const P &p, const double *, Q0 X, Q1 Y, Q2 Z, U u, U v) {
        const auto &[fx, fy, skew, u0, v0, k1, k2, p1, p2, k3, k4, k5, k6] = p;
        const auto iz = 1.0 / divisible(Z);
        const auto x = X * iz;
        const auto y = Y * iz;
        const auto xx = x * x;
        const auto yy = y * y;
        const auto r = xx + yy;
        const auto xy2 = 2.0 * (x * y);
        const auto g = (1.0 + r * (k1 + r * (k2 + r * k3))) / (1.0 + r * (k4 + r * (k5 + r * k6)));
        const auto xd = x * g + p1 * xy2 + p2 * (r + 2.0 * xx);
        const auto yd = y * g + p1 * (r + 2.0 * yy) + p2 * xy2;
        return std::pair(fx * xd + skew * yd + u0 - u, fy * yd + v0 - v);
    }
};

// atan(s) / s as a polynomial in s^2 <= 0.172: error 1.8e-21 (Chebyshev, by mpmath.chebyfit with 60 digits).
constexpr double ATAN_RATIO[] = {1.0, -0.3333333333333333, 0.19999999999999848, -0.14285714285691545, 0.11111111109334992,
                                 -0.09090909007629767, 0.07692305155634285, -0.06666614028260175, 0.05881587772579439,
                                 -0.05255260852533939, 0.047039848221438, -0.04049515058817835, 0.029498774561895504,
                                 -0.012879325610452472};

// Equidistant, as OpenCV's fisheye (Kannala and Brandt 2006). theta / r = 8 atan(s) / r with s = tan(theta / 8), by two
// half angles: smooth on the axis, no series beside it, no branch, up to 180 degrees.
struct Fisheye {
    static constexpr int n = 9;
    template <class P, class Q0, class Q1, class Q2, class U>
    [[gnu::always_inline]] static auto residual(const P &p, const double *, Q0 X, Q1 Y, Q2 Z, U u, U v) {
        const auto &[fx, fy, skew, u0, v0, k1, k2, k3, k4] = p;
        const auto rr = X * X + Y * Y + SMALLEST_DEPTH * SMALLEST_DEPTH;
        const auto a = Z + root(rr + Z * Z);   // r / tan(theta / 2)
        const auto b = a + root(a * a + rr);   // r / tan(theta / 4)
        const auto c = b + root(b * b + rr);   // r / tan(theta / 8)
        const auto h = 8.0 * (polynomial(ATAN_RATIO, rr / (c * c)) / c);  // theta / r
        const auto t = rr * (h * h);           // theta^2
        const auto g = h * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4))));
        const auto x = X * g;
        const auto y = Y * g;
        return std::pair(fx * x + skew * y + u0 - u, fy * y + v0 - v);
    }
};

// The measured point x, y (mm) corrected by Brown's terms (Fraser 1997): K1 K2 K3 P1 P2.
template <class X, class Y, class K1, class K2, class K3, class P1, class P2>
[[gnu::always_inline]] inline auto corrected(X x, Y y, K1 k1, K2 k2, K3 k3, P1 p1, P2 p2) {
    const auto xx = x * x;
    const auto yy = y * y;
    const auto r = xx + yy;
    const auto xy2 = 2.0 * (x * y);
    const auto g = 1.0 + r * (k1 + r * (k2 + r * k3));
    return std::pair(x * g + p1 * (r + 2.0 * xx) + p2 * xy2, y * g + p2 * (r + 2.0 * yy) + p1 * xy2);
}

// Correction of the measured point, y up, as in Australis; the residual is formed in the corrected plane.
struct BrownBackward {
    static constexpr int n = 10;
    template <class P, class Q0, class Q1, class Q2, class U>
    [[gnu::always_inline]] static auto residual(const P &p, const double *k, Q0 X, Q1 Y, Q2 Z, U u, U v) {
        const auto &[c, xp, yp, K1, K2, K3, P1, P2, B1, B2] = p;
        const auto x = (u - k[1]) * k[0] - xp;
        const auto y = (k[2] - v) * k[0] - yp;
        const auto [xc, yc] = corrected(x, y, K1, K2, K3, P1, P2);
        const auto cz = c / divisible(Z);
        const double scale = 1.0 / k[0];
        return std::pair((cz * X - (xc + B1 * x + B2 * y)) * scale, (cz * Y + yc) * scale);
    }
};

// The same with DBAT's affinity and origin: no half-pixel shift, x alone stretched.
struct BrownBackwardDbat {
    static constexpr int n = 9;
    template <class P, class Q0, class Q1, class Q2, class U>
    [[gnu::always_inline]] static auto residual(const P &p, const double *k, Q0 X, Q1 Y, Q2 Z, U u, U v) {
        const auto &[c, px, py, as, K1, K2, K3, P1, P2] = p;
        const auto x = (u * k[0] - px) * (1.0 + as);
        const auto y = py - v * k[0];
        const auto [xc, yc] = corrected(x, y, K1, K2, K3, P1, P2);
        const auto cz = c / divisible(Z);
        const double scale = 1.0 / k[0];
        return std::pair((cz * X - xc) * scale, (cz * Y + yc) * scale);
    }
};

// AICON's forward model: radial polynomial balanced at the radius k[3], evaluated at the ideal image point, y up.
struct Aicon {
    static constexpr int n = 10;
    template <class P, class Q0, class Q1, class Q2, class U>
    [[gnu::always_inline]] static auto residual(const P &p, const double *k, Q0 X, Q1 Y, Q2 Z, U u, U v) {
        const auto &[c, xh, yh, A1, A2, A3, B1, B2, C1, C2] = p;
        const auto cz = c / divisible(Z);
        const auto x = cz * X;
        const auto y = -(cz * Y);
        const auto xx = x * x;
        const auto yy = y * y;
        const auto r = xx + yy;
        const auto xy2 = 2.0 * (x * y);
        const double z = k[3] * k[3], scale = 1.0 / k[0];
        const auto g = 1.0 + A1 * (r - z) + A2 * (r * r - z * z) + A3 * (r * r * r - z * z * z);
        const auto xd = xh + x * g + B1 * (r + 2.0 * xx) + B2 * xy2 + C1 * x + C2 * y;
        const auto yd = yh + y * g + B2 * (r + 2.0 * yy) + B1 * xy2;
        return std::pair(xd * scale + k[1] - u, k[2] - v - yd * scale);
    }
};

// f with the lens model of this number, as adjust.native.lenses names them.
template <class F> inline auto with_lens(int64_t kind, F &&f) {
    switch (kind) {
        case 0: return f(Brown{});
        case 1: return f(Fisheye{});
        case 2: return f(BrownBackward{});
        case 3: return f(BrownBackwardDbat{});
        default: return f(Aicon{});
    }
}

template <class Lens, class S, class P> [[gnu::always_inline]] inline std::pair<S, S> lens_residual(const P &p, const double *c, const S (&q)[3], S u, S v) {
    return Lens::residual(p, c, q[0], q[1], q[2], u, v);
}
template <class Lens> inline std::array<double, Lens::n> parameters(const double *l) {
    std::array<double, Lens::n> p;
    for (int i = 0; i < Lens::n; ++i) p[i] = l[i];
    return p;
}

// Residual r and its derivatives d: by the parameters in 0.., by the point in MAX_LENS..; what is between is not touched.
template <class Lens, class S, size_t... I>
[[gnu::always_inline]] inline void lens_row(const double *l, const double *c, const S (&q)[3], S u, S v, S (&r)[2], S (&d)[2][N_COLUMNS],
                                            std::index_sequence<I...>) {
    const std::tuple p{Jet<S, 1u << I>{all<S>(l[I]), {all<S>(1)}}...};
    using X = Jet<S, 1u << MAX_LENS>;
    using Y = Jet<S, 2u << MAX_LENS>;
    using Z = Jet<S, 4u << MAX_LENS>;
    const auto found = Lens::residual(p, c, X{q[0], {all<S>(1)}}, Y{q[1], {all<S>(1)}}, Z{q[2], {all<S>(1)}}, u, v);
    const auto &a = found.first;
    const auto &b = found.second;
    r[0] = a.v, r[1] = b.v;
    constexpr unsigned every = ((1u << Lens::n) - 1) | (7u << MAX_LENS);
    [&]<size_t... K>(std::index_sequence<K...>) __attribute__((always_inline)) {
        ((d[0][bit(every, K)] = derivative<bit(every, K)>(a), d[1][bit(every, K)] = derivative<bit(every, K)>(b)), ...);
    }(Places<every>{});
}
template <class Lens, class S>
[[gnu::always_inline]] inline void lens_row(const double *l, const double *c, const S (&q)[3], S u, S v, S (&r)[2], S (&d)[2][N_COLUMNS]) {
    lens_row<Lens>(l, c, q, u, v, r, d, std::make_index_sequence<Lens::n>{});
}

// Points of one camera in its frame, one after the other: residuals (n, 2) and, unless rows is empty, derivatives.
inline void lens_rows(int64_t kind, Vector l, Vector c, In<double, 2> q, In<double, 2> uv, Out<double, 2> residuals, Out<double, 3> rows) {
    with_lens(kind, [&]<class Lens>(Lens) {
        const auto p = parameters<Lens>(l.data);
        for (int64_t i = 0; i < q.n[0]; ++i) {
            const double at[3] = {q(i, 0), q(i, 1), q(i, 2)};
            if (!rows.n[0]) {
                std::tie(residuals(i, 0), residuals(i, 1)) = lens_residual<Lens>(p, c.data, at, uv(i, 0), uv(i, 1));
                continue;
            }
            double r[2], d[2][N_COLUMNS] = {};
            lens_row<Lens>(l.data, c.data, at, uv(i, 0), uv(i, 1), r, d);
            for (int s = 0; s < 2; ++s) {
                residuals(i, s) = r[s];
                std::memcpy(&rows(i, s, 0), d[s], sizeof d[s]);
            }
        }
    });
}

// A zero of a function of x and y, by Newton from there; the determinant of the derivatives, or 0 where none was found. A
// step below `small`, relative to the unit of x and y, is the last one; what has arrived stays, whatever its neighbours do.
template <class F> [[gnu::always_inline]] inline V newton(const F &residual, int64_t iterations, double small, double unit, V &x, V &y) {
    V going = all<V>(1), found = V{};
    for (int64_t n = 0; n < iterations && any(going != 0.0); ++n) {
        const auto [a, b] = residual(x, y);
        const V ax = derivative<0>(a), ay = derivative<1>(a), bx = derivative<0>(b), by = derivative<1>(b);
        const V determinant = ax * by - ay * bx, inverse = 1.0 / determinant;
        const V dx = (by * a.v - ay * b.v) * inverse, dy = (ax * b.v - bx * a.v) * inverse;
        x = going != 0.0 ? x - dx : x, y = going != 0.0 ? y - dy : y;
        const auto arrived = larger(magnitude(dx), magnitude(dy)) <= small * (unit + larger(magnitude(x), magnitude(y)));
        found = going != 0.0 ? determinant : found;
        going = arrived ? V{} : going;
    }
    return going == 0.0 ? found : V{};
}
// Unit rays of image points first .. last - 1, by Newton on the projection from tangents x/z, y/z, or where there are none
// from the axis; solved: those within `widest` (a tangent) of the axis, where the image is not turned over.
inline void rays_of(int64_t first, int64_t last, int64_t kind, Vector l, Vector c, In<double, 2> uv, In<double, 2> start, int64_t iterations,
                    double small, double widest, Out<double, 2> rays, Out<bool, 1> solved) {
    with_lens(kind, [&]<class Lens>(Lens) {
        const auto p = parameters<Lens>(l.data);
        for (int64_t lo = first; lo < last; lo += W) {
            V x = V{}, y = V{}, u, v;
            for (int i = 0; i < W; ++i) {  // the last one again behind the end
                const int64_t k = smaller(lo + i, last - 1);
                u[i] = uv(k, 0), v[i] = uv(k, 1);
                if (start.n[0]) x[i] = start(k, 0), y[i] = start(k, 1);
            }
            const auto residual = [&](V a, V b) __attribute__((always_inline)) {
                return Lens::residual(p, c.data, Jet<V, 1u>{a, {all<V>(1)}}, Jet<V, 2u>{b, {all<V>(1)}}, all<V>(1), u, v);
            };
            const V determinant = newton(residual, iterations, small, 1.0, x, y);
            const V square = x * x + y * y, z = 1.0 / root(1.0 + square);
            for (int i = 0; i < W && lo + i < last; ++i) {
                rays(lo + i, 0) = x[i] * z[i], rays(lo + i, 1) = y[i] * z[i], rays(lo + i, 2) = z[i];
                solved.data[lo + i] = determinant[i] > 0.0 && square[i] <= widest * widest;
            }
        }
    });
}
// Image points of points q in the camera, by Newton from what is in uv, whose tangents are of size 1 / focal; solved: as above.
inline void image_points_of(int64_t first, int64_t last, int64_t kind, Vector l, Vector c, In<double, 2> q, int64_t iterations, double small,
                            double focal, Out<double, 2> uv, Out<bool, 1> solved) {
    with_lens(kind, [&]<class Lens>(Lens) {
        const auto p = parameters<Lens>(l.data);
        for (int64_t lo = first; lo < last; lo += W) {
            V X, Y, Z, u, v;
            for (int i = 0; i < W; ++i) {
                const int64_t k = smaller(lo + i, last - 1);
                X[i] = q(k, 0), Y[i] = q(k, 1), Z[i] = q(k, 2), u[i] = uv(k, 0), v[i] = uv(k, 1);
            }
            const auto residual = [&](V a, V b) __attribute__((always_inline)) {
                return Lens::residual(p, c.data, X, Y, Z, Jet<V, 3u>{a, {all<V>(1), V{}}}, Jet<V, 3u>{b, {V{}, all<V>(1)}});
            };
            const V determinant = newton(residual, iterations, small, focal, u, v);
            for (int i = 0; i < W && lo + i < last; ++i) {
                uv(lo + i, 0) = u[i], uv(lo + i, 1) = v[i];
                solved.data[lo + i] = determinant[i] > 0.0;
            }
        }
    });
}
// Radii first .. last - 1 at which r N(r^2) / D(r^2), N and D with ascending coefficients, growing up to `limit`, has the value of
// the target, by Newton inside a bracket that shrinks; where it does not get there, the limit, and not found.
inline void radii_of(int64_t first, int64_t last, Vector numerator, Vector denominator, double limit, Vector target, Out<double, 1> radii,
                     Out<bool, 1> found) {
    const auto value = [&](double r) {
        const Jet<double, 1u> x{r, {1.0}}, w = x * x;
        const auto series = [&](const Vector &c) {
            Jet<double, 1u> sum{0.0, {0.0}};
            for (int64_t i = c.n[0]; i-- > 0;) sum = sum * w + c.data[i];
            return sum;
        };
        return x * series(numerator) / series(denominator);
    };
    for (int64_t k = first; k < last; ++k) {
        const double t = target.data[k];
        double low = 0.0, high = limit * (1.0 - 1e-13);  // a hair inside, where a vanishing denominator would be infinite
        if (limit == __builtin_inf())
            for (high = larger(t, 1e-6); value(high).v < t && high < 1e12;) high *= 2.0;
        found.data[k] = value(high).v >= t;
        double r = found.data[k] ? smaller(t, high) : high, step = high;
        for (int n = 0; n < 200 && found.data[k] && step > 4e-16 * r; ++n) {
            const auto f = value(r);
            if (f.v == t) break;
            (f.v > t ? high : low) = r;
            double better = r - (f.v - t) / f.d[0];
            if (!(better >= low && better <= high)) better = 0.5 * (low + high);
            step = magnitude(better - r), r = better;
        }
        radii.data[k] = r;
    }
}

}  // namespace
