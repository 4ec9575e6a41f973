// Grids of corners: the colours of the squares between them, how straight they lie, and what a lens bends.
#pragma once
#include "planes.h"

namespace {

using Grid = In<double, 3>;  // corners (rows, columns, 2) px

// Grey value at a place (px), linear between pixels; beyond the border that of the border.
inline double gray_at(In<float, 2> image, double u, double v) {
    const auto within = [](double x, int64_t n) { return x > 0.0 ? smaller(x, double(n - 1)) : 0.0; };
    u = within(u, image.n[1]), v = within(v, image.n[0]);
    const int64_t i = int64_t(u), j = int64_t(v), right = smaller(i + 1, image.n[1] - 1), below = smaller(j + 1, image.n[0] - 1);
    const double s = u - double(i), t = v - double(j);
    return (1.0 - t) * ((1.0 - s) * image(j, i) + s * image(j, right)) + t * ((1.0 - s) * image(below, i) + s * image(below, right));
}

// Whether the colours change across every edge of a grid, and in turn. contrast: median step from dark to bright.
inline bool of_neighbours(In<float, 2> image, Grid grid, double contrast) {
    for (const bool turned : {false, true}) {
        const int64_t rows = grid.n[turned], columns = grid.n[!turned];
        const auto corner = [&](int64_t i, int64_t j) { return turned ? &grid(j, i, 0) : &grid(i, j, 0); };
        double agree = 0.0, n = 0.0;
        for (int64_t i = 0; i + 1 < rows; ++i)
            for (int64_t j = 1; j + 1 < columns; ++j) {
                const double *from = corner(i, j), *to = corner(i + 1, j), *left = corner(i, j - 1), *right = corner(i, j + 1);
                const double across[2] = {0.1 * (right[0] - left[0]), 0.1 * (right[1] - left[1])};
                for (const double t : {0.25, 0.5, 0.75}) {
                    const double u = from[0] + t * (to[0] - from[0]), v = from[1] + t * (to[1] - from[1]);
                    const double step = gray_at(image, u + across[0], v + across[1]) - gray_at(image, u - across[0], v - across[1]);
                    if (magnitude(step) > 0.4 * contrast) agree += (step > 0.0) == ((i + j - 1) % 2 == 0) ? 1.0 : -1.0;
                    n += 1.0;
                }
            }
        // four of five one way and none the other; which way says whether the first square is dark
        if (magnitude(agree) < 0.8 * n) return false;
    }
    return true;
}
// Whether the squares of the first one's colour are darker than the others, by their centres.
inline bool first_is_dark(In<float, 2> image, Grid grid) {
    double level[2] = {}, n[2] = {};
    for (int64_t i = 0; i + 1 < grid.n[0]; ++i)
        for (int64_t j = 0; j + 1 < grid.n[1]; ++j) {
            double centre[2];
            for (int a = 0; a < 2; ++a) centre[a] = 0.25 * (grid(i, j, a) + grid(i + 1, j, a) + grid(i, j + 1, a) + grid(i + 1, j + 1, a));
            level[(i + j) % 2] += gray_at(image, centre[0], centre[1]), n[(i + j) % 2] += 1.0;
        }
    return level[0] * n[1] < level[1] * n[0];
}

// Right square minus left square on the far side of a corner; edges: along the row, and to the near side, px.
inline double difference(In<float, 2> image, const double *at, const double *edges) {
    const double u = at[0] - 0.3 * edges[2], v = at[1] - 0.3 * edges[3];
    return gray_at(image, u + 0.3 * edges[0], v + 0.3 * edges[1]) - gray_at(image, u - 0.3 * edges[0], v - 0.3 * edges[1]);
}
// Whether the two squares beyond a place differ by more than step, and the other way than those before the corner that it
// continues. On a margin they are alike, whatever the board's own squares do there.
inline bool follows(In<float, 2> image, const double *corner, const double *place, const double *edges, double step) {
    const double beyond = difference(image, place, edges);
    return magnitude(beyond) > step && beyond * difference(image, corner, edges) < 0.0;
}
// The same of corners (n, 2) and places (n, 2), edges (n, 2, 2).
inline void squares_follow(In<float, 2> image, In<double, 2> corners, In<double, 2> places, In<double, 3> edges, double step, Out<bool, 1> follow) {
    for (int64_t i = 0; i < corners.n[0]; ++i) follow.data[i] = follows(image, &corners(i, 0), &places(i, 0), &edges(i, 0, 0), step);
}
// Whether, on each of the four sides of a grid, more than a share of the places of a next row follow it: before the first
// row, behind the last column, the last row, before the first column. The places are those of a parabola through the last
// corners: near enough for squares, not for corners.
inline void may_go_on(In<float, 2> image, Grid grid, double step, double share, Out<bool, 1> sides) {
    const int64_t rows = grid.n[0], columns = grid.n[1];
    for (int side = 0; side < 4; ++side) {
        sides.data[side] = rows < 3 || columns < 3;
        if (sides[side]) continue;
        const int64_t n = side % 2 ? rows : columns;
        const auto corner = [&](int64_t k, int64_t j) {
            return side == 0 ? &grid(k, j, 0) : side == 1 ? &grid(j, columns - 1 - k, 0) : side == 2 ? &grid(rows - 1 - k, j, 0) : &grid(j, k, 0);
        };
        int64_t seen = 0;
        for (int64_t j = 0; j < n; ++j) {
            const int64_t low = larger(j - 1, int64_t(0)), high = smaller(j + 1, n - 1);
            double place[2], edges[4];
            for (int a = 0; a < 2; ++a) {
                place[a] = 3.0 * (corner(0, j)[a] - corner(1, j)[a]) + corner(2, j)[a];
                edges[a] = (corner(0, high)[a] - corner(0, low)[a]) / double(high - low), edges[2 + a] = corner(0, j)[a] - place[a];
            }
            seen += follows(image, corner(0, j), place, edges, step);
        }
        sides.data[side] = double(seen) > share * double(n);
    }
}

// Second differences (rows, columns) of a grid, the larger of both ways, in squares; corners that are no number count for
// nothing. work: room for one number a corner.
inline void off_grid(Grid grid, Out<double, 2> off, Out<double, 1> work) {
    const int64_t rows = grid.n[0], columns = grid.n[1];
    int64_t n = 0;
    for (int64_t i = 0; i < rows; ++i)
        for (int64_t j = 0; j < columns; ++j) {
            off(i, j) = 0.0;
            const double step = j ? std::hypot(grid(i, j, 0) - grid(i, j - 1, 0), grid(i, j, 1) - grid(i, j - 1, 1)) : __builtin_nan("");
            if (std::isfinite(step)) work.data[n++] = step;
        }
    if (n == 0) return;
    const double spacing = median(work.data, n);
    const auto bent = [&](int64_t i, int64_t j, int64_t di, int64_t dj) {
        double d[2];
        for (int a = 0; a < 2; ++a) d[a] = grid(i + di, j + dj, a) - 2.0 * grid(i, j, a) + grid(i - di, j - dj, a);
        const double found = std::hypot(d[0], d[1]) / spacing;
        if (found > off(i, j)) off(i, j) = found;
    };
    for (int64_t i = 0; i < rows; ++i)
        for (int64_t j = 0; j < columns; ++j) {
            if (i && i + 1 < rows) bent(i, j, 1, 0);
            if (j && j + 1 < columns) bent(i, j, 0, 1);
        }
}

// 1, x, y, x^2, xy, y^2, x^3, x^2 y, x y^2, y^3.
inline void monomials(double x, double y, double *m) {
    const double all_of[] = {1.0, x, y, x * x, x * y, y * y, x * x * x, x * x * y, x * y * y, y * y * y};
    std::memcpy(m, all_of, sizeof all_of);
}
// Their second derivatives in the direction c, s.
inline void second_derivatives(double x, double y, double c, double s, double *m) {
    const double xx = c * c, xy = 2.0 * c * s, yy = s * s;
    const double all_of[] = {0.0, 0.0, 0.0, 2.0 * xx, xy, 2.0 * yy, 6.0 * x * xx, 2.0 * (y * xx + x * xy), 2.0 * (x * yy + y * xy), 6.0 * y * yy};
    std::memcpy(m, all_of, sizeof all_of);
}
// What a homography leaves of corners, as a polynomial of N terms of their places, which have mean zero and size one.
template <int N> struct Bending {
    double coefficients[N][2] = {}, unit_cov[N][N] = {}, variance = 0.0;

    // places, left: (m, 2); false where so few points, or as these lie, do not tell it from noise.
    bool fitted(const double *places, const double *left, int64_t m) {
        if (m < 2 * N) return false;
        double normal[N][N] = {}, right[N][2] = {}, size[N], axes[N][N], row[10], least = __builtin_inf(), most = 0.0;
        for (int64_t i = 0; i < m; ++i) {
            monomials(places[2 * i], places[2 * i + 1], row);
            for (int a = 0; a < N; ++a) {
                for (int c = 0; c < 2; ++c) right[a][c] += row[a] * left[2 * i + c];
                for (int b = 0; b < N; ++b) normal[a][b] += row[a] * row[b];
            }
        }
        eigen(normal, size, axes);
        for (const double s : size) least = smaller(least, s), most = larger(most, s);
        if (!(least * 1e6 >= most)) return false;
        for (int a = 0; a < N; ++a)
            for (int b = 0; b < N; ++b) {
                for (int k = 0; k < N; ++k) unit_cov[a][b] += axes[a][k] * axes[b][k] / size[k];
                for (int c = 0; c < 2; ++c) coefficients[a][c] += unit_cov[a][b] * right[b][c];
            }
        for (int64_t i = 0; i < m; ++i) {
            monomials(places[2 * i], places[2 * i + 1], row);
            for (int c = 0; c < 2; ++c) {
                double r = left[2 * i + c];
                for (int a = 0; a < N; ++a) r -= row[a] * coefficients[a][c];
                variance += r * r / double(2 * (m - N));
            }
        }
        return true;
    }
    // A corner at a place, moved to where its edges meet, each displaced along its normal, and the uncertainty of that.
    void unbend(double x, double y, double scale, const double *angles, const double *bend, double *uv, double *cov) const {
        double rows[2][10], normals[2][2], curvature[2] = {}, by[2][2], shared[2][2];
        for (int e = 0; e < 2; ++e) {
            const double c = std::cos(angles[e]), s = std::sin(angles[e]);
            second_derivatives(x, y, c, s, rows[e]);
            normals[e][0] = -s, normals[e][1] = c;
            for (int a = 0; a < N; ++a) rows[e][a] /= scale * scale, curvature[e] += rows[e][a] * (coefficients[a][1] * c - coefficients[a][0] * s);
        }
        for (int e = 0; e < 2; ++e)
            for (int f = 0; f < 2; ++f) {
                shared[e][f] = 0.0;
                for (int a = 0; a < N; ++a)
                    for (int b = 0; b < N; ++b) shared[e][f] += rows[e][a] * unit_cov[a][b] * rows[f][b];
                shared[e][f] *= variance * (normals[e][0] * normals[f][0] + normals[e][1] * normals[f][1]);
            }
        const double turn = normals[0][0] * normals[1][1] - normals[0][1] * normals[1][0];
        if (!(magnitude(turn) > 1e-9)) return;
        by[0][0] = normals[1][1] * bend[0] / turn, by[0][1] = -normals[0][1] * bend[1] / turn;
        by[1][0] = -normals[1][0] * bend[0] / turn, by[1][1] = normals[0][0] * bend[1] / turn;
        for (int c = 0; c < 2; ++c) {
            uv[c] -= by[c][0] * curvature[0] + by[c][1] * curvature[1];
            for (int d = 0; d < 2; ++d)
                for (int e = 0; e < 2; ++e)
                    for (int f = 0; f < 2; ++f) cov[2 * c + d] += by[c][e] * shared[e][f] * by[d][f];
        }
    }
};
// Corners uv (n, 2) px of a plane at xy (n, 2), freed from what bending does to a fit of straight edges, and the
// uncertainty of that in cov (n, 2, 2); learnt from those to keep, with a cubic of the place in the image or a square;
// false where too few are there. angles (n, 2) of the edges; bend (n, 2) px^2; work: room for eight numbers a corner.
inline bool unbend(In<double, 2> xy, Array<const bool, 1> keep, In<double, 2> angles, In<double, 2> bend, Out<double, 2> uv, Out<double, 3> cov,
                   Out<double, 1> work) {
    int64_t m = 0;
    const int64_t n = uv.n[0];
    double *from = work.data, *to = from + 2 * n, *places = to + 2 * n, *left = places + 2 * n, scale = 0.0, r[2];
    for (int64_t i = 0; i < n; ++i)
        if (keep.data[i]) {
            for (int a = 0; a < 2; ++a) from[2 * m + a] = xy(i, a), to[2 * m + a] = uv(i, a);
            ++m;
        }
    if (m < 4) return false;
    const Pairs pairs(from, to, m);
    Mat h;
    if (!linear_homography(pairs, h)) return false;
    closer_homography(pairs, 20, h);
    for (int64_t i = 0; i < 2 * m; ++i) scale = larger(scale, magnitude(to[i] - pairs.to.mean[i % 2]));
    for (int64_t i = 0; i < m; ++i) {
        Vec x, q;
        pairs.residual(h, i, x, q, r);
        for (int a = 0; a < 2; ++a) places[2 * i + a] = (to[2 * i + a] - pairs.to.mean[a]) / scale, left[2 * i + a] = -r[a] / pairs.to.scale;
    }
    const auto freed = [&](auto &&bending) {
        if (!bending.fitted(places, left, m)) return false;
        for (int64_t i = 0; i < n; ++i)
            bending.unbend((uv(i, 0) - pairs.to.mean[0]) / scale, (uv(i, 1) - pairs.to.mean[1]) / scale, scale, &angles(i, 0), &bend(i, 0), &uv(i, 0),
                           &cov(i, 0, 0));
        return true;
    };
    return freed(Bending<10>{}) || freed(Bending<6>{});
}

}  // namespace
