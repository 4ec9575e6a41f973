// Bundles with unknown points: rows, Schur complements, back-substitution, covariances; see adjust.observations.images.bundles.
//
// Local unknowns: the free lens parameters of every camera, six of camera_from_world per block (tangent on the right),
// then the points that stay (tied to other observations). The other points are reduced one by one (Brown 1958; Triggs et
// al. 2000, "Bundle adjustment - a modern synthesis", section 6). Observations are sorted by point, then camera.
#pragma once
#include "images.h"

namespace {

constexpr int ROW = MAX_LENS + 7;  // of one image point: lens in 0.., pose in MAX_LENS.., residual last
constexpr int WIDE = 8;            // six columns of a pose, padded to whole vectors
constexpr int AT_POSE = MAX_LENS, AT_POINT = MAX_LENS + 3, AT_RESIDUAL = MAX_LENS + 6;

struct Bundle {
    explicit Bundle(Reader &r)
        : block(r), camera_of(r), pose_at(r), point_at(r), ptr(r), point_of(r), by_block(r), by_ptr(r), pc_ptr(r), pc_camera(r), pc_of(r),
          n_lens(r), lens_at(r), first_pose(taken<int64_t>(r)) {}
    Ints block, camera_of, pose_at, point_at;  // of every observation
    Ints ptr, point_of;                        // of every reduced point, of every observation of one
    Ints by_block, by_ptr;                     // observations of reduced points image by image
    Ints pc_ptr, pc_camera, pc_of;             // pairs of a reduced point and a camera
    Ints n_lens, lens_at;
    int64_t first_pose;

    int64_t points() const { return ptr.n[0] - 1; }
    int64_t n_of_pair(int64_t i) const { return n_lens[pc_camera[i]]; }
    int64_t at_pair(int64_t i) const { return lens_at[pc_camera[i]]; }
};

// Whitened rows A (K, 2, ROW); chi (B,), least depth (B,). The derivative by the point equals that by the translation.
inline void bundle_rows(Ints block, Ints camera, const Lenses &L, In<double, 3> R, In<double, 2> t, In<double, 2> X, In<double, 2> uv,
                        In<double, 2> weights, Out<double, 3> A, Out<double, 1> chi, Out<double, 1> depth) {
    for (int64_t b = 0; b < chi.n[0]; ++b) chi.data[b] = 0.0, depth.data[b] = __builtin_inf();
    for (int64_t k = 0; k < block.n[0]; ++k) {
        const int64_t b = block[k], c = camera[b];
        const double *T = &R(b, 0, 0), *x = &X(k, 0), w00 = weights(k, 0), w01 = weights(k, 1), w11 = weights(k, 2);
        double q[3], r[2], d[2][N_COLUMNS];
        for (int i = 0; i < 3; ++i) q[i] = T[3 * i] * x[0] + T[3 * i + 1] * x[1] + T[3 * i + 2] * x[2] + t(b, i);
        with_lens(L.kind[c], [&]<class Lens>(Lens) { lens_row<Lens>(&L.values(c, 0), &L.constants(c, 0), q, uv(k, 0), uv(k, 1), r, d); });
        for (int s = 0; s < 2; ++s) {
            double *out = &A(k, s, 0);
            const auto white = [&](double u, double v) { return s == 0 ? w00 * u + w01 * v : w11 * v; };
            for (int64_t j = 0; j < L.n_free[c]; ++j) out[j] = 0.0;
            for (int64_t i = 0; i < L.n_map[c]; ++i) {
                const int64_t from = L.source(c, i);
                out[L.column(c, i)] += L.factor(c, i) * white(d[0][from], d[1][from]);
            }
            double g[3], h[3];
            for (int i = 0; i < 3; ++i) g[i] = white(d[0][MAX_LENS + i], d[1][MAX_LENS + i]);
            for (int i = 0; i < 3; ++i) h[i] = g[0] * T[i] + g[1] * T[3 + i] + g[2] * T[6 + i];
            out += AT_POSE;
            out[0] = x[1] * h[2] - x[2] * h[1], out[1] = x[2] * h[0] - x[0] * h[2], out[2] = x[0] * h[1] - x[1] * h[0];
            out[3] = h[0], out[4] = h[1], out[5] = h[2];
            out[6] = white(r[0], r[1]);
            chi.data[b] += out[6] * out[6];
        }
        if (w00 > 0.0) depth.data[b] = smaller(depth.data[b], q[2]);
    }
}

// Normal matrix (B, 6, 6) of each block's pose by its own image points alone, all points known.
inline void block_squares(Ints block, In<double, 3> A, Out<double, 3> out) {
    std::memset(out.data, 0, sizeof(double) * 36 * out.n[0]);
    for (int64_t k = 0; k < block.n[0]; ++k)
        for (int s = 0; s < 2; ++s) {
            const double *a = &A(k, s, AT_POSE);
            double *o = &out(block[k], 0, 0);
            for (int i = 0; i < 6; ++i)
                for (int j = 0; j < 6; ++j) o[6 * i + j] += a[i] * a[j];
        }
}

// Inverse of a symmetric positive definite V (3, 3); false where a pivot vanishes against its diagonal.
inline bool invert3(const double (&V)[3][3], double *out) {
    const double a = V[0][0], b = V[0][1], c = V[0][2], d = V[1][1], e = V[1][2], f = V[2][2];
    if (!(a > 0.0)) return false;
    const double d2 = d - b * b / a;
    if (!(d2 > 1e-12 * d)) return false;
    const double e2 = e - b * c / a, f2 = f - c * c / a - e2 * e2 / d2;
    if (!(f2 > 1e-12 * f)) return false;
    const double i = 1.0 / (a * d2 * f2);
    out[0] = (d * f - e * e) * i, out[4] = (a * f - c * c) * i, out[8] = (a * d - b * b) * i;
    out[1] = out[3] = (c * e - b * f) * i;
    out[2] = out[6] = (b * e - c * d) * i;
    out[5] = out[7] = (b * c - a * e) * i;
    return true;
}

// The row of observation k by its lens, its pose and a point that stays: where each number stands, and the numbers.
struct DirectRow {
    int64_t index[MAX_LENS + 9];
    double a[2][MAX_LENS + 9];
    int n;

