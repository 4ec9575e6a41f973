// Inner loops of the renderer: rays of the pixels' corners, and grey values of planes of cells.
#pragma once
#include "lenses.h"

namespace {

constexpr int TILE = 6;  // pixels; lens distortion is linear across a tile to far below the size of a sub-pixel

// Undistorted x/z, y/z of the pixel corners of the rows first .. last - 1, (height + 1, width + 1, 2), of a lens with
// Brown's parameters; NaN where it cannot be inverted. Newton from the distorted point approaches the first root
// monotonically for one dominating coefficient.
inline void pixel_corner_rays(int64_t first, int64_t last, Vector lens, Out<double, 3> rays) {
    const double *l = lens.data, none[4] = {};
    const V nan = all<V>(__builtin_nan(""));
    for (int64_t j = first; j < last; ++j)
        for (int64_t i = 0; i < rays.n[1]; i += W) {
            V u = {}, v = all<V>(double(j) - 0.5), step = all<V>(1.0);
            for (int e = 0; e < W; ++e) u[e] = double(i + e) - 0.5;
            V q[3] = {(u - l[3]) / l[0], (v - l[4]) / l[1], all<V>(1.0)};
            auto going = step > 0.0;  // a mask, -1 in lanes that are not there yet
            for (int k = 0; k < 30; ++k) {
                V r[2], d[2][N_COLUMNS];
                lens_row<Brown>(l, none, q, u, v, r, d);
                const V a = d[0][MAX_LENS], b = d[0][MAX_LENS + 1], c = d[1][MAX_LENS], e = d[1][MAX_LENS + 1], det = a * e - b * c;
                going &= det > 1e-3 * l[0] * l[1];
                const V x = (e * r[0] - b * r[1]) / det, y = (a * r[1] - c * r[0]) / det;
                q[0] = going ? q[0] - x : q[0], q[1] = going ? q[1] - y : q[1], step = going ? magnitude(x) + magnitude(y) : step;
                going &= !(step < 1e-13);
                if (!any(going)) break;
            }
            q[0] = step > 1e-9 ? nan : q[0], q[1] = step > 1e-9 ? nan : q[1];
            for (int64_t e = 0; e < smaller(W, rays.n[1] - i); ++e) rays(j, i + e, 0) = q[0][e], rays(j, i + e, 1) = q[1][e];
        }
}

struct Quad {
    double p[4][2];  // rays x/z, y/z of the corners: upper left, upper right, lower left, lower right

    bool known() const {
        for (const auto &c : p)
            if (!(c[0] == c[0] && c[1] == c[1])) return false;
        return true;
    }
    // Weights of the corners at (s, t) in the unit square between them.
    static void weights(double s, double t, double *out) {
        out[0] = (1 - s) * (1 - t), out[1] = s * (1 - t), out[2] = (1 - s) * t, out[3] = s * t;
    }
    // The ray there.
    void at(const double *w, double *out) const {
        for (int a = 0; a < 2; ++a) out[a] = w[0] * p[0][a] + w[1] * p[1][a] + w[2] * p[2][a] + w[3] * p[3][a];
    }
};

// Rays of the lattice in a sub-pixel: their weights of its four corners, in whole vectors, of which the last n are no rays.
struct Lattice {
    In<double, 2> weights;  // (4, n + padding)
    int64_t n;
};

// Two edges across a quadrangle, one in x and one in y, and the grey values of the four cells beside them. On rays the
// distance from an edge times the depth is linear, so it is bilinear between the corners.
struct Cross {
    double beyond[2][4];  // at the corners; positive beyond the edge
    double gray[4];       // before both, beyond that in x, beyond that in y, beyond both

