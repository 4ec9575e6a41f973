// Views of planes: homographies, and both poses of the camera that one allows.
#pragma once
#include "views.h"

namespace {

constexpr double SINGULAR = 1e-13;  // smallest against largest eigenvalue

// Eigenvalues of a symmetric A, which is used up, the largest first, and their vectors as the rows of `vectors`.
inline void sorted_eigen(Mat &A, Vec &values, Mat &vectors) {
    Vec found;
    Mat U;
    eigen(A, found, U);
    int order[3] = {0, 1, 2};
    for (const auto &[a, b] : {std::pair(0, 1), std::pair(1, 2), std::pair(0, 1)})
        if (found[order[a]] < found[order[b]]) std::swap(order[a], order[b]);
    for (int k = 0; k < 3; ++k) {
        values[k] = found[order[k]];
        for (int i = 0; i < 3; ++i) vectors[k][i] = U[i][order[k]];
    }
}
inline double determinant(const Mat &m) {
    Vec c;
    cross3(m[1], m[2], c);
    return dot3(m[0], c);
}

// Where points (n, 2) have mean zero and mean distance sqrt(2): scale times (p - mean) (Hartley, PAMI 19(6), 1997).
struct Unit {
    double scale, mean[2] = {};

    Unit(const double *p, int64_t n) {
        V x[2], total[2] = {}, away = V{};
        for (int64_t i = 0; i < n; i += W) {
            columns(p + 2 * i, n - i, x);
            for (int a = 0; a < 2; ++a) total[a] += first_lanes(n - i) * x[a];
        }
        for (int a = 0; a < 2; ++a) mean[a] = sum(total[a]) / double(n);
        for (int64_t i = 0; i < n; i += W) {
            columns(p + 2 * i, n - i, x);
            const V du = x[0] - mean[0], dv = x[1] - mean[1];
            away += first_lanes(n - i) * root(du * du + dv * dv);
        }
        scale = sum(away) > 0.0 ? std::sqrt(2.0) * double(n) / sum(away) : 1.0;
    }
    // W points of n from p on.
    void at(const double *p, int64_t n, V (&out)[2]) const {
        columns(p, n, out);
        for (int a = 0; a < 2; ++a) out[a] = scale * (out[a] - mean[a]);
    }
    void at(const double *p, Vec &out) const { out[0] = scale * (p[0] - mean[0]), out[1] = scale * (p[1] - mean[1]), out[2] = 1.0; }
};
// Points (n, 2) of a plane and of its image, each in its own unit.
struct Pairs {
    const double *xy, *uv;
    int64_t n;
    Unit from, to;

    Pairs(const double *x, const double *u, int64_t count) : xy(x), uv(u), n(count), from(x, count), to(u, count) {}
    // What h misses point i by; q: the point mapped, not divided; x: the point.
    void residual(const Mat &h, int64_t i, Vec &x, Vec &q, double *r) const {
        Vec u;
        from.at(xy + 2 * i, x), to.at(uv + 2 * i, u);
        for (int a = 0; a < 3; ++a) q[a] = dot3(h[a], x);
        for (int a = 0; a < 2; ++a) r[a] = q[a] / q[2] - u[a];
    }
    double square_sum(const Mat &h) const {
        double total = 0.0, r[2];
        Vec x, q;
        for (int64_t i = 0; i < n; ++i) residual(h, i, x, q, r), total += r[0] * r[0] + r[1] * r[1];
        return total;
    }
};

// h with u ~ h (x, y, 1) by the direct linear transformation (Hartley and Zisserman, Multiple View Geometry, alg. 4.2);
// false where it is not determined. The first two rows follow linearly from the last, the vector of length one with the
// least algebraic error (Harker and O'Leary, Computation of homographies, BMVC 2005).
inline bool linear_homography(const Pairs &p, Mat &h) {
    double M[4][3][3];  // sums of x x' with weights 1, u, v, u^2 + v^2
    V sums_of[4][6] = {};
    for (int64_t i = 0; i < p.n; i += W) {
        V x[2], u[2];
        p.from.at(p.xy + 2 * i, p.n - i, x), p.to.at(p.uv + 2 * i, p.n - i, u);
        const V weight[4] = {first_lanes(p.n - i), weight[0] * u[0], weight[0] * u[1], weight[0] * (u[0] * u[0] + u[1] * u[1])};
        const V product[6] = {x[0] * x[0], x[0] * x[1], x[0], x[1] * x[1], x[1], all<V>(1.0)};
        for (int k = 0; k < 4; ++k)
            for (int m = 0; m < 6; ++m) sums_of[k][m] += weight[k] * product[m];
    }
    for (int k = 0; k < 4; ++k)
        for (int a = 0, m = 0; a < 3; ++a)
            for (int b = a; b < 3; ++b, ++m) M[k][a][b] = M[k][b][a] = sum(sums_of[k][m]);
    Mat axes, rows[2];
    Vec size;
    const double trace = M[3][0][0] + M[3][1][1] + M[3][2][2], spread = M[0][0][0] + M[0][1][1];
    if (!cholesky(&M[0][0][0], 3, 3)) return false;
    const double area = M[0][0][0] * M[0][1][1];
    if (!(area * area > SINGULAR * spread * spread)) return false;
    std::memcpy(rows, M[1], sizeof rows);
    for (auto &row : rows) forward_solve(&M[0][0][0], 3, 3, &row[0][0], 3), backward_solve(&M[0][0][0], 3, 3, &row[0][0], 3);
    for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b)
            for (int c = 0; c < 3; ++c) M[3][a][b] -= M[1][c][a] * rows[0][c][b] + M[2][c][a] * rows[1][c][b];
    sorted_eigen(M[3], size, axes);
    if (!(size[1] > SINGULAR * trace)) return false;
    for (int a = 0; a < 3; ++a) h[0][a] = dot3(rows[0][a], axes[2]), h[1][a] = dot3(rows[1][a], axes[2]), h[2][a] = axes[2][a];
    if (!(determinant(h) > 0.0))
        for (auto &row : h)
            for (double &x : row) x = -x;
    return true;
}

