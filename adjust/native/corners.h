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
#pragma GCC unroll 10
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
        scale = std::exp(-p[6]), turn = c1 * s2 - s1 * c2;
        rho = smaller(larger(-c1 * c2 - s1 * s2, -0.95), 0.95);
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
    alignas(64) double x[MOST_PIXELS + 1], y[MOST_PIXELS + 1], value[MOST_PIXELS + 1];
};

// Whole numbers i from first to last.
struct Run {
    int64_t first, last;
};
// Those with low <= slope i + offset <= high.
inline Run between(double slope, double offset, double low, double high) {
    const auto whole = [](double i) { return int64_t(smaller(larger(i, -LARGEST_WINDOW), LARGEST_WINDOW)); };
    if (magnitude(slope) < 1e-9) return low <= offset && offset <= high ? Run{whole(-LARGEST_WINDOW), whole(LARGEST_WINDOW)} : Run{0, -1};
    const double ends[2] = {(low - offset) / slope, (high - offset) / slope};
    return {whole(std::ceil(smaller(ends[0], ends[1]))), whole(std::floor(larger(ends[0], ends[1])))};
}
inline Run both(Run a, Run b) { return {larger(a.first, b.first), smaller(a.last, b.last)}; }

// The pixels of a corner: a disc, and strips along its edges; their number, -1 at the border. Those near both edges come
// first: the others need no integral (``Wedge``). shape: radius of the disc, half width of the strips, length of strip 1,
// length of strip 2, in px.
inline int64_t corner_window(In<float, 2> image, int64_t u0, int64_t v0, const double *p, const double *shape, bool crossing, Collected &out) {
    static thread_local Collected far;
    const double radius = shape[0], width = shape[1], c[2] = {std::cos(p[2]), std::cos(p[3])}, s[2] = {std::sin(p[2]), std::sin(p[3])};
    const double extent = larger(radius, larger(shape[2], shape[3]) + width), bent = FAR * std::exp(p[6]);
    if (!(magnitude(extent) < LARGEST_WINDOW)) return -1;
    const int64_t reach = int64_t(std::ceil(extent)) + 1;
    int64_t n_near = 0, n_far = 0;
    const auto add = [](Collected &list, int64_t &n, const float *row, int64_t from, int64_t to, int64_t j) {
        double *x = list.x + n, *y = list.y + n, *value = list.value + n;
        for (int64_t k = 0; k < to - from; ++k) x[k] = from + k, y[k] = j, value[k] = row[from + k];
        n += to - from;
    };
    for (int64_t j = -reach; j <= reach; ++j) {
        const double dy = j - p[1], half = radius * radius - dy * dy;
        const auto within = [&](int a, double most) { return between(-s[a], c[a] * dy + s[a] * p[0], -most, most); };  // of an edge
        Run parts[3] = {half >= 0.0 ? between(1.0, -p[0], -root(half), root(half)) : Run{0, -1}, {0, -1}, {0, -1}};
        for (int a = 0; a < 2 && width > 0.0; ++a)
            parts[1 + a] = both(within(a, width), between(c[a], s[a] * dy - c[a] * p[0], crossing ? -shape[2 + a] : -width, shape[2 + a]));
        for (const auto &[a, b] : {std::pair(0, 1), std::pair(1, 2), std::pair(0, 1)})
            if (parts[b].first < parts[a].first) std::swap(parts[a], parts[b]);
        const Run near = both(within(0, bent), within(1, bent));
        int64_t next = -reach;
        for (Run part : parts) {
            part.first = larger(part.first, next);
            if (part.last < part.first) continue;
            const int64_t u = u0 + part.first, v = v0 + j;
            if (u < 0 || v < 0 || u0 + part.last >= image.n[1] || v >= image.n[0]) return -1;
            next = part.last + 1;
            if (n_near + n_far + next - part.first > MOST_PIXELS) continue;
            const float *row = &image(v, 0) + u0;
            const int64_t a = smaller(larger(near.first, part.first), next), b = smaller(larger(near.last + 1, a), next);
            add(far, n_far, row, part.first, a, j), add(out, n_near, row, a, b, j), add(far, n_far, row, b, next, j);
        }
    }
    for (const auto list : {&Collected::x, &Collected::y, &Collected::value}) std::memcpy(out.*list + n_near, far.*list, n_far * sizeof(double));
    return n_near + n_far;
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

// Linear between nodes x, ascending, with values y; beyond the nodes that of the last.
inline double interpolated(Vector x, Vector y, double at) {
    int64_t k = 0;
    while (k < x.n[0] && x[k] <= at) ++k;
    if (k == 0 || k == x.n[0]) return y[k == 0 ? 0 : k - 1];
    return y[k - 1] + (y[k] - y[k - 1]) * (at - x[k - 1]) / (x[k] - x[k - 1]);
}

struct FittedCorner {
    double p[CORNER], cov[4] = {}, rms = 0.0;  // u, v of p absolute where the fit is good
    int64_t n = -1, n_free = 0;
    bool good = false;
};
// One corner: start u, v px, angles of the two edges, the second clockwise (in the image) of the first, blur px, shape of
// the window. tolerance: px, where the fit may stop; enough: pixels from which the slopes of the illumination are free.
inline FittedCorner fit_corner(In<float, 2> image, const double *start, const double *angles, double blur, const double *shape, bool crossing,
                               double max_shift, double tolerance, int64_t enough) {
    static thread_local Collected window;
    FittedCorner o;
    if (!lies_on(image, start[0], start[1])) return o;
    const int64_t u0 = std::lrint(start[0]), v0 = std::lrint(start[1]);
    const double first[CORNER] = {start[0] - double(u0), start[1] - double(v0), angles[0], angles[1], 0, 0, std::log(blur), 0, 0};
    std::memcpy(o.p, first, sizeof first);
    o.n = corner_window(image, u0, v0, o.p, shape, crossing, window), o.n_free = o.n >= enough ? 9 : 7;
    if (o.n < 20) return o;
    const Pixels w{window.x, window.y, window.value, int(o.n)};
    Normals<CORNER> at;
    const auto evaluate = [&](const double *q, Normals<CORNER> &out) { add_pixels(w, Wedge(q, crossing), out); };
    const auto clamp = [](double *p) { p[6] = smaller(larger(p[6], std::log(0.2)), std::log(12.0)); };
    start_levels(o.p, int(o.n), evaluate, at);
    if (!levenberg_marquardt(o.p, int(o.n_free), tolerance, evaluate, clamp, at)) return o;
    const double variance = at.cost / double(o.n - o.n_free);
    o.rms = root(variance);
    if (!place_covariance(at, int(o.n_free), variance, o.cov)) return o;
    o.p[0] += double(u0), o.p[1] += double(v0);
    o.good = magnitude(o.p[0] - start[0]) + magnitude(o.p[1] - start[1]) <= max_shift;
    return o;
}

constexpr double ROUGH_PX = 1e-3, FINE_PX = 2e-5;  // steps after which the first and the second fit of a corner may stop
constexpr double NEAR_PX = 5.0;  // from a crossing, as far as the first fit looks where the edges' blur ends before that

// The window of a corner: it keeps clear of the neighbouring edges, blurred as those are. edges: both, px, to where they
// end; free: px from them within which there is nothing else, infinite for a whole square.
inline void window_shape(const double *edges, double free, bool crossing, double blur, double *shape) {
    const double length[2] = {std::hypot(edges[0], edges[1]), std::hypot(edges[2], edges[3])};
    const double across = magnitude(edges[0] * edges[3] - edges[1] * edges[2]) / larger(larger(length[0], length[1]), 1e-9);
    const auto clipped = [](double x, double low, double high) { return smaller(larger(x, low), high); };
    shape[1] = shape[2] = shape[3] = 0.0;
    if (crossing && !std::isfinite(free)) {
        shape[0] = clipped(smaller(0.6 * across, across - 3.0 * blur), 2.6, 11.0);
        return;
    }
    const double limit = smaller(free, across);
    shape[0] = shape[1] = clipped(smaller(0.75 * limit, limit - 2.5 * blur), 1.5, 8.0);
    for (int a = 0; a < 2; ++a) shape[2 + a] = clipped(0.6 * length[a], shape[1], crossing ? 14.0 : 20.0);
}
// Amplitude at 0 of the straight line fitted over (0, 1) to a unit sine of that many periods.
inline double at_the_end(double periods) {
    const double w = 2.0 * M_PI * larger(periods, 1e-4), c = std::cos(w), s = std::sin(w);
    return std::hypot((6.0 * (1.0 - c) / w - 2.0 * s) / w, (4.0 + 2.0 * c - 6.0 * s / w) / w);
}
// What pixels do to sharp edges along their rows and columns, added to cov (2, 2) px^2. A pixel's square is taken for a
// Gaussian of equal variance. The difference has a harmonic at one period a pixel, which displaces the edge by as much,
// periodically with its place; an oblique edge averages it over the pixels that it passes. displaced: px, of an edge along
// the pixels; length: px of the edges in the window, on each side of a crossing.
inline void add_sampling(double displaced, const double *angles, const double *length, bool crossing, double *cov) {
    const double c[2] = {std::cos(angles[0]), std::cos(angles[1])}, s[2] = {std::sin(angles[0]), std::sin(angles[1])};
    const double turn = c[0] * s[1] - s[0] * c[1];
    double back[2][2] = {{c[1] / turn, -c[0] / turn}, {s[1] / turn, -s[0] / turn}};  // from offsets across both edges
    if (magnitude(turn) < 1e-3) back[0][0] = back[1][1] = 1.0, back[0][1] = back[1][0] = 0.0;
    for (int a = 0; a < 2; ++a) {
        const double periods = length[a] * smaller(magnitude(s[a]), magnitude(c[a])), w = 2.0 * M_PI * periods;
        const double by = displaced / root(2.0) * (crossing ? (w > 0.0 ? std::sin(w) / w : 1.0) : at_the_end(periods));
        for (int i = 0; i < 2; ++i)
            for (int j = 0; j < 2; ++j) cov[2 * i + j] += by * by * back[i][a] * back[j][a];
    }
}
// Corners from start (n, 2) px, good to about 2 px, in two passes: the second one's window is centred and turned to the
// corner itself. edges (n, 2, 2), free (n,): see ``window_shape``. floor: px, of the covariance. displaced (k,): px by
// which pixels displace an edge, at most, for blurs (k,) of the lens. uv (n, 2), cov (n, 2, 2), blur of the lens, contrast (n,);
// good (n,): what is to be trusted; angles (n, 2); bend (n, 2) px^2 by how much an edge's curvature displaces it.
inline void refine_corners(In<float, 2> image, In<double, 2> start, In<double, 3> edges, Vector free, int64_t crossing, int64_t enough, double floor,
                           Vector blurs, Vector displaced, Out<double, 2> uv, Out<double, 3> cov, Out<double, 1> blur, Out<double, 1> contrast,
                           Out<bool, 1> good, Out<double, 2> angles, Out<double, 2> bend) {
    for (int64_t i = 0; i < start.n[0]; ++i) {
        const double *edge = &edges(i, 0, 0), *centre = &start(i, 0);
        double turned[2] = {std::atan2(edge[1], edge[0]), std::atan2(edge[3], edge[2])}, shape[4], close[4] = {}, spread = 1.0;
        window_shape(edge, free[i], crossing, spread, shape);
        close[0] = smaller(shape[0], NEAR_PX);
        const bool strips = shape[1] > 0.0;
        FittedCorner first = fit_corner(image, centre, turned, spread, strips ? shape : close, crossing, 3.0, ROUGH_PX, enough);
        if (!strips && (!first.good || first.p[6] > std::log(NEAR_PX / 3.5)))
            first = fit_corner(image, centre, turned, spread, shape, crossing, 3.0, ROUGH_PX, enough);
        if (first.good) centre = first.p, turned[0] = first.p[2], turned[1] = first.p[3], spread = std::exp(first.p[6]);
        window_shape(edge, free[i], crossing, spread, shape);
        FittedCorner o = fit_corner(image, centre, turned, spread, shape, crossing, 0.5, FINE_PX, enough);
        const double whole = std::exp(o.p[6]), length[2] = {larger(shape[0], shape[2]), larger(shape[0], shape[3])};
        contrast.data[i] = magnitude(o.p[5]) * (crossing ? 2.0 : 1.0), blur.data[i] = root(larger(whole * whole - 1.0 / 12.0, 0.0));
        // noise that comes from few residuals: the covariance of Student's distribution, not its scale's
        const double redundancy = double(o.n - o.n_free), student = redundancy / larger(redundancy - 2.0, 1.0);
        for (double &x : o.cov) x *= student;
        add_sampling(interpolated(blurs, displaced, blur.data[i]), o.p + 2, length, crossing, o.cov);
        o.cov[0] += floor * floor, o.cov[3] += floor * floor;
        good.data[i] = o.good && first.good && o.rms < 0.2 * contrast.data[i] && o.cov[0] + o.cov[3] < 1.0
                       && whole < larger(0.5 * larger(shape[0], larger(shape[2], shape[3])), 1.0);
        std::memcpy(&cov(i, 0, 0), o.cov, sizeof o.cov);
        for (int a = 0; a < 2; ++a) {
            uv(i, a) = o.p[a], angles(i, a) = o.p[2 + a];
            // means of the parabola x^2 / 2: over both sides of the corner, and where it begins if there is but one side
            bend(i, a) = length[a] * length[a] / (crossing ? 6.0 : -12.0);
        }
    }
}

// Grey values (n,) at places xy (n, 2), and their derivatives (n, 9).
inline void corner_rows(In<double, 2> xy, Vector p, int64_t crossing, Out<double, 1> value, Out<double, 2> rows) {
    const Wedge wedge(p.data, crossing);
    for (int64_t i = 0; i < xy.n[0]; ++i) value.data[i] = wedge(xy(i, 0), xy(i, 1), &rows(i, 0));
}

}  // namespace