    DirectRow(const Bundle &b, int64_t k, In<double, 3> A) {
        const int64_t c = b.camera_of[k], nl = b.n_lens[c];
        n = int(nl + 6);
        for (int64_t j = 0; j < nl; ++j) index[j] = b.lens_at[c] + j;
        for (int j = 0; j < 6; ++j) index[nl + j] = b.pose_at[k] + j;
        const bool stays = b.point_at[k] >= 0;
        for (int j = 0; stays && j < 3; ++j) index[nl + 6 + j] = b.point_at[k] + j;
        for (int s = 0; s < 2; ++s) {
            for (int64_t j = 0; j < nl; ++j) a[s][j] = A(k, s, j);
            for (int j = 0; j < 6; ++j) a[s][nl + j] = A(k, s, AT_POSE + j);
            for (int j = 0; stays && j < 3; ++j) a[s][nl + 6 + j] = A(k, s, AT_POINT + j);
        }
        n += stays ? 3 : 0;
    }
};

// Add observations first .. last as they are: points that stay or are held. To the lower triangle of S, and all of a
// pose's own block.
inline void add_direct(int64_t first, int64_t last, const Bundle &b, In<double, 3> A, Out<double, 2> S, Out<double, 1> g) {
    for (int64_t k = first; k < last; ++k) {
        const DirectRow row(b, k, A);
        const int nl = int(b.n_lens[b.camera_of[k]]);
        for (int s = 0; s < 2; ++s)
            for (int i = 0; i < row.n; ++i) {
                g.data[row.index[i]] += row.a[s][i] * A(k, s, AT_RESIDUAL);
                for (int j = 0; j < row.n; ++j)
                    if (row.index[j] <= row.index[i] || (nl <= i && i < j && j < nl + 6)) S(row.index[i], row.index[j]) += row.a[s][i] * row.a[s][j];
            }
    }
}

inline void times3(const double *M, const double *x, double *out) {
    for (int a = 0; a < 3; ++a) out[a] = M[3 * a] * x[0] + M[3 * a + 1] * x[1] + M[3 * a + 2] * x[2];
}

// Reduce the points: their share in g and among lenses in S (lower); -1, or the bad point. W (K, 3, 6), WL (pairs, 3,
// MAX_LENS), Vi (P, 3, 3), h (P, 3) stay: for pose_rows, which does the rest of S, and for the back-substitution.
inline int64_t reduce_points(const Bundle &b, In<double, 3> A, double damping, Out<double, 2> S, Out<double, 1> g, Out<double, 3> Vi,
                             Out<double, 3> weights, Out<double, 3> WL, Out<double, 2> h) {
    for (int64_t j = 0; j < b.points(); ++j) {
        double V3[3][3] = {}, vh[3], Y[3][MAX_LENS];
        double *hj = &h(j, 0);
        hj[0] = hj[1] = hj[2] = 0.0;
        for (int64_t i = b.pc_ptr[j]; i < b.pc_ptr[j + 1]; ++i) std::memset(&WL(i, 0, 0), 0, sizeof(double) * 3 * MAX_LENS);
        for (int64_t k = b.ptr[j]; k < b.ptr[j + 1]; ++k) {
            const int64_t c = b.camera_of[k], nl = b.n_lens[c], at = b.lens_at[c];
            double *wl = &WL(b.pc_of[k], 0, 0), *w = &weights(k, 0, 0);
            for (int s = 0; s < 2; ++s) {
                const double *a = &A(k, s, 0), r = a[AT_RESIDUAL];
                for (int p = 0; p < 3; ++p) {
                    const double x = a[AT_POINT + p];
                    hj[p] += x * r;
                    for (int q = p; q < 3; ++q) V3[p][q] += x * a[AT_POINT + q];
                    for (int64_t q = 0; q < nl; ++q) wl[MAX_LENS * p + q] += x * a[q];
                }
                for (int64_t p = 0; p < nl; ++p) {
                    g.data[at + p] += a[p] * r;
                    double *to = &S(at + p, at);
                    for (int64_t q = 0; q <= p; ++q) to[q] += a[p] * a[q];
                }
            }
            const double *u = &A(k, 0, 0), *v = &A(k, 1, 0);
            for (int p = 0; p < 3; ++p)
                for (int q = 0; q < 6; ++q) w[6 * p + q] = u[AT_POINT + p] * u[AT_POSE + q] + v[AT_POINT + p] * v[AT_POSE + q];
        }
        for (int p = 0; p < 3; ++p) V3[p][p] *= 1.0 + damping;
        if (!invert3(V3, &Vi(j, 0, 0))) return j;
        times3(&Vi(j, 0, 0), hj, vh);
        for (int64_t k = b.ptr[j]; k < b.ptr[j + 1]; ++k) {
            const double *u = &A(k, 0, 0), *v = &A(k, 1, 0), *w = &weights(k, 0, 0);
            double *o = g.data + b.pose_at[k];
            for (int q = 0; q < 6; ++q)
                o[q] += u[AT_POSE + q] * u[AT_RESIDUAL] + v[AT_POSE + q] * v[AT_RESIDUAL] - (w[q] * vh[0] + w[6 + q] * vh[1] + w[12 + q] * vh[2]);
        }
        for (int64_t i = b.pc_ptr[j]; i < b.pc_ptr[j + 1]; ++i) {
            const int64_t ni = b.n_of_pair(i), oi = b.at_pair(i);
            const double *wi = &WL(i, 0, 0), *vi = &Vi(j, 0, 0);
            for (int a = 0; a < 3; ++a)
                for (int64_t q = 0; q < ni; ++q) Y[a][q] = vi[3 * a] * wi[q] + vi[3 * a + 1] * wi[MAX_LENS + q] + vi[3 * a + 2] * wi[2 * MAX_LENS + q];
            for (int64_t q = 0; q < ni; ++q) g.data[oi + q] -= wi[q] * vh[0] + wi[MAX_LENS + q] * vh[1] + wi[2 * MAX_LENS + q] * vh[2];
            for (int64_t m = b.pc_ptr[j]; m < b.pc_ptr[j + 1]; ++m) {
                const int64_t om = b.at_pair(m), nm = b.n_of_pair(m);
                const double *wm = &WL(m, 0, 0);
                for (int64_t q = 0; q < ni; ++q) {
                    double *to = &S(oi + q, om);
                    const int64_t end = smaller(nm, oi + q - om + 1);
                    for (int64_t p = 0; p < end; ++p) to[p] -= wm[p] * Y[0][q] + wm[MAX_LENS + p] * Y[1][q] + wm[2 * MAX_LENS + p] * Y[2][q];
                }
            }
        }
    }
    return -1;
}

struct Six {  // six numbers and two of padding
    V v[WIDE / W];
};
inline Six load_six(const double *p) {
    Six o;
    for (int i = 0; i < WIDE / W; ++i) o.v[i] = load(p + i * W);
    return o;
}

// Rows of S, up to the diagonal block, of the poses of the blocks in run: from the reduced points alone. Image by image,
// so that what is written stays in the fastest cache. T: scratch (n_local, WIDE).
inline void pose_rows(Ints run, const Bundle &b, In<double, 3> A, In<double, 3> Vi, In<double, 3> weights, In<double, 3> WL, Out<double, 2> S,
                      Out<double, 2> T) {
    for (int64_t index = 0; index < run.n[0]; ++index) {
        const int64_t block = run[index], o = b.first_pose + 6 * block;
        std::memset(T.data, 0, sizeof(double) * WIDE * (o + 6));
        for (int64_t i = b.by_ptr[block]; i < b.by_ptr[block + 1]; ++i) {
            const int64_t k = b.by_block[i], j = b.point_of[k];
            const double *vi = &Vi(j, 0, 0), *w = &weights(k, 0, 0);
            double padded_y[3][WIDE] = {};
            for (int a = 0; a < 3; ++a)
                for (int q = 0; q < 6; ++q) padded_y[a][q] = vi[3 * a] * w[q] + vi[3 * a + 1] * w[6 + q] + vi[3 * a + 2] * w[12 + q];
            const Six y0 = load_six(padded_y[0]), y1 = load_six(padded_y[1]), y2 = load_six(padded_y[2]);
            const auto subtract = [&](const double *x, int64_t ld, int64_t at, int64_t n) {
                for (int64_t q = 0; q < n; ++q) {
                    double *to = T.data + WIDE * (at + q);
                    for (int e = 0; e < WIDE / W; ++e)
                        store(to + e * W, load(to + e * W) - (x[q] * y0.v[e] + x[ld + q] * y1.v[e] + x[2 * ld + q] * y2.v[e]));
                }
            };
            for (int64_t m = b.ptr[j]; m < b.ptr[j + 1]; ++m)
                if (b.block[m] <= block) subtract(&weights(m, 0, 0), 6, b.first_pose + 6 * b.block[m], 6);
            for (int64_t n = b.pc_ptr[j]; n < b.pc_ptr[j + 1]; ++n) subtract(&WL(n, 0, 0), MAX_LENS, b.at_pair(n), b.n_of_pair(n));
            const int64_t c = b.camera_of[k];
            for (int s = 0; s < 2; ++s) {
                const double *a = &A(k, s, 0);
                for (int64_t q = 0; q < b.n_lens[c]; ++q)
                    for (int p = 0; p < 6; ++p) T(b.lens_at[c] + q, p) += a[q] * a[AT_POSE + p];
                for (int q = 0; q < 6; ++q)
                    for (int p = 0; p < 6; ++p) T(o + q, p) += a[AT_POSE + q] * a[AT_POSE + p];
            }
        }
        for (int p = 0; p < 6; ++p) {
            double *to = &S(o + p, 0);
            for (int64_t c = 0; c < o + 6; ++c) to[c] += T.data[WIDE * c + p];
        }
    }
}

// Copy the lower triangle of S (n, n) to the upper one, in squares that stay in the cache.
inline void fill_upper(Out<double, 2> S) {
    const int64_t n = S.n[0], side = 32;
    for (int64_t i0 = 0; i0 < n; i0 += side)
        for (int64_t j0 = 0; j0 <= i0; j0 += side)
            for (int64_t i = i0; i < smaller(n, i0 + side); ++i)
                for (int64_t j = j0; j < smaller(i, j0 + side); ++j) S(j, i) = S(i, j);
}

// Rows of a symmetric S of which only the lower triangle is there, out (r, n).
inline void symmetric_rows(In<double, 2> S, Ints rows, Out<double, 2> out) {
    for (int64_t i = 0; i < rows.n[0]; ++i)
        for (int64_t c = 0, a = rows[i]; c < S.n[0]; ++c) out(i, c) = c <= a ? S(a, c) : S(c, a);
}

// Blocks out[6a.., 6b..] of J_a' S J_b (inward), S at rows at[a], at[b]: its lower triangle, a >= b. Else the other way:
// out at at[a], at[b] of J_a S J_b', S at 6a, 6b. lower: only that of out, not mirrored.
inline void between_poses(In<double, 2> S, Ints at, In<double, 3> J, int64_t inward, int64_t lower, Out<double, 2> out) {
    double M[6][6], K[6][6], C[6][6];
    for (int64_t a = 0; a < at.n[0]; ++a)
        for (int64_t b = 0; b <= a; ++b) {
            const int64_t r = inward ? at[a] : 6 * a, c = inward ? at[b] : 6 * b;
            const int64_t ro = inward ? 6 * a : at[a], co = inward ? 6 * b : at[b];
            const double *ja = &J(a, 0, 0), *jb = &J(b, 0, 0);
            for (int p = 0; p < 6; ++p)
                for (int q = 0; q < 6; ++q) M[p][q] = inward && c > r ? S(c + q, r + p) : S(r + p, c + q);
            std::memset(K, 0, sizeof K), std::memset(C, 0, sizeof C);
            for (int p = 0; p < 6; ++p)
                for (int i = 0; i < 6; ++i) {
                    const double x = inward ? ja[6 * i + p] : ja[6 * p + i];
                    for (int q = 0; q < 6; ++q) K[p][q] += x * M[i][q];
                }
            for (int p = 0; p < 6; ++p)
                for (int i = 0; i < 6; ++i)
                    for (int q = 0; q < 6; ++q) C[p][q] += K[p][i] * (inward ? jb[6 * i + q] : jb[6 * q + i]);
            for (int p = 0; p < 6; ++p)
                for (int q = 0; q < 6; ++q) {
                    out(ro + p, co + q) = C[p][q];
                    if (!lower && a != b) out(co + q, ro + p) = C[p][q];
                }
        }
}

// All of a reduced point j that is not its own: f(weights, their rows' length, where, how many) of its pairs and images.
template <class F> inline void through_point(const Bundle &b, int64_t j, In<double, 3> weights, In<double, 3> WL, F f) {
    for (int64_t i = b.pc_ptr[j]; i < b.pc_ptr[j + 1]; ++i) f(&WL(i, 0, 0), int64_t(MAX_LENS), b.at_pair(i), b.n_of_pair(i));
    for (int64_t k = b.ptr[j]; k < b.ptr[j + 1]; ++k) f(&weights(k, 0, 0), int64_t(6), b.pose_at[k], int64_t(6));
}
// f(c, none) of columns 0 .. m - 1: of W from c on together where none is a vector, one by one where it is a number.
template <class F> inline void by_columns(int64_t m, F f) {
    int64_t c = 0;
    for (; c + W <= m; c += W) f(c, V{});
    for (; c < m; ++c) f(c, 0.0);
}

// Of one point N vectors of columns from c on: so many sums are under way at a time.
template <class S, int N>
inline void follow(const Bundle &b, int64_t j, In<double, 3> Vi, In<double, 3> weights, In<double, 3> WL, In<double, 3> h, In<double, 2> d,
                   Out<double, 3> dX, int64_t c) {
    constexpr int64_t lanes = sizeof(S) / sizeof(double);
    S s[3][N];
    for (int a = 0; a < 3; ++a)
        for (int i = 0; i < N; ++i) s[a][i] = loaded<S>(&h(j, a, c + lanes * i));
    through_point(b, j, weights, WL, [&](const double *w, int64_t ld, int64_t at, int64_t n) {
        for (int64_t q = 0; q < n; ++q)
            for (int i = 0; i < N; ++i) {
                const S x = loaded<S>(&d(at + q, c + lanes * i));
                for (int a = 0; a < 3; ++a) s[a][i] += w[ld * a + q] * x;
            }
    });
    for (int a = 0; a < 3; ++a)
        for (int i = 0; i < N; ++i)
            store(&dX(j, a, c + lanes * i), -(Vi(j, a, 0) * s[0][i] + Vi(j, a, 1) * s[1][i] + Vi(j, a, 2) * s[2][i]));
}

// Steps dX (P, 3, m) of the reduced points from steps d (n_local, m) of the local unknowns; h: their own part.
inline void back_substitute(const Bundle &b, In<double, 3> Vi, In<double, 3> weights, In<double, 3> WL, In<double, 3> h, In<double, 2> d,
                            Out<double, 3> dX) {
    constexpr int N = 4;
    for (int64_t j = 0; j < b.points(); ++j) {
        int64_t c = 0;
        for (; c + N * W <= d.n[1]; c += N * W) follow<V, N>(b, j, Vi, weights, WL, h, d, dX, c);
        for (; c + W <= d.n[1]; c += W) follow<V, 1>(b, j, Vi, weights, WL, h, d, dX, c);
        for (; c < d.n[1]; ++c) follow<double, 1>(b, j, Vi, weights, WL, h, d, dX, c);
    }
}

// Subtract W' v from out (n_local, m), for v (P, 3, m): what reduced points carry over to the others.
inline void of_points(const Bundle &b, In<double, 3> weights, In<double, 3> WL, In<double, 3> v, Out<double, 2> out) {
    for (int64_t j = 0; j < b.points(); ++j)
        by_columns(out.n[1], [&](int64_t c, auto none) {
            using S = decltype(none);
            const S x[3] = {loaded<S>(&v(j, 0, c)), loaded<S>(&v(j, 1, c)), loaded<S>(&v(j, 2, c))};
            if (!any((x[0] != 0.0) | (x[1] != 0.0) | (x[2] != 0.0))) return;  // of most, where few points have something
            through_point(b, j, weights, WL, [&](const double *w, int64_t ld, int64_t at, int64_t n) {
                for (int64_t q = 0; q < n; ++q)
                    store(&out(at + q, c), loaded<S>(&out(at + q, c)) - (w[q] * x[0] + w[ld + q] * x[1] + w[2 * ld + q] * x[2]));
            });
        });
}

// -V^-1 W by poses, Y (K, 3, 6), and by lenses, YL (pairs, 3, MAX_LENS).
inline void point_from_local(const Bundle &b, In<double, 3> Vi, In<double, 3> weights, In<double, 3> WL, Out<double, 3> Y, Out<double, 3> YL) {
    const auto turned = [](const double *v, const double *w, int n, double *out) {
        for (int a = 0; a < 3; ++a)
            for (int q = 0; q < n; ++q) out[n * a + q] = -(v[3 * a] * w[q] + v[3 * a + 1] * w[n + q] + v[3 * a + 2] * w[2 * n + q]);
    };
    for (int64_t j = 0; j < b.points(); ++j) {
        for (int64_t k = b.ptr[j]; k < b.ptr[j + 1]; ++k) turned(&Vi(j, 0, 0), &weights(k, 0, 0), 6, &Y(k, 0, 0));
        for (int64_t i = b.pc_ptr[j]; i < b.pc_ptr[j + 1]; ++i) turned(&Vi(j, 0, 0), &WL(i, 0, 0), MAX_LENS, &YL(i, 0, 0));
    }
}

// Covariance B (K, 3, 6) of every observation's reduced point with its pose, for the blocks in run, image by image. P:
// scratch (n_local, WIDE), zero beyond the sixth column.
inline void with_poses(Ints run, const Bundle &b, In<double, 2> Q, In<double, 3> Y, In<double, 3> YL, Out<double, 3> B, Out<double, 2> P) {
    const int64_t n = Q.n[0];
    for (int64_t index = 0; index < run.n[0]; ++index) {
        const int64_t block = run[index], o = b.first_pose + 6 * block;
        for (int64_t r = 0; r < n; ++r)
            for (int q = 0; q < 6; ++q) P(r, q) = Q(o + q, r);
        for (int64_t i = b.by_ptr[block]; i < b.by_ptr[block + 1]; ++i) {
            const int64_t k = b.by_block[i], j = b.point_of[k];
            Six s[3] = {};
            const auto add = [&](const double *y, int64_t ld, int64_t at, int64_t count) {
                for (int64_t q = 0; q < count; ++q) {
                    const Six p = load_six(P.data + WIDE * (at + q));
                    for (int a = 0; a < 3; ++a)
                        for (int e = 0; e < WIDE / W; ++e) s[a].v[e] += y[ld * a + q] * p.v[e];
                }
            };
            for (int64_t m = b.ptr[j]; m < b.ptr[j + 1]; ++m) add(&Y(m, 0, 0), 6, b.first_pose + 6 * b.block[m], 6);
            for (int64_t c = b.pc_ptr[j]; c < b.pc_ptr[j + 1]; ++c) add(&YL(c, 0, 0), MAX_LENS, b.at_pair(c), b.n_of_pair(c));
            for (int a = 0; a < 3; ++a)
                for (int q = 0; q < 6; ++q) B(k, a, q) = s[a].v[q / W][q % W];
        }
    }
}

// Covariance BL (pairs, 3, MAX_LENS) of reduced points with lenses, and their own C (P, 3, 3).
inline void with_lenses(const Bundle &b, In<double, 3> Vi, In<double, 2> Q, In<double, 3> Y, In<double, 3> YL, In<double, 3> B, Out<double, 3> BL,
                        Out<double, 3> C) {
    for (int64_t j = 0; j < b.points(); ++j) {
        std::memcpy(&C(j, 0, 0), &Vi(j, 0, 0), sizeof(double) * 9);
        for (int64_t i = b.pc_ptr[j]; i < b.pc_ptr[j + 1]; ++i)
            for (int64_t p = 0; p < b.n_of_pair(i); ++p) {
                const double *row = &Q(b.at_pair(i) + p, 0);
                for (int a = 0; a < 3; ++a) {
                    double v = 0.0;
                    for (int64_t m = b.ptr[j]; m < b.ptr[j + 1]; ++m)
                        for (int q = 0; q < 6; ++q) v += Y(m, a, q) * row[b.pose_at[m] + q];
                    for (int64_t m = b.pc_ptr[j]; m < b.pc_ptr[j + 1]; ++m)
                        for (int64_t q = 0; q < b.n_of_pair(m); ++q) v += YL(m, a, q) * row[b.at_pair(m) + q];
                    BL(i, a, p) = v;
                }
                for (int a = 0; a < 3; ++a)
                    for (int c = 0; c < 3; ++c) C(j, a, c) += BL(i, a, p) * YL(i, c, p);
            }
        for (int64_t m = b.ptr[j]; m < b.ptr[j + 1]; ++m)
            for (int a = 0; a < 3; ++a)
                for (int c = 0; c < 3; ++c) {
                    double v = 0.0;
                    for (int q = 0; q < 6; ++q) v += B(m, a, q) * Y(m, c, q);
                    C(j, a, c) += v;
                }
    }
}

// out (3): u'Qu, u'Qv, v'Qv of two rows u, v of n numbers, Q: n rows of ld numbers.
inline void quadratic_forms(const double *u, const double *v, const double *Q, int n, int ld, double *out) {
    double t[2][MAX_LENS + 9] = {};
    for (int p = 0; p < n; ++p)
        for (int q = 0; q < n; ++q) {
            t[0][q] += u[p] * Q[ld * p + q];
            t[1][q] += v[p] * Q[ld * p + q];
        }
    out[0] = out[1] = out[2] = 0.0;
    for (int q = 0; q < n; ++q) out[0] += t[0][q] * u[q], out[1] += t[0][q] * v[q], out[2] += t[1][q] * v[q];
}

// Whitened A Q A' (K, 3) of observations of reduced points; A: rows whitened as if all were used.
inline void reduced_influence(Ints run, const Bundle &b, In<double, 3> A, In<double, 2> Q, In<double, 3> B, In<double, 3> BL, In<double, 3> C,
                              Out<double, 2> influence) {
    constexpr int N = MAX_LENS + 9;
    double joint[N][N], r[2][N];
    for (int64_t index = 0; index < run.n[0]; ++index) {
        const int64_t block = run[index];
        if (b.by_ptr[block] == b.by_ptr[block + 1]) continue;
        const int64_t camera = b.camera_of[b.by_block[b.by_ptr[block]]], at = b.lens_at[camera], o = b.first_pose + 6 * block;
        const int nl = int(b.n_lens[camera]), n = nl + 6;
        const auto place = [&](int p) { return p < nl ? at + p : o + p - nl; };
        for (int p = 0; p < n; ++p)
            for (int q = 0; q < n; ++q) joint[p][q] = Q(place(p), place(q));
        for (int64_t i = b.by_ptr[block]; i < b.by_ptr[block + 1]; ++i) {
            const int64_t k = b.by_block[i], j = b.point_of[k], c = b.pc_of[k];
            for (int a = 0; a < 3; ++a) {
                for (int q = 0; q < nl; ++q) joint[n + a][q] = joint[q][n + a] = BL(c, a, q);
                for (int q = 0; q < 6; ++q) joint[n + a][nl + q] = joint[nl + q][n + a] = B(k, a, q);
                for (int q = 0; q < 3; ++q) joint[n + a][n + q] = C(j, a, q);
            }
            for (int s = 0; s < 2; ++s) {
                const double *a = &A(k, s, 0);
                std::memcpy(r[s], a, sizeof(double) * nl);
                std::memcpy(r[s] + nl, a + AT_POSE, sizeof(double) * 6);
                std::memcpy(r[s] + n, a + AT_POINT, sizeof(double) * 3);
            }
            quadratic_forms(r[0], r[1], joint[0], n + 3, N, &influence(k, 0));
        }
    }
}

// Whitened A Q A' of observations first .. last, whose point stays or is held.
inline void direct_influence(int64_t first, int64_t last, const Bundle &b, In<double, 3> A, In<double, 2> Q, Out<double, 2> influence) {
    constexpr int N = MAX_LENS + 9;
    double joint[N][N];
    for (int64_t k = first; k < last; ++k) {
        const DirectRow row(b, k, A);
        for (int p = 0; p < row.n; ++p)
            for (int q = 0; q < row.n; ++q) joint[p][q] = Q(row.index[p], row.index[q]);
        quadratic_forms(row.a[0], row.a[1], joint[0], row.n, N, &influence(k, 0));
    }
}

}  // namespace
