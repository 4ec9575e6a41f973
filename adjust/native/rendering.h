// Inner loops of the renderer: rays of the pixels' corners, and grey values of planes of cells.
#pragma once
#include "lenses.h"

namespace {

constexpr int TILE = 6;  // pixels; lens distortion is linear across a tile to far below the size of a sub-pixel

// Undistorted x/z, y/z of the pixel corners of the rows first .. last - 1, (height + 1, width + 1, 2), of a lens with
// Brown's parameters; NaN where it cannot be inverted. Newton from the distorted point approaches the first root
// monotonically for one dominating coefficient.
inline void pixel_corner_rays(int64_t first, int64_t last, Vector lens, Out<double, 3> rays) {
    const double *l = lens.data, none[4] = {}, nan = __builtin_nan("");
    for (int64_t j = first; j < last; ++j)
        for (int64_t i = 0; i < rays.n[1]; ++i) {
            const double u = double(i) - 0.5, v = double(j) - 0.5;
            double q[3] = {(u - l[3]) / l[0], (v - l[4]) / l[1], 1.0}, step = 1.0;
            for (int k = 0; k < 30; ++k) {
                double r[2], d[2][N_COLUMNS];
                lens_row<Brown>(l, none, q, u, v, r, d);
                const double a = d[0][MAX_LENS], b = d[0][MAX_LENS + 1], c = d[1][MAX_LENS], e = d[1][MAX_LENS + 1], det = a * e - b * c;
                if (!(det > 1e-3 * l[0] * l[1])) break;
                const double x = (e * r[0] - b * r[1]) / det, y = (a * r[1] - c * r[0]) / det;
                q[0] -= x, q[1] -= y, step = magnitude(x) + magnitude(y);
                if (step < 1e-13) break;
            }
            rays(j, i, 0) = step > 1e-9 ? nan : q[0];
            rays(j, i, 1) = step > 1e-9 ? nan : q[1];
        }
}

struct Quad {
    double p[4][2];  // rays x/z, y/z of the corners: upper left, upper right, lower left, lower right

    bool known() const {
        for (const auto &c : p)
            if (!(c[0] == c[0] && c[1] == c[1])) return false;
        return true;
    }
    // The ray at (s, t) in the unit square between the corners.
    void inner(double s, double t, double *out) const {
        const double w[4] = {(1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t};
        for (int a = 0; a < 2; ++a) out[a] = w[0] * p[0][a] + w[1] * p[1][a] + w[2] * p[2][a] + w[3] * p[3][a];
    }
};

struct Facets {
    explicit Facets(Reader &r) : from_ray(r), bounds(r), counts(r), x_edges(r), y_edges(r), cells(r) {}
    In<double, 3> from_ray;   // facet's x, y, 1 over depth, from x/z, y/z, 1
    In<double, 2> bounds;     // boxes in x/z, y/z
    In<int64_t, 2> counts;    // cells in x and y
    In<double, 2> x_edges, y_edges;
    In<double, 3> cells;      // grey values