// Gauss-Newton steps on the distances in the image, as long as these become smaller.
inline void closer_homography(const Pairs &p, int64_t steps, Mat &h) {
    double now = p.square_sum(h);
    for (int64_t step = 0; step < steps; ++step) {
        double A[9][9] = {}, b[9] = {}, *flat = &h[0][0], r[2];
        for (int64_t i = 0; i < p.n; ++i) {
            Vec x, q;
            p.residual(h, i, x, q, r);
            for (int k = 0; k < 2; ++k) {
                double J[9] = {};
                for (int a = 0; a < 3; ++a) J[3 * k + a] = x[a] / q[2], J[6 + a] = -x[a] * q[k] / (q[2] * q[2]);
                for (int a = 0; a < 9; ++a) {
                    b[a] -= J[a] * r[k];
                    for (int c = 0; c <= a; ++c) A[a][c] += J[a] * J[c];
                }
            }
        }
        // the scale of h has no effect: one more row holds it; points on a line leave more open
        for (int a = 0; a < 9; ++a)
            for (int c = 0; c <= a; ++c) A[a][c] += flat[a] * flat[c] + (a == c ? 1e-14 * double(p.n) : 0.0);
        if (!cholesky(&A[0][0], 9, 9)) return;
        forward_solve(&A[0][0], 9, 9, b, 1);
        backward_solve(&A[0][0], 9, 9, b, 1);
        Mat trial;
        for (int a = 0; a < 9; ++a) (&trial[0][0])[a] = flat[a] + b[a];
        const double there = p.square_sum(trial);
        if (!(there < now)) return;
        now = there;
        std::memcpy(h, trial, sizeof h);
    }
}
// The same in the units of the points.
inline void in_units(const Pairs &p, Mat &h) {
    for (auto &row : h) {
        for (int a = 0; a < 2; ++a) row[a] *= p.from.scale;
        row[2] -= row[0] * p.from.mean[0] + row[1] * p.from.mean[1];
    }
    for (int k = 0; k < 2; ++k)
        for (int a = 0; a < 3; ++a) h[k][a] = h[k][a] / p.to.scale + p.to.mean[k] * h[2][a];
}

// Of each listed view h with uv ~ h (x, y, 1), the rms and the median of what it misses, in the unit of uv, and whether
// it is determined. work: room for the points of the largest view.
inline void homographies(Ints which, Ints ptr, In<double, 2> xy, In<double, 2> uv, int64_t steps, Out<double, 3> h, Out<double, 2> misses,
                         Out<bool, 1> good, Out<double, 1> work) {
    for (int64_t i = 0; i < which.n[0]; ++i) {
        const int64_t b = which[i], first = ptr[b], n = ptr[b + 1] - first;
        Mat found = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
        misses(b, 0) = misses(b, 1) = __builtin_inf();
        good.data[b] = false;
        if (n > 3) {
            const Pairs p(&xy(first, 0), &uv(first, 0), n);
            good.data[b] = linear_homography(p, found);
            if (good.data[b]) {
                closer_homography(p, steps, found);
                double total = 0.0, r[2];
                for (int64_t k = 0; k < n; ++k) {
                    Vec x, q;
                    p.residual(found, k, x, q, r);
                    const double square = r[0] * r[0] + r[1] * r[1];
                    total += square, work.data[k] = root(square);
                }
                misses(b, 0) = root(total / double(n)) / p.to.scale, misses(b, 1) = median(work.data, n) / p.to.scale;
                in_units(p, found);
            }
        }
        std::memcpy(&h(b, 0, 0), found, sizeof found);
    }
}

