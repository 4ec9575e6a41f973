// Least-squares fit of two blurred edges that meet in a corner.
//
// A Gaussian point spread turns the wedge between two edges into the bivariate normal distribution function of the
// distances h, k to them (in units of the blur) with the cosine of their normals as correlation. That is exact for edges
// at any angle, where the product of two error functions holds for perpendicular ones only.
#pragma once
#include "fits.h"

namespace {

constexpr int CORNER = 9;      // u, v, angle 1, angle 2, level, step, log(blur), slope u, slope v
constexpr double FAR = 4.5;    // standard deviations beyond which an edge no longer bends the other one's profile (by 1e-5)
constexpr int MOST_PIXELS = 6000;

// Distribution function p and density g of the normal distribution, p good to 1e-13: beyond |x| lies the density times a
// polynomial in 1 / (1 + 0.32 |x|), fitted to Mills' ratio for the least largest error of p.
template <class S> [[gnu::always_inline]] inline void normal(S x, S &p, S &g) {
    constexpr double c[] = {0.03513874263870758, -0.30502872614494686, 1.1307477442288458, -2.259253627287315, 2.529472482220283, -1.6886832911629654,
                            1.1345438156564023, -0.024894090843939013, 0.3900430646343338, 0.3106669893685816, 0.0005610340077180601};
    const S far = all<S>(37.0), z = where(magnitude(x) < far, magnitude(x), far), t = 1.0 / (1.0 + 0.32 * z);
    g = 0.3989422804014327 * exponential(-0.5 * z * z);
    S ratio = all<S>(c[0]);
    for (int i = 1; i < 11; ++i) ratio = ratio * t + c[i];
    p = where(x > 0.0, 1.0 - g * ratio, g * ratio);
}

// Nodes on (0, 1) and weights of Gauss and Legendre with 3, 4 and 6 nodes (Abramowitz and Stegun 1964, table 25.4).
constexpr double GAUSS[3][2][6] = {
    {{0.1127016653792583, 0.5, 0.8872983346207417}, {0.5555555555555556, 0.8888888888888888, 0.5555555555555556}},
    {{0.06943184420297371, 0.33000947820757187, 0.6699905217924281, 0.9305681557970262},
     {0.34785484513745385, 0.6521451548625461, 0.6521451548625461, 0.34785484513745385}},
    {{0.033765242898423986, 0.16939530676686774, 0.38069040695840156, 0.6193095930415985, 0.8306046932331322, 0.966234757101576},
     {0.17132449237917036, 0.3607615730481386, 0.46791393457269104, 0.46791393457269104, 0.3607615730481386, 0.17132449237917036}}};

// What the pixels of a corner share: directions, 1 / blur, turn, correlation, and the nodes of the integral, so many that
// it is good to 1e-7 (3e-6 where edges meet at less than 20 degrees).
struct Wedge {
    const double *p;
    bool crossing;
    double c1, s1, c2, s2, scale, turn, rho, c;
    int nodes;
    double power[6], twice_sine[6], weight[6];

    Wedge(const double *at, bool four) : p(at), crossing(four) {
        c1 = std::cos(p[2]), s1 = std::sin(p[2]), c2 = std::cos(p[3]), s2 = std::sin(p[3]);
        scale = std::exp(-p[6]), turn = std::sin(p[3] - p[2]);
        rho = smaller(larger(-std::cos(p[3] - p[2]), -0.95), 0.95);
        c = 1.0 / root(1.0 - rho * rho);
        const int which = magnitude(rho) < 0.3 ? 0 : magnitude(rho) < 0.6 ? 1 : 2;
        nodes = which == 2 ? 6 : 3 + which;
        const double top = std::asin(rho);
        for (int i = 0; i < nodes; ++i) {
            const double t = top * GAUSS[which][0][i], cosine = std::cos(t);
            power[i] = -0.5 / (cosine * cosine);
            twice_sine[i] = 2.0 * std::sin(t);
            weight[i] = GAUSS[which][1][i] * top / (4.0 * M_PI);
        }
    }