    // Interval of the first n + 1 edges that holds value, -1 outside.
    static int64_t cell(const double *edges, int64_t n, double value) {
        if (!(edges[0] <= value && value < edges[n])) return -1;
        int64_t low = 0, high = n;
        while (high - low > 1) {
            const int64_t middle = (low + high) / 2;
            (value < edges[middle] ? high : low) = middle;
        }
        return low;
    }
    // How a quadrangle of rays meets a facet: 0 not at all, 1 inside one cell (i, j), 2 mixed; 1 / depth.
    int footprint(const Quad &q, int64_t f, double &depth, int64_t &i, int64_t &j) const {
        const double *m = &from_ray(f, 0, 0), *xs = &x_edges(f, 0), *ys = &y_edges(f, 0);
        const int64_t nx = counts(f, 0), ny = counts(f, 1);
        double low[2] = {__builtin_inf(), __builtin_inf()}, high[2] = {-__builtin_inf(), -__builtin_inf()};
        depth = 0.0;
        for (const auto &c : q.p) {
            const double w = m[6] * c[0] + m[7] * c[1] + m[8];
            if (!(w > 0.0)) {
                depth = 0.0;
                return 2;
            }
            for (int a = 0; a < 2; ++a) {
                const double at = (m[3 * a] * c[0] + m[3 * a + 1] * c[1] + m[3 * a + 2]) / w;
                low[a] = smaller(low[a], at), high[a] = larger(high[a], at);
            }
            depth += 0.25 * w;
        }
        if (high[0] <= xs[0] || low[0] >= xs[nx] || high[1] <= ys[0] || low[1] >= ys[ny]) return 0;
        i = cell(xs, nx, low[0]), j = cell(ys, ny, low[1]);
        return i < 0 || j < 0 || high[0] > xs[i + 1] || high[1] > ys[j + 1] ? 2 : 1;
    }
    // What a quadrangle sees: facets that it may meet, whether to sample them, else its grey value.
    bool mixed(const Quad &q, double background, int64_t *candidates, int64_t &n, double &gray) const {
        double low[2], high[2], nearest = 0.0, depth;
        for (int a = 0; a < 2; ++a) {
            low[a] = smaller(smaller(q.p[0][a], q.p[1][a]), smaller(q.p[2][a], q.p[3][a]));
            high[a] = larger(larger(q.p[0][a], q.p[1][a]), larger(q.p[2][a], q.p[3][a]));
        }
        bool any = false;
        n = 0, gray = background;
        for (int64_t f = 0; f < from_ray.n[0]; ++f) {
            if (high[0] < bounds(f, 0) || low[0] > bounds(f, 1) || high[1] < bounds(f, 2) || low[1] > bounds(f, 3)) continue;
            int64_t i = 0, j = 0;
            const int kind = footprint(q, f, depth, i, j);
            if (kind == 0) continue;
            candidates[n++] = f;
            any |= kind == 2;
            if (kind == 1 && depth > nearest) nearest = depth, gray = cells(f, j, i);
        }
        return any;
    }
    // Sum of the grey values of rays inside a quadrangle that meets this facet alone, with one edge of cells across it at
    // the most in each direction; false where it is not so.
    bool sum_of_four(const Quad &q, int64_t f, In<double, 2> samples, double &total) const {
        const double *m = &from_ray(f, 0, 0), *xs = &x_edges(f, 0), *ys = &y_edges(f, 0);
        const int64_t nx = counts(f, 0), ny = counts(f, 1);
        double low[2] = {__builtin_inf(), __builtin_inf()}, high[2] = {-__builtin_inf(), -__builtin_inf()};
        for (const auto &c : q.p) {
            const double w = m[6] * c[0] + m[7] * c[1] + m[8];
            if (!(w > 0.0)) return false;
            for (int a = 0; a < 2; ++a) {
                const double at = (m[3 * a] * c[0] + m[3 * a + 1] * c[1] + m[3 * a + 2]) / w;
                low[a] = smaller(low[a], at), high[a] = larger(high[a], at);
            }
        }
        const int64_t i = cell(xs, nx, low[0]), j = cell(ys, ny, low[1]);
        if (i < 0 || j < 0) return false;
        const bool two_x = high[0] > xs[i + 1], two_y = high[1] > ys[j + 1];
        if (high[0] > xs[smaller(i + 1 + two_x, nx)] || high[1] > ys[smaller(j + 1 + two_y, ny)]) return false;
        const double x_edge = xs[i + 1], y_edge = ys[j + 1];
        const double g[2][2] = {{cells(f, j, i), two_x ? cells(f, j, i + 1) : 0.0}, {two_y ? cells(f, j + 1, i) : 0.0, two_x && two_y ? cells(f, j + 1, i + 1) : 0.0}};
        V sum_of = V{};
        int64_t k = 0;
        const int64_t n = samples.n[0];
        for (; k + W <= n; k += W) {
            V s, t;
            for (int e = 0; e < W; ++e) s[e] = samples(k + e, 0), t[e] = samples(k + e, 1);
            const V w[4] = {(1.0 - s) * (1.0 - t), s * (1.0 - t), (1.0 - s) * t, s * t};
            const V x = w[0] * q.p[0][0] + w[1] * q.p[1][0] + w[2] * q.p[2][0] + w[3] * q.p[3][0];
            const V y = w[0] * q.p[0][1] + w[1] * q.p[1][1] + w[2] * q.p[2][1] + w[3] * q.p[3][1];
            const V depth = m[6] * x + m[7] * y + m[8];
            const auto right = m[0] * x + m[1] * y + m[2] >= x_edge * depth, below = m[3] * x + m[4] * y + m[5] >= y_edge * depth;
            const V above = right ? all<V>(g[0][1]) : all<V>(g[0][0]), under = right ? all<V>(g[1][1]) : all<V>(g[1][0]);
            sum_of += below ? under : above;
        }
        total = sum(sum_of);
        for (; k < n; ++k) {
            double ray[2];
            q.inner(samples(k, 0), samples(k, 1), ray);
            const double depth = m[6] * ray[0] + m[7] * ray[1] + m[8];
            total += g[m[3] * ray[0] + m[4] * ray[1] + m[5] >= y_edge * depth][m[0] * ray[0] + m[1] * ray[1] + m[2] >= x_edge * depth];
        }
        return true;
    }
    // Grey value of one ray: the nearest facet that it meets.
    double sample(const double *ray, double background, const int64_t *candidates, int64_t n) const {
        double best = 0.0, gray = background;
        for (int64_t k = 0; k < n; ++k) {
            const int64_t f = candidates[k];
            const double *m = &from_ray(f, 0, 0), w = m[6] * ray[0] + m[7] * ray[1] + m[8];
            if (w <= best) continue;
            const int64_t i = cell(&x_edges(f, 0), counts(f, 0), (m[0] * ray[0] + m[1] * ray[1] + m[2]) / w);
            if (i < 0) continue;
            const int64_t j = cell(&y_edges(f, 0), counts(f, 1), (m[3] * ray[0] + m[4] * ray[1] + m[5]) / w);
            if (j >= 0) best = w, gray = cells(f, j, i);
        }
        return gray;
    }
};

// Grey values (n height, n width) of sub-pixels, each integrated over its area, of the pixel rows first .. last - 1, which
// begin at a whole tile. Tiles and pixels that see a single cell are filled at once. rays: of the pixel corners.
// samples: (S, 2) offsets in the unit square of a sub-pixel. candidates: scratch, one place a facet.
inline void draw_facets(int64_t first, int64_t last, In<double, 3> rays, int64_t n, const Facets &F, double background, In<double, 2> samples,
                        Out<float, 2> image, Out<int64_t, 1> candidates) {
    const int64_t width = rays.n[1] - 1;
    const auto quad = [&](int64_t v0, int64_t u0, int64_t v1, int64_t u1) {
        Quad q;
        const int64_t at[4][2] = {{v0, u0}, {v0, u1}, {v1, u0}, {v1, u1}};
        for (int k = 0; k < 4; ++k)
            for (int a = 0; a < 2; ++a) q.p[k][a] = rays(at[k][0], at[k][1], a);
        return q;
    };
    const auto fill = [&](int64_t v0, int64_t v1, int64_t u0, int64_t u1, double gray) {
        for (int64_t v = v0; v < v1; ++v)
            for (int64_t u = u0; u < u1; ++u) image(v, u) = float(gray);
    };
    int64_t found;
    double gray;
    for (int64_t v0 = first; v0 < last; v0 += TILE)
        for (int64_t u0 = 0; u0 < width; u0 += TILE) {
            const int64_t v1 = smaller(v0 + TILE, last), u1 = smaller(u0 + TILE, width);
            const Quad tile = quad(v0, u0, v1, u1);
            if (tile.known() && !F.mixed(tile, background, candidates.data, found, gray)) {
                fill(n * v0, n * v1, n * u0, n * u1, gray);
                continue;
            }
            for (int64_t v = v0; v < v1; ++v)
                for (int64_t u = u0; u < u1; ++u) {
                    const Quad pixel = quad(v, u, v + 1, u + 1);
                    if (!pixel.known()) {
                        fill(n * v, n * v + n, n * u, n * u + n, background);
                        continue;
                    }
                    if (!F.mixed(pixel, background, candidates.data, found, gray)) {
                        fill(n * v, n * v + n, n * u, n * u + n, gray);
                        continue;
                    }
                    for (int64_t b = 0; b < n; ++b)
                        for (int64_t a = 0; a < n; ++a) {
                            Quad sub;
                            for (int k = 0; k < 4; ++k) pixel.inner(double(a + k % 2) / double(n), double(b + k / 2) / double(n), sub.p[k]);
                            if (F.mixed(sub, background, candidates.data, found, gray)) {
                                gray = 0.0;
                                const bool simple = found == 1 && F.sum_of_four(sub, candidates[0], samples, gray);
                                for (int64_t k = 0; !simple && k < samples.n[0]; ++k) {
                                    double ray[2];
                                    sub.inner(samples(k, 0), samples(k, 1), ray);
                                    gray += F.sample(ray, background, candidates.data, found);
                                }
                                gray /= double(samples.n[0]);
                            }
                            image(n * v + b, n * u + a) = float(gray);
                        }
                }
        }
}

typedef float Floats __attribute__((vector_size(8 * W), aligned(4), may_alias));

// Pixels first .. last - 1 of a sum of n x n sub-pixels under a point spread: weights (T,) of the sub-pixels from reach
// before a pixel's first one on, along rows and columns alike; beyond the border the image goes on as it is there. work:
// scratch, n rows as wide as image and weights together.
inline void spread_and_sum(int64_t first, int64_t last, In<float, 2> image, In<float, 1> weights, int64_t reach, int64_t n, Out<float, 2> out,
                           Out<float, 2> work) {
    constexpr int64_t LANES = 2 * W;
    const int64_t taps = weights.n[0], height = image.n[0], width = image.n[1], columns = out.n[1], wide = work.n[1];
    const auto load_floats = [](const float *p) { return *reinterpret_cast<const Floats *>(p); };
    for (int64_t v = first; v < last; ++v) {
        const auto above = [&](int64_t t) { return image.data + smaller(larger(n * v - reach + t, int64_t(0)), height - 1) * width; };
        const auto column = [&](int64_t s, float sum) {  // sub-pixel s of the row, beside those with the same place in a pixel
            const int64_t at = s + reach;
            work(at % n, at / n) = sum;
        };
        int64_t s = 0;
        for (; s + LANES <= width; s += LANES) {
            Floats sum = {};
            for (int64_t t = 0; t < taps; ++t) sum += weights[t] * load_floats(above(t) + s);
            for (int64_t e = 0; e < LANES; ++e) column(s + e, sum[e]);
        }
        for (; s < width; ++s) {
            float sum = 0.0f;
            for (int64_t t = 0; t < taps; ++t) sum += weights[t] * above(t)[s];
            column(s, sum);
        }
        const float left = work(reach % n, reach / n), right = work((width - 1 + reach) % n, (width - 1 + reach) / n);
        for (int64_t k = -reach; k < 0; ++k) column(k, left);
        for (int64_t k = width; k + reach < n * wide; ++k) column(k, right);
        int64_t u = 0;
        for (; u + LANES <= columns; u += LANES) {
            Floats sum = {};
            for (int64_t t = 0; t < taps; ++t) sum += weights[t] * load_floats(&work(t % n, u + t / n));
            *reinterpret_cast<Floats *>(&out(v, u)) = sum;
        }
        for (; u < columns; ++u) {
            float sum = 0.0f;
            for (int64_t t = 0; t < taps; ++t) sum += weights[t] * work(t % n, u + t / n);
            out(v, u) = sum;
        }
    }
}

}  // namespace