// Points (n, 3) as ones of a plane: its centre, axes (rows, right-handed, the normal last) and extent, and coordinates
// (n, 2) of unit size; false where they are a line, or thicker than a share of their extent.
inline bool on_plane(const double *x, int64_t n, double thickness, Vec &centre, Mat &axes, double &extent, double *local) {
    Mat squares;
    Vec size;
    V p[3], total[3] = {}, products[6] = {}, most = V{};
    for (int64_t i = 0; i < n; i += W) {
        columns(x + 3 * i, n - i, p);
        for (int a = 0; a < 3; ++a) total[a] += first_lanes(n - i) * p[a];
    }
    for (int a = 0; a < 3; ++a) centre[a] = sum(total[a]) / double(n);
    for (int64_t i = 0; i < n; i += W) {
        columns(x + 3 * i, n - i, p);
        for (int a = 0; a < 3; ++a) p[a] -= centre[a];
        most = larger(most, p[0] * p[0] + p[1] * p[1] + p[2] * p[2]);
        for (int a = 0, m = 0; a < 3; ++a)
            for (int b = a; b < 3; ++b, ++m) products[m] += first_lanes(n - i) * p[a] * p[b];
    }
    for (int a = 0, m = 0; a < 3; ++a)
        for (int b = a; b < 3; ++b, ++m) squares[a][b] = squares[b][a] = sum(products[m]);
    extent = 0.0;
    for (int i = 0; i < W; ++i) extent = larger(extent, root(most[i]));
    sorted_eigen(squares, size, axes);
    cross3(axes[0], axes[1], axes[2]);
    for (double &s : size) s = root(larger(s, 0.0));
    if (!(size[1] > 1e-6 * size[0] && size[2] < thickness * size[0])) return false;
    for (int64_t i = 0; i < n; ++i)
        for (int k = 0; k < 2; ++k) local[2 * i + k] = (dot3(axes[k], x + 3 * i) - dot3(axes[k], centre)) * (1.0 / extent);
    return true;
}
// The smallest rotation that turns a direction, not nearly backwards, to +z.
inline void to_front(const double *direction, Mat &out) {
    const double size = root(dot3(direction, direction)), x = direction[0] / size, y = direction[1] / size, z = direction[2] / size;
    const double k = 1.0 / (1.0 + z);
    const Mat found = {{1.0 - x * x * k, -x * y * k, -x}, {-x * y * k, 1.0 - y * y * k, -y}, {x, y, z}};
    std::memcpy(out, found, sizeof out);
}

// Both rotations of a plane whose homography H, H22 = 1, is known at its origin; false where there is none.
inline bool infinitesimal(const Mat &H, Mat (&turns)[2]) {
    const Vec v = {H[0][2], H[1][2], 1.0};
    double J[2][2], A[2][2];
    Mat front;
    to_front(v, front);  // its transpose turns +z to the direction of the origin
    for (int i = 0; i < 2; ++i)
        for (int j = 0; j < 2; ++j) J[i][j] = H[i][j] - v[i] * H[2][j], A[i][j] = front[j][i] - v[i] * front[j][2];
    const double det = A[0][0] * A[1][1] - A[0][1] * A[1][0];
    if (!(magnitude(det) >= 1e-12)) return false;
    const double back[2][2] = {{A[1][1] / det, -A[0][1] / det}, {-A[1][0] / det, A[0][0] / det}};
    for (int i = 0; i < 2; ++i)
        for (int j = 0; j < 2; ++j) A[i][j] = back[i][0] * J[0][j] + back[i][1] * J[1][j];
    // the larger singular value
    const double sum = A[0][0] * A[0][0] + A[0][1] * A[0][1] + A[1][0] * A[1][0] + A[1][1] * A[1][1];
    const double product = A[0][0] * A[1][1] - A[0][1] * A[1][0];
    const double gamma = root(0.5 * (sum + root(larger(sum * sum - 4.0 * product * product, 0.0))));
    if (!(gamma > 1e-12)) return false;
    Vec columns[3];
    for (int j = 0; j < 2; ++j) {
        for (int i = 0; i < 2; ++i) columns[j][i] = A[i][j] / gamma;
        columns[j][2] = root(larger(1.0 - columns[j][0] * columns[j][0] - columns[j][1] * columns[j][1], 0.0));
    }
    if (columns[0][0] * columns[1][0] + columns[0][1] * columns[1][1] > 0.0) columns[1][2] = -columns[1][2];
    for (auto &turn : turns) {
        cross3(columns[0], columns[1], columns[2]);
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) turn[i][j] = front[0][i] * columns[j][0] + front[1][i] * columns[j][1] + front[2][i] * columns[j][2];
        columns[0][2] = -columns[0][2], columns[1][2] = -columns[1][2];
    }
    return true;
}
// The translation with which the turned points of a plane fall on their images, by linear least squares.
inline bool shift_of(const Mat &turn, const double *local, const double *xy, int64_t n, Vec &out) {
    double A[3][3] = {};
    V p[2] = {}, u[2] = {}, right[3] = {}, left[3] = {};
    for (int64_t i = 0; i < n; i += W) {
        columns(local + 2 * i, n - i, p), columns(xy + 2 * i, n - i, u);
        const V one = first_lanes(n - i), depth = turn[2][0] * p[0] + turn[2][1] * p[1];
        V r[2];
        for (int a = 0; a < 2; ++a) {
            r[a] = one * (u[a] * depth - (turn[a][0] * p[0] + turn[a][1] * p[1]));
            right[a] += r[a], right[2] -= u[a] * r[a], left[a] -= one * u[a], left[2] += one * u[a] * u[a];
        }
    }
    for (int a = 0; a < 3; ++a) out[a] = sum(right[a]), A[2][a] = sum(left[a]);
    A[0][0] = A[1][1] = double(n);
    if (!cholesky(&A[0][0], 3, 3)) return false;
    forward_solve(&A[0][0], 3, 3, out, 1);
    backward_solve(&A[0][0], 3, 3, out, 1);
    return true;
}