    // Grey value at (x, y) px from the window's centre, and its derivatives by the parameters; of one pixel or of several
    // side by side. The bivariate distribution function and its derivatives by h, k, rho: Drezner and Wesolowsky 1990.
    template <class S> S operator()(S x, S y, S *d) const {
        const S dx = x - p[0], dy = y - p[1], h = (c1 * dy - s1 * dx) * scale, k = (s2 * dx - c2 * dy) * scale;
        const double b = p[5];
        S ph, gh, pk, gk, dr = all<S>(0.0);
        normal(h, ph, gh), normal(k, pk, gk);
        S f = ph * pk, dh = gh * pk, dk = gk * ph;
        const S reach = where(magnitude(h) > magnitude(k), magnitude(h), magnitude(k));
        const auto near = reach <= FAR;
        if (any(near)) {
            const S square = h * h + k * k, product = h * k;
            S total = all<S>(0.0), by_h, by_k, density, unused;
            for (int i = 0; i < nodes; ++i) {
                const S power_of = (square - twice_sine[i] * product) * power[i];
                total += weight[i] * exponential(where(power_of > -700.0, power_of, all<S>(-700.0)));
            }
            normal<S>((k - rho * h) * c, by_h, density), normal<S>((h - rho * k) * c, by_k, unused);
            // the density of both is that of h times that of k where h is given
            f = where(near, f + total, f), dh = where(near, gh * by_h, dh), dk = where(near, gk * by_k, dk);
            dr = where(near, gh * density * c, dr);
        }
        if (crossing) {
            f = 4.0 * f - 2.0 * ph - 2.0 * pk + 1.0;
            dh = 4.0 * dh - 2.0 * gh, dk = 4.0 * dk - 2.0 * gk, dr = 4.0 * dr;
        }
        d[0] = b * scale * (dh * s1 - dk * s2);
        d[1] = b * scale * (dk * c2 - dh * c1);
        d[2] = b * (-dh * scale * (c1 * dx + s1 * dy) - dr * turn);
        d[3] = b * (dk * scale * (c2 * dx + s2 * dy) + dr * turn);
        d[4] = all<S>(1.0), d[5] = f, d[6] = -b * (dh * h + dk * k), d[7] = x, d[8] = y;
        return p[4] + b * f + p[7] * x + p[8] * y;
    }
};

struct Collected {
    alignas(64) double x[MOST_PIXELS], y[MOST_PIXELS], value[MOST_PIXELS];
};

// The pixels of a corner: a disc, and strips along its edges; their number, -1 at the border. shape: radius of the disc,
// half width of the strips, length of strip 1, length of strip 2, in px.
inline int corner_window(In<float, 2> image, int64_t u0, int64_t v0, const double *p, const double *shape, bool crossing, Collected &out) {
    const double radius = shape[0], width = shape[1], c[2] = {std::cos(p[2]), std::cos(p[3])}, s[2] = {std::sin(p[2]), std::sin(p[3])};
    const double extent = larger(radius, larger(shape[2], shape[3]) + width);
    if (!(magnitude(extent) < LARGEST_WINDOW)) return -1;
    const int reach = int(std::ceil(extent));
    int n = 0;
    for (int j = -reach; j <= reach; ++j)
        for (int i = -reach; i <= reach; ++i) {
            const double dx = i - p[0], dy = j - p[1];
            bool inside = dx * dx + dy * dy <= radius * radius;
            for (int a = 0; a < 2 && !inside && width > 0.0; ++a) {
                const double along = c[a] * dx + s[a] * dy, across = c[a] * dy - s[a] * dx;
                inside = magnitude(across) <= width && (crossing ? -shape[2 + a] : -width) <= along && along <= shape[2 + a];
            }
            if (!inside) continue;
            const int64_t u = u0 + i, v = v0 + j;
            if (u < 0 || v < 0 || u >= image.n[1] || v >= image.n[0]) return -1;
            if (n == MOST_PIXELS) return n;
            out.x[n] = i, out.y[n] = j, out.value[n++] = image(v, u);
        }
    return n;
}

// Level and step of p by linear regression on the shape of the start, and the normal equations there: those of level zero
// and step one, of which the other columns are multiples.
template <class Evaluate> inline void start_levels(double *p, int n, const Evaluate &evaluate, Normals<CORNER> &at) {
    p[4] = 0.0, p[5] = 1.0, p[7] = p[8] = 0.0;
    evaluate(p, at);
    const double f1 = at.H[4][5], f2 = at.H[5][5], v1 = at.g[4] + f1, fv = at.g[5] + f2, det = n * f2 - f1 * f1;
    p[5] = det > 1e-9 ? (n * fv - f1 * v1) / det : 0.0;
    p[4] = (v1 - p[5] * f1) / n;
    const double more = p[5] - 1.0;
    at.cost += p[4] * (p[4] * n - 2.0 * at.g[4]) + more * (more * f2 + 2.0 * p[4] * f1 - 2.0 * at.g[5]);
    for (int i = 0; i < CORNER; ++i) at.g[i] -= p[4] * at.H[i][4] + more * at.H[i][5];
    for (const int i : {0, 1, 2, 3, 6}) {
        at.g[i] *= p[5];
        for (int j = 0; j < CORNER; ++j) at.H[i][j] *= p[5], at.H[j][i] *= p[5];
    }
}

enum CornerStatus : int64_t { GOOD, AT_BORDER, TOO_FEW, NO_CONVERGENCE, AWAY };

// Every corner: start (n, 2) px, angles (n, 2) of the two edges, the second clockwise (in the image) of the first, blur
// (n,) px, shapes (n, 4) of the windows. tolerance: px, where the fit may stop; enough: pixels from which the slopes of
// the illumination are free. p (n, 9) with absolute u, v; cov (n, 2, 2) of u, v; pixels, rms, status (n,).
inline void fit_corners(In<float, 2> image, In<double, 2> start, In<double, 2> angles, Vector blur, In<double, 2> shapes, int64_t crossing,
                        double max_shift, double tolerance, int64_t enough, Out<double, 2> out, Out<double, 3> cov,
                        Out<int64_t, 1> pixels, Out<double, 1> rms, Out<int64_t, 1> status) {
    static thread_local Collected window;
    const auto clamp = [](double *p) { p[6] = smaller(larger(p[6], std::log(0.2)), std::log(12.0)); };
    for (int64_t c = 0; c < start.n[0]; ++c) {
        if (!lies_on(image, start(c, 0), start(c, 1))) {
            pixels.data[c] = -1, status.data[c] = AT_BORDER;
            continue;
        }
        const int64_t u0 = std::lrint(start(c, 0)), v0 = std::lrint(start(c, 1));
        double p[CORNER] = {start(c, 0) - double(u0), start(c, 1) - double(v0), angles(c, 0), angles(c, 1), 0, 0, std::log(blur[c]), 0, 0};
        const int n = corner_window(image, u0, v0, p, &shapes(c, 0), crossing, window), n_free = n >= enough ? 9 : 7;
        pixels.data[c] = n;
        if (n < 20) {
            status.data[c] = n < 0 ? AT_BORDER : TOO_FEW;
            std::memcpy(&out(c, 0), p, sizeof p);
            continue;
        }
        const Pixels w{window.x, window.y, window.value, n};
        Normals<CORNER> at;
        const auto evaluate = [&](const double *q, Normals<CORNER> &o) { add_pixels(w, Wedge(q, crossing), o); };
        start_levels(p, n, evaluate, at);
        const bool found = levenberg_marquardt(p, n_free, tolerance, evaluate, clamp, at);
        const double variance = at.cost / (n - n_free);
        std::memcpy(&out(c, 0), p, sizeof p);
        if (!found) {
            status.data[c] = NO_CONVERGENCE;
            continue;
        }
        rms.data[c] = root(variance);
        if (!place_covariance(at, n_free, variance, &cov(c, 0, 0))) {
            status.data[c] = NO_CONVERGENCE;
            continue;
        }
        out(c, 0) += double(u0), out(c, 1) += double(v0);
        const double shift = magnitude(out(c, 0) - start(c, 0)) + magnitude(out(c, 1) - start(c, 1));
        status.data[c] = shift > max_shift ? AWAY : GOOD;
    }
}

// Grey values (n,) at places xy (n, 2), and their derivatives (n, 9).
inline void corner_rows(In<double, 2> xy, Vector p, int64_t crossing, Out<double, 1> value, Out<double, 2> rows) {
    const Wedge wedge(p.data, crossing);
    for (int64_t i = 0; i < xy.n[0]; ++i) value.data[i] = wedge(xy(i, 0), xy(i, 1), &rows(i, 0));
}

}  // namespace