    // That between other corners, each a mean of these.
    void inner(const double (&corner)[4][4], Cross &out) const {
        for (int a = 0; a < 2; ++a)
            for (int k = 0; k < 4; ++k) {
                const double *w = corner[k], *at = beyond[a];  // of the ray k
                out.beyond[a][k] = w[0] * at[0] + w[1] * at[1] + w[2] * at[2] + w[3] * at[3];
            }
        std::memcpy(out.gray, gray, sizeof gray);
    }
    // Mean grey value of the rays of a lattice.
    double mean(const Lattice &lattice) const {
        double share[2];  // 0 or 1 where all corners are on one side
        bool mixed[2];
        for (int a = 0; a < 2; ++a) {
            int n = 0;
            for (double at : beyond[a]) n += at >= 0.0;
            share[a] = n / 4, mixed[a] = n % 4 != 0;
        }
        double both = share[0] * share[1];
        if (mixed[0] || mixed[1]) {
            const int64_t wide = lattice.weights.n[1], none = wide - lattice.n;  // no ray: zero, beyond both
            const double *w[4] = {&lattice.weights(0, 0), &lattice.weights(1, 0), &lattice.weights(2, 0), &lattice.weights(3, 0)};
            V count[3] = {};
            for (int64_t k = 0; k + W <= wide; k += W) {
                const V v[4] = {load(w[0] + k), load(w[1] + k), load(w[2] + k), load(w[3] + k)}, one = all<V>(1.0), zero = V{};
                const V x = v[0] * beyond[0][0] + v[1] * beyond[0][1] + v[2] * beyond[0][2] + v[3] * beyond[0][3];
                const V y = v[0] * beyond[1][0] + v[1] * beyond[1][1] + v[2] * beyond[1][2] + v[3] * beyond[1][3];
                const V right = x >= 0.0 ? one : zero, below = y >= 0.0 ? one : zero;
                count[0] += right, count[1] += below, count[2] += right * below;
            }
            const double n = double(lattice.n);
            share[0] = (sum(count[0]) - none) / n, share[1] = (sum(count[1]) - none) / n, both = (sum(count[2]) - none) / n;
        }
        return gray[0] * (1.0 - share[0] - share[1] + both) + gray[1] * (share[0] - both) + gray[2] * (share[1] - both) + gray[3] * both;
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
    // The edges of cells across a quadrangle inside this facet; false where they are more than one in either direction.
    bool crossed(const Quad &q, int64_t f, Cross &out) const {
        const double *m = &from_ray(f, 0, 0), *xs = &x_edges(f, 0), *ys = &y_edges(f, 0);
        const int64_t nx = counts(f, 0), ny = counts(f, 1);
        double low[2] = {__builtin_inf(), __builtin_inf()}, high[2] = {-__builtin_inf(), -__builtin_inf()}, x[4][3];
        for (int k = 0; k < 4; ++k) {
            for (int a = 0; a < 3; ++a) x[k][a] = m[3 * a] * q.p[k][0] + m[3 * a + 1] * q.p[k][1] + m[3 * a + 2];
            if (!(x[k][2] > 0.0)) return false;
            for (int a = 0; a < 2; ++a) {
                const double at = x[k][a] / x[k][2];
                low[a] = smaller(low[a], at), high[a] = larger(high[a], at);
            }
        }
        const int64_t i = cell(xs, nx, low[0]), j = cell(ys, ny, low[1]);
        if (i < 0 || j < 0) return false;
        const bool two_x = high[0] > xs[i + 1], two_y = high[1] > ys[j + 1];
        if (high[0] > xs[smaller(i + 1 + two_x, nx)] || high[1] > ys[smaller(j + 1 + two_y, ny)]) return false;
        for (int k = 0; k < 4; ++k) {
            out.beyond[0][k] = two_x ? x[k][0] - xs[i + 1] * x[k][2] : -1.0;
            out.beyond[1][k] = two_y ? x[k][1] - ys[j + 1] * x[k][2] : -1.0;
        }
        for (int e = 0; e < 4; ++e) out.gray[e] = cells(f, j + (two_y && e > 1), i + (two_x && e % 2));
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
// samples: (S, 2) offsets in the unit square of a sub-pixel; weights: (4, S or more) of its corners there, zero behind.
// candidates: scratch, one place a facet.
inline void draw_facets(int64_t first, int64_t last, In<double, 3> rays, int64_t n, const Facets &F, double background, In<double, 2> samples,
                        In<double, 2> weights, Out<float, 2> image, Out<int64_t, 1> candidates) {
    const int64_t width = rays.n[1] - 1;
    const Lattice lattice{weights, samples.n[0]};
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
                    Cross whole, cross;
                    const bool simple = found == 1 && F.crossed(pixel, candidates.data[0], whole);
                    for (int64_t b = 0; b < n; ++b)
                        for (int64_t a = 0; a < n; ++a) {
                            double corner[4][4];
                            for (int k = 0; k < 4; ++k) Quad::weights(double(a + k % 2) / double(n), double(b + k / 2) / double(n), corner[k]);
                            if (simple) {
                                whole.inner(corner, cross);
                                image(n * v + b, n * u + a) = float(cross.mean(lattice));
                                continue;
                            }
                            Quad sub;
                            for (int k = 0; k < 4; ++k) pixel.at(corner[k], sub.p[k]);
                            if (F.mixed(sub, background, candidates.data, found, gray)) {
                                if (found == 1 && F.crossed(sub, candidates.data[0], cross)) {
                                    gray = cross.mean(lattice);
                                } else {
                                    gray = 0.0;
                                    for (int64_t k = 0; k < samples.n[0]; ++k) {
                                        double ray[2], w[4];
                                        Quad::weights(samples(k, 0), samples(k, 1), w);
                                        sub.at(w, ray);
                                        gray += F.sample(ray, background, candidates.data, found);
                                    }
                                    gray /= double(samples.n[0]);
                                }
                            }
                            image(n * v + b, n * u + a) = float(gray);
                        }
                }
        }
}

typedef float Floats __attribute__((vector_size(8 * W), aligned(4), may_alias));
constexpr int64_t BAND = 8;  // rows of pixels made together, so that the sub-pixels above and below are still at hand

// Pixels first .. last - 1 of a sum of n x n sub-pixels under a point spread: weights (T,) of the sub-pixels from reach
// before a pixel's first one on, along rows and columns alike; beyond the border the image goes on as it is there. work:
// scratch, n rows for each of a band, as wide as image and weights together.
inline void spread_and_sum(int64_t first, int64_t last, In<float, 2> image, In<float, 1> weights, int64_t reach, int64_t n, Out<float, 2> out,
                           Out<float, 2> work) {
    constexpr int64_t LANES = 2 * W, BLOCK = 4 * LANES;
    const int64_t taps = weights.n[0], height = image.n[0], width = image.n[1], columns = out.n[1], wide = work.n[1];
    // Sums over the taps at all places of rows v0 .. v1 - 1, in blocks of which the last overlaps: source(v) gives the row
    // that each tap meets in turn, take(v, place, sums, m) gets what is ready.
    const auto sums = [&](int64_t v0, int64_t v1, int64_t n_places, const auto &source, const auto &take) {
        for (int64_t s = 0; s < n_places; s += n_places < BLOCK ? 1 : BLOCK) {
            const int64_t at = n_places < BLOCK ? s : smaller(s, n_places - BLOCK);
            for (int64_t v = v0; v < v1; ++v) {
                auto next = source(v);
                if (n_places < BLOCK) {
                    float sum = 0.0f;
                    for (int64_t t = 0; t < taps; ++t) sum += weights[t] * next()[at];
                    take(v, at, &sum, 1);
                    continue;
                }
                Floats sum[4] = {};
                for (int64_t t = 0; t < taps; ++t) {
                    const float *row = next() + at, weight = weights[t];
#pragma GCC unroll 4
                    for (int k = 0; k < 4; ++k) sum[k] += weight * *reinterpret_cast<const Floats *>(row + k * LANES);
                }
                take(v, at, reinterpret_cast<const float *>(sum), BLOCK);
            }
        }
    };
    for (int64_t v0 = first; v0 < last; v0 += BAND) {
        const int64_t v1 = smaller(v0 + BAND, last);
        const auto above = [&](int64_t v) {
            return [&, at = n * v - reach]() mutable { return image.data + smaller(larger(at++, int64_t(0)), height - 1) * width; };
        };
        // sub-pixels of a row, beside those with the same place in a pixel
        const auto columns_of = [&](int64_t v, int64_t s, const float *sum, int64_t m) {
            int64_t place = (s + reach) % n, pixel = (s + reach) / n;
            for (int64_t e = 0; e < m; ++e) {
                work((v - v0) * n + place, pixel) = sum[e];
                if (++place == n) place = 0, ++pixel;
            }
        };
        const auto beside = [&](int64_t v) {
            return [&, row = &work((v - v0) * n, 0), place = int64_t(0), pixel = int64_t(0)]() mutable {
                const float *now = row + place * wide + pixel;
                if (++place == n) place = 0, ++pixel;
                return now;
            };
        };
        sums(v0, v1, width, above, columns_of);
        for (int64_t v = v0; v < v1; ++v) {
            const auto made = [&](int64_t s) { return work((v - v0) * n + (s + reach) % n, (s + reach) / n); };
            const float left = made(0), right = made(width - 1);
            for (int64_t k = -reach; k < 0; ++k) columns_of(v, k, &left, 1);
            for (int64_t k = width; k + reach < n * wide; ++k) columns_of(v, k, &right, 1);
        }
        sums(v0, v1, columns, beside, [&](int64_t v, int64_t u, const float *sum, int64_t m) { std::memcpy(&out(v, u), sum, size_t(m) * sizeof *sum); });
    }
}

}  // namespace