// Both poses camera_from_target of one view, or false. room: four numbers for each of its points.
inline bool poses_of_plane(const double *x, const double *rays, int64_t n, double thickness, double widest, Pose (&out)[2], double *room) {
    double *local = room, *xy = room + 2 * n, extent;
    Vec mean = {}, centre;
    Mat front, axes, H, turns[2];
    for (int64_t i = 0; i < n; ++i)
        for (int a = 0; a < 3; ++a) mean[a] += rays[3 * i + a];
    if (!(mean[2] > -0.5 * root(dot3(mean, mean)))) return false;
    to_front(mean, front);
    for (int64_t i = 0; i < n; ++i) {
        const double depth = dot3(front[2], rays + 3 * i);
        if (!(depth > widest)) return false;
        for (int k = 0; k < 2; ++k) xy[2 * i + k] = dot3(front[k], rays + 3 * i) * (1.0 / depth);
    }
    if (!on_plane(x, n, thickness, centre, axes, extent, local)) return false;
    const Pairs pairs(local, xy, n);
    if (!linear_homography(pairs, H)) return false;
    in_units(pairs, H);
    const double size = H[2][2];
    for (auto &row : H)
        for (double &h : row) h /= size;
    if (!infinitesimal(H, turns)) return false;
    for (int k = 0; k < 2; ++k) {
        Vec shift;
        Mat half;
        if (!shift_of(turns[k], local, xy, n, shift)) return false;
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) half[i][j] = turns[k][i][0] * axes[0][j] + turns[k][i][1] * axes[1][j] + turns[k][i][2] * axes[2][j];
        std::memset(out[k], 0, sizeof out[k]);
        for (int i = 0; i < 3; ++i) {
            for (int a = 0; a < 3; ++a) {
                for (int j = 0; j < 3; ++j) out[k][i][j] += front[a][i] * half[a][j];
                out[k][i][3] += front[a][i] * extent * shift[a];
            }
            out[k][i][3] -= dot3(out[k][i], centre);
            if (!std::isfinite(out[k][i][3])) return false;
        }
        out[k][3][3] = 1.0;
    }
    return true;
}
// Both poses of each listed view of a plane, from the first derivatives of the homography at the centroid and, for the
// translations, by linear least squares (Collins and Bartoli, Infinitesimal plane-based pose estimation, IJCV 109, 2014).
// found: not those of less than four points, off a plane or on a line, or with rays far from their mean, whose poses are
// the identity. widest: cosine of what is too far. work: four numbers for each point of the largest view.
inline void plane_poses(Ints which, const Views &v, double thickness, double widest, Out<double, 4> poses, Out<bool, 1> found, Out<double, 1> work) {
    for (int64_t i = 0; i < which.n[0]; ++i) {
        const int64_t k = which[i], first = v.first(k), n = v.size(k);
        Pose both[2];
        found.data[k] = n > 3 && poses_of_plane(&v.x(first, 0), &v.rays(first, 0), n, thickness, widest, both, work.data);
        for (int m = 0; m < 2 && !found.data[k]; ++m)
            for (int a = 0; a < 16; ++a) both[m][a / 4][a % 4] = a / 4 == a % 4;
        std::memcpy(&poses(k, 0, 0, 0), both, sizeof both);
    }
}

}  // namespace
