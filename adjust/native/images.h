// Image points of known targets: residuals, condensed normal equations and redundancy, block after block.
//
// A block is what one camera saw of one target at one epoch. Its local unknowns are the free lens parameters of the
// camera, the six of camera_from_target (tangent on the right) and, where the target has them, those of its warp.
#pragma once
#include "lenses.h"
#include "trees.h"

namespace {

constexpr int CHUNK = 64;      // points evaluated together: their rows stay in the first two caches
constexpr int N_WARP = 7;      // components of a warp: bent along x, along y, twisted; scale x, scale y, shear; expansion
constexpr int MAX_LOCAL = 28;  // local unknowns and residual of a block: 14 + 6 + 7 + 1
constexpr int MAX_MAP = 24;    // parameters of a lens times free ones that they follow from
constexpr int N_SHAPE = 4;     // parameters of a target's shape
constexpr int MAX_KEY = 64;    // components of a key that a pose follows from: a table's geometry
enum Kind : int64_t { LENS, POSE, TABLE, WARP };

struct Lenses {
    explicit Lenses(Reader &r) : kind(r), values(r), constants(r), n_free(r), n_map(r), source(r), column(r), factor(r) {}
    Ints kind;
    In<double, 2> values, constants;
    Ints n_free, n_map;
    In<int64_t, 2> source, column;
    In<double, 2> factor;
};
struct Blocks {
    explicit Blocks(Reader &r) : ptr(r), camera(r), warp_id(r), n_warp(r), warming(r) {}
    Ints ptr, camera, warp_id, n_warp;
    In<double, 1> warming;  // K above the temperature at which the target's points are known
};
struct Points {
    explicit Points(Reader &r) : X(r), uv(r) {}
    In<double, 2> X, uv;
};
struct Segments {
    explicit Segments(Reader &r)
        : ptr(r), kind(r), link(r), table(r), start(r), n(r), place(r), within(r), dim(r), factor(r) {}
    Ints ptr, kind, link, table, start, n, place, within, dim;  // within: the first of its key's dim columns that it has
    In<double, 1> factor;  // of a lens or a warp: what the local unknown moves by one of its key
};
// Where the blocks stand: camera_from_target of each, and the warps: values, the extent of the target (least x and y, and
// their span), and which components the free ones are.
struct Poses {
    explicit Poses(Reader &r) : R(r), t(r), warp(r), extent(r), of_warp(r) {}
    In<double, 3> R;
    In<double, 2> t, warp, extent;
    In<int64_t, 2> of_warp;
};
struct Batch {
    explicit Batch(Reader &r) : blocks(r), points(r), W(r), lenses(r), poses(r) {}
    Blocks blocks;
    Points points;
    In<double, 2> W;  // square root of the information, upper triangular (3, N); zero: not used
    Lenses lenses;
    Poses poses;

    int64_t n_local(int64_t b) const { return lenses.n_free[blocks.camera[b]] + 6 + blocks.n_warp[b]; }
};

struct Room {
    alignas(64) double A[MAX_LOCAL + N_SHAPE][2 * CHUNK];  // whitened rows as columns: all of u, then all of v
    alignas(64) double in[8][CHUNK];
};

// The warp of a block's target: see adjust.model.boards.
struct Warp {
    const double *w = nullptr, *extent = nullptr;
    const int64_t *of_free = nullptr;
    double warming = 0.0;

    Warp(const Batch &B, int64_t b) {
        const int64_t id = B.blocks.warp_id[b];
        if (id < 0) return;
        w = &B.poses.warp(id, 0), extent = &B.poses.extent(id, 0), of_free = &B.poses.of_warp(id, 0), warming = B.blocks.warming[b];
    }
    // Bends of one unit along x and y, and the twist.
    [[gnu::always_inline]] void bends(V x, V y, V *out) const {
        const V u = (x - extent[0]) / extent[2], v = (y - extent[1]) / extent[3];
        out[0] = 4.0 * u * (1.0 - u), out[1] = 4.0 * v * (1.0 - v), out[2] = (2.0 * u - 1.0) * (2.0 * v - 1.0);
    }
    [[gnu::always_inline]] void apply(V *x) const {
        V bent[3];
        bends(x[0], x[1], bent);
        const double grown = w[6] * warming;
        const V by_x = (w[3] + grown) * x[0] + w[5] * x[1], by_y = (w[4] + grown) * x[1];
        x[2] += w[0] * bent[0] + w[1] * bent[1] + w[2] * bent[2] + grown * x[2];
        x[0] += by_x, x[1] += by_y;
    }
    // Derivatives by all components, from h (by the point in the target) and the point as it is known.
    [[gnu::always_inline]] void columns(const V *h, const V *x, V *out) const {
        bends(x[0], x[1], out);
        for (int i = 0; i < 3; ++i) out[i] = h[2] * out[i];
        out[3] = h[0] * x[0], out[4] = h[1] * x[1], out[5] = h[0] * x[1];
        out[6] = warming * (out[3] + out[4] + h[2] * x[2]);
    }
};
// What W points at p of the arrays in (of a row length) have: x in the target bent by its warp, in the camera, weights.
struct Sight {
    V x[3], q[3], w00, w01, w11;
};
struct Chunk {
    const double *in[8];  // x y z u v w00 w01 w11
    int m, full;

    // Points lo .. lo + m - 1, padded to whole vectors by more of the last one, with weight zero.
    Chunk(const Batch &B, int64_t lo, int size, Room &room) : m(size), full((size + W - 1) / W * W) {
        const int64_t n = B.points.X.n[1];
        const double *X = B.points.X.data + lo, *uv = B.points.uv.data + lo, *w = B.W.data + lo;
        const double *from[8] = {X, X + n, X + 2 * n, uv, uv + n, w, w + n, w + 2 * n};
        for (int i = 0; i < 8; ++i) {
            in[i] = from[i];
            if (m == full) continue;
            std::memcpy(room.in[i], from[i], sizeof(double) * m);
            for (int p = m; p < full; ++p) room.in[i][p] = i >= 5 ? 0.0 : room.in[i][m - 1];
            in[i] = room.in[i];
        }
    }
    [[gnu::always_inline]] Sight at(int p, const double *R, const double *t, const Warp &warp) const {
        Sight s;
        for (int i = 0; i < 3; ++i) s.x[i] = load(in[i] + p);
        if (warp.w) warp.apply(s.x);
#pragma GCC unroll 3
        for (int i = 0; i < 3; ++i) s.q[i] = R[3 * i] * s.x[0] + R[3 * i + 1] * s.x[1] + R[3 * i + 2] * s.x[2] + t[i];
        s.w00 = load(in[5] + p), s.w01 = load(in[6] + p), s.w11 = load(in[7] + p);
        return s;
    }
};
inline double least_of(V v) {
    double d = v[0];
    for (int i = 1; i < W; ++i) d = smaller(d, v[i]);
    return d;
}
// f(lo, size) of the parts of block b, about equally large and whole vectors but for the last.
template <class F> inline void each_chunk(const Batch &B, int64_t b, F &&f) {
    const int64_t begin = B.blocks.ptr[b], end = B.blocks.ptr[b + 1], size = end - begin, chunks = (size + CHUNK - 1) / CHUNK;
    const int64_t step = chunks ? ((size + chunks - 1) / chunks + W - 1) / W * W : 1;
    for (int64_t lo = begin; lo < end; lo += step) f(lo, int(smaller(step, end - lo)));
}

// Whitened rows of a chunk into room.A, the columns of v ``full`` behind those of u: n_free + 6 + n_warp unknowns, then
// the residual. least: the least depth of points with weight.
template <class Lens> inline void columns_by(const Batch &B, int64_t b, const Chunk &chunk, V &least, Room &room) {
    const int64_t c = B.blocks.camera[b];
    const int nl = int(B.lenses.n_free[c]), nw = int(B.blocks.n_warp[b]), n_map = int(B.lenses.n_map[c]);
    const double *l = &B.lenses.values(c, 0), *k = &B.lenses.constants(c, 0), *factor = &B.lenses.factor(c, 0);
    const int64_t *source = &B.lenses.source(c, 0), *column = &B.lenses.column(c, 0);
    const double *R = &B.poses.R(b, 0, 0), *t = &B.poses.t(b, 0);
    const Warp warp(B, b);
    bool seen[MAX_LENS] = {}, again[MAX_MAP];  // does a parameter share the column of one before it
    for (int i = 0; i < n_map; ++i) again[i] = std::exchange(seen[column[i]], true);
    const int full = chunk.full;
    for (int p = 0; p < full; p += W) {
        const Sight s = chunk.at(p, R, t, warp);
        least = ((s.w00 != 0.0) & (s.q[2] < least)) ? s.q[2] : least;
        V r[2], d[2][N_COLUMNS];
        lens_row<Lens>(l, k, s.q, load(chunk.in[3] + p), load(chunk.in[4] + p), r, d);
        double *out = &room.A[0][0] + p;
        for (int i = 0; i < n_map; ++i) {
            double *o = out + 2 * CHUNK * column[i];
            const double f = factor[i];
            const V du = d[0][source[i]], dv = d[1][source[i]];
            V x = f * (s.w00 * du + s.w01 * dv), y = f * (s.w11 * dv);
            if (again[i]) x += load(o), y += load(o + full);
            store(o, x), store(o + full, y);
        }
        out += 2 * CHUNK * nl;
#pragma GCC unroll 2
        for (int row = 0; row < 2; ++row, out += full) {
            V g[3], h[3];
#pragma GCC unroll 3
            for (int i = 0; i < 3; ++i) {
                const V dv = d[1][MAX_LENS + i];
                g[i] = row == 0 ? s.w00 * d[0][MAX_LENS + i] + s.w01 * dv : s.w11 * dv;
            }
#pragma GCC unroll 3
            for (int i = 0; i < 3; ++i) h[i] = g[0] * R[i] + g[1] * R[3 + i] + g[2] * R[6 + i];
            const V o[6] = {s.x[1] * h[2] - s.x[2] * h[1], s.x[2] * h[0] - s.x[0] * h[2], s.x[0] * h[1] - s.x[1] * h[0], h[0], h[1], h[2]};
#pragma GCC unroll 6
            for (int i = 0; i < 6; ++i) store(out + 2 * CHUNK * i, o[i]);
            if (nw) {
                const V known[3] = {load(chunk.in[0] + p), load(chunk.in[1] + p), load(chunk.in[2] + p)};
                V by_warp[N_WARP];
                warp.columns(h, known, by_warp);
                for (int i = 0; i < nw; ++i) store(out + 2 * CHUNK * (6 + i), by_warp[warp.of_free[i]]);
            }
            store(out + 2 * CHUNK * (6 + nw), row == 0 ? s.w00 * r[0] + s.w01 * r[1] : s.w11 * r[1]);
        }
    }
}
inline void local_columns(const Batch &B, int64_t b, const Chunk &chunk, V &least, Room &room) {
    with_lens(B.lenses.kind[B.blocks.camera[b]], [&]<class Lens>(Lens) { columns_by<Lens>(B, b, chunk, least, room); });
}
inline void clear_unused(const Batch &B, int64_t b, Room &room) {
    const int64_t c = B.blocks.camera[b];
    for (int j = 0; j < B.lenses.n_free[c]; ++j) std::memset(room.A[j], 0, sizeof room.A[j]);
}

// Square root information w00, w01, w11 of image points with covariances: upper triangular W with W'W = inv(cov).
inline void square_roots(int64_t first, int64_t last, In<double, 3> cov, Out<double, 2> W) {
    for (int64_t i = first; i < last; ++i) {
        const double b = cov(i, 0, 1), c = cov(i, 1, 1), w00 = 1.0 / root(cov(i, 0, 0) - b * b / c);
        W(i, 0) = w00, W(i, 1) = -w00 * b / c, W(i, 2) = 1.0 / root(c);
    }
}

// The points of the listed blocks as columns: X of what they show, which is point ``shown`` of n_points[b] from x[start[b]]
// on, uv, W. How many blocks show what is not there.
inline int64_t point_columns(Ints which, Ints ptr, Ints start, Ints n_points, In<double, 2> x, Ints shown, In<double, 2> uv, In<double, 2> W,
                             Out<double, 2> X_out, Out<double, 2> uv_out, Out<double, 2> W_out) {
    int64_t wrong = 0;
    for (int64_t k = 0; k < which.n[0]; ++k) {
        const int64_t b = which[k];
        for (int64_t i = ptr[b]; i < ptr[b + 1]; ++i) {
            if (shown[i] < 0 || shown[i] >= n_points[b]) {
                ++wrong;
                break;
            }
            for (int j = 0; j < 3; ++j) X_out(j, i) = x(start[b] + shown[i], j), W_out(j, i) = W(i, j);
            for (int j = 0; j < 2; ++j) uv_out(j, i) = uv(i, j);
        }
    }
    return wrong;
}

// For each listed block: normal matrix H[b] (symmetric) of its local unknowns and, last, the residual, whose diagonal
// element is chi-square, also in chi; depth: the least one.
inline void normal_equations(Ints which, const Batch &B, Out<double, 3> H, Out<double, 1> chi, Out<double, 1> depth) {
    Room room;
    for (int64_t i = 0; i < which.n[0]; ++i) {
        const int64_t b = which[i];
        const int n = int(B.n_local(b)) + 1;
        V least = all<V>(__builtin_inf());
        double N[MAX_LOCAL][MAX_LOCAL] = {};
        clear_unused(B, b, room);
        each_chunk(B, b, [&](int64_t lo, int size) {
            const Chunk chunk(B, lo, size, room);
            local_columns(B, b, chunk, least, room);
            add_gram(room.A, n, 2 * chunk.full, N);
        });
        for (int j = 0; j < n; ++j)
            for (int k = j; k < n; ++k) H(b, j, k) = H(b, k, j) = N[j][k];
        chi.data[b] = H(b, n - 1, n - 1);
        depth.data[b] = least_of(least);
    }
}

// Chi-square (whitened) and least depth of each listed block.
inline void errors(Ints which, const Batch &B, Out<double, 1> chi, Out<double, 1> depth) {
    Room room;
    for (int64_t i = 0; i < which.n[0]; ++i) {
        const int64_t b = which[i], c = B.blocks.camera[b];
        V total = V{}, least = all<V>(__builtin_inf());
        with_lens(B.lenses.kind[c], [&]<class Lens>(Lens) {
            const auto p = parameters<Lens>(&B.lenses.values(c, 0));
            const Warp warp(B, b);
            each_chunk(B, b, [&](int64_t lo, int size) {
                const Chunk chunk(B, lo, size, room);
                for (int j = 0; j < chunk.full; j += W) {
                    const Sight s = chunk.at(j, &B.poses.R(b, 0, 0), &B.poses.t(b, 0), warp);
                    const auto [ru, rv] = lens_residual<Lens>(p, &B.lenses.constants(c, 0), s.q, load(chunk.in[3] + j), load(chunk.in[4] + j));
                    const V x = s.w00 * ru + s.w01 * rv, y = s.w11 * rv, e = x * x + y * y;
                    total += (s.w00 != 0.0) ? e : V{};
                    least = ((s.w00 != 0.0) & (s.q[2] < least)) ? s.q[2] : least;
                }
            });
        });
        chi.data[b] = sum(total);
        depth.data[b] = least_of(least);
    }
}

// put(row, column, number) of the whitened rows (2 n, n_local + 1) of block b over its local unknowns, residual last.
template <class F> inline void rows_of_block(int64_t b, const Batch &B, Room &room, F &&put) {
    const int n = int(B.n_local(b)) + 1;
    V least = all<V>(__builtin_inf());
    clear_unused(B, b, room);
    each_chunk(B, b, [&](int64_t lo, int size) {
        const Chunk chunk(B, lo, size, room);
        local_columns(B, b, chunk, least, room);
        for (int p = 0; p < size; ++p)
            for (int s = 0; s < 2; ++s)
                for (int j = 0; j < n; ++j) put(2 * (lo - B.blocks.ptr[b] + p) + s, j, room.A[j][s * chunk.full + p]);
    });
}

// These rows of listed blocks, which have equally many points and columns: out (g, 2 n, n_local + 1).
inline void block_rows(Ints which, const Batch &B, Out<double, 3> out) {
    Room room;
    for (int64_t i = 0; i < which.n[0]; ++i) rows_of_block(which[i], B, room, [&](int64_t row, int j, double v) { out(i, row, j) = v; });
}

// Upper triangular R with R'R = H, positive semidefinite (n, n), in place; a vanishing pivot leaves a zero row. H is
// scaled to a unit diagonal first, so a pivot below 1e-14 is rounding.
template <int WIDTH> inline void half_cholesky(double (*H)[WIDTH], int n) {
    double d[WIDTH];
    for (int i = 0; i < n; ++i) d[i] = H[i][i] > 0.0 ? root(H[i][i]) : 0.0;
    for (int i = 0; i < n; ++i)
        for (int j = i; j < n; ++j) H[i][j] = d[i] > 0.0 && d[j] > 0.0 ? H[i][j] / (d[i] * d[j]) : 0.0;
    for (int i = 0; i < n; ++i) {
        const double p = H[i][i];
        if (p <= 1e-14) {
            for (int j = i; j < n; ++j) H[i][j] = 0.0;
            continue;
        }
        const double f = 1.0 / root(p);
        for (int j = i; j < n; ++j) H[i][j] *= f;
        for (int k = i + 1; k < n; ++k) {
            const double a = H[i][k];
            for (int j = k; j < n; ++j) H[k][j] -= a * H[i][j];
        }
    }
    for (int i = 0; i < n; ++i) {
        for (int j = 0; j < i; ++j) H[i][j] = 0.0;
        for (int j = i; j < n; ++j) H[i][j] *= d[j];
    }
}

// Derivative E (6, n of segment s) of a block's pose by its unknown: a pose, or a part of a table.
inline void pose_by_key(int64_t s, const Segments &S, In<double, 3> C, In<double, 3> D, double (*E)[MAX_KEY]) {
    const double *c = &C(S.link[s], 0, 0);
    const int n = int(S.n[s]);
    if (S.kind[s] == POSE) {
        for (int i = 0; i < 6; ++i)
            for (int j = 0; j < 6; ++j) E[i][j] = c[6 * i + j];
        return;
    }
    const auto d = D[S.table[s]];
    const int64_t start = S.start[s];
    for (int i = 0; i < 6; ++i)
        for (int j = 0; j < n; ++j) {
            double v = 0.0;
            for (int a = 0; a < 6; ++a) v += c[6 * i + a] * d(a, start + j);
            E[i][j] = v;
        }
}
// f(segment, local unknown at which it begins) for lens and warp, else g(segment).
template <class F, class G> inline void each_segment(const Segments &S, int64_t b, int64_t nl, F &&plain, G &&chained) {
    for (int64_t s = S.ptr[b]; s < S.ptr[b + 1]; ++s) {
        if (S.kind[s] == LENS) plain(s, int64_t(S.start[s]));
        else if (S.kind[s] == WARP) plain(s, nl + 6 + S.start[s]);
        else chained(s);
    }
}

// Where rows of blocks go: of block b `height` ones from the `first` on among `rows` of a factor, whose keys come one after the
// other from flat[at], each (rows, its dim), and whose residuals begin at r[r_at].
struct RowPlaces {
    explicit RowPlaces(Reader &r) : height(r), first(r), rows(r), at(r), r_at(r) {}
    Ints height, first, rows, at, r_at;
};

// For each listed block: its rows, condensed where that makes them fewer, chained to its keys, and their residuals.
inline void serve(Ints which, const Batch &B, const Segments &S, In<double, 3> C, In<double, 3> D, const RowPlaces &places, In<double, 3> H,
                  Out<double, 1> flat, Out<double, 1> r) {
    Room room;
    double T[MAX_LOCAL][MAX_LOCAL], E[6][MAX_KEY];
    for (int64_t index = 0; index < which.n[0]; ++index) {
        const int64_t b = which[index], nl = B.lenses.n_free[B.blocks.camera[b]], first_row = places.first[b];
        const int n = int(B.n_local(b)) + 1, height = int(places.height[b]);
        for (int j = 0; j < height; ++j)
            for (int c = 0; c < n; ++c) T[j][c] = height < n ? 0.0 : H(b, j, c);
        if (height < n) rows_of_block(b, B, room, [&](int64_t row, int j, double v) { T[row][j] = v; });
        else half_cholesky(T, n);
        for (int j = 0; j < height; ++j) r(places.r_at[b] + first_row + j) = T[j][n - 1];
        const auto key = [&](int64_t s) {
            return flat.data + places.at[b] + places.rows[b] * (S.place[s] - S.within[s]) + first_row * S.dim[s] + S.within[s];
        };
        for (int64_t s = S.ptr[b]; s < S.ptr[b + 1]; ++s) std::memset(key(s) - S.within[s], 0, sizeof(double) * height * S.dim[s]);
        each_segment(S, b, nl,
            [&](int64_t s, int64_t first) {
                double *o = key(s);
                const int64_t k = S.n[s], dim = S.dim[s];
                for (int j = 0; j < height; ++j)
                    for (int64_t c = 0; c < k; ++c) o[j * dim + c] += S.factor[s] * T[j][first + c];
            },
            [&](int64_t s) {
                double *o = key(s);
                const int64_t k = S.n[s];
                pose_by_key(s, S, C, D, E);
                for (int j = 0; j < height; ++j)
                    for (int a = 0; a < 6; ++a)
                        for (int64_t c = 0; c < k; ++c) o[j * k + c] += T[j][nl + a] * E[a][c];
            });
    }
}

// Derivative G (n_local, sum of key dims) of a block's local unknowns by its keys.
inline void block_by_keys(int64_t b, int64_t nl, const Segments &S, In<double, 3> C, In<double, 3> D, Out<double, 2> G) {
    double E[6][MAX_KEY];
    std::memset(G.data, 0, sizeof(double) * G.n[0] * G.n[1]);
    each_segment(S, b, nl,
        [&](int64_t s, int64_t first) {
            for (int64_t j = 0; j < S.n[s]; ++j) G(first + j, S.place[s] + j) += S.factor[s];
        },
        [&](int64_t s) {
            pose_by_key(s, S, C, D, E);
            for (int i = 0; i < 6; ++i)
                for (int64_t j = 0; j < S.n[s]; ++j) G(nl + i, S.place[s] + j) += E[i][j];
        });
}

// The same of listed blocks, which have equally many columns on either side: G (g, n_local, sum of key dims).
inline void local_by_keys(Ints which, Ints n_lens, const Segments &S, In<double, 3> C, In<double, 3> D, Out<double, 3> G) {
    for (int64_t i = 0; i < which.n[0]; ++i) block_by_keys(which[i], n_lens[i], S, C, D, G[i]);
}

// Keys of blocks as a tree numbers them: block b has key[ptr[b]] .., whose columns begin at place; -1: known exactly.
struct Keys {
    explicit Keys(Reader &r) : ptr(r), key(r), place(r) {}
    Ints ptr, key, place;
};

// Joint covariance (w, w) of a block's keys; whether each two of them share a clique.
inline bool joint_of_keys(int64_t b, const Keys &keys, const Tree &tree, double *Q, int64_t w) {
    bool together = true;
    std::memset(Q, 0, sizeof(double) * w * w);
    for (int64_t x = keys.ptr[b]; x < keys.ptr[b + 1]; ++x)
        for (int64_t y = keys.ptr[b]; y <= x; ++y) {
            if (keys.key[x] < 0 || keys.key[y] < 0) continue;
            double *o = Q + keys.place[x] * w + keys.place[y];
            together &= tree.block(keys.key[x], keys.key[y], o, w);
            for (int64_t i = 0; i < tree.dims[keys.key[x]]; ++i)
                for (int64_t j = 0; j < tree.dims[keys.key[y]]; ++j) Q[(keys.place[y] + j) * w + keys.place[x] + i] = o[i * w + j];
        }
    return together;
}
// out (n, n) = G Q G', for a G (n, w) with many zeros; K: scratch (n, w).
inline void congruent(const double *G, const double *Q, int64_t n, int64_t w, double *K, double (*out)[MAX_LOCAL]) {
    std::memset(K, 0, sizeof(double) * n * w);
    for (int64_t i = 0; i < n; ++i)
        for (int64_t a = 0; a < w; ++a)
            if (const double g = G[i * w + a]; g != 0.0)
                for (int64_t c = 0; c < w; ++c) K[i * w + c] += g * Q[a * w + c];
    for (int64_t i = 0; i < n; ++i)
        for (int64_t j = 0; j < n; ++j) {
            double v = 0.0;
            for (int64_t a = 0; a < w; ++a) v += G[j * w + a] * K[i * w + a];
            out[i][j] = v;
        }
}

// Residuals (N, 2) px of the listed blocks and the whitened covariance A Q A' (N, 3: 00, 01, 11) of their adjusted
// points, from the covariances of a tree. lost[b] becomes 1 where two of its keys share no clique. W of the batch: that
// of all points, used or not. work: scratch, w (w + 56) numbers for the widest block's w columns.
inline void all_statistics(Ints which, const Batch &B, const Segments &S, In<double, 3> C, In<double, 3> D, Ints width, const Keys &keys,
                           const Tree &tree, Out<double, 2> residual, Out<double, 2> influence, Out<int64_t, 1> lost, Out<double, 1> work) {
    Room room;
    double Q[MAX_LOCAL][MAX_LOCAL];
    V least = V{};
    for (int64_t index = 0; index < which.n[0]; ++index) {
        const int64_t b = which[index], nl = B.lenses.n_free[B.blocks.camera[b]], w = width[b];
        const int n = int(B.n_local(b));
        double *joint = work.data, *G = joint + w * w, *K = G + n * w;
        if (!joint_of_keys(b, keys, tree, joint, w)) lost.data[b] = 1;
        block_by_keys(b, nl, S, C, D, Out<double, 2>(G, {n, w}));
        congruent(G, joint, n, w, K, Q);
        clear_unused(B, b, room);
        each_chunk(B, b, [&](int64_t lo, int size) __attribute__((noinline)) {  // a sixth faster than inlined
            const Chunk chunk(B, lo, size, room);
            local_columns(B, b, chunk, least, room);
            for (int p = 0; p < chunk.full; p += W) {
                V m[3] = {};
                for (int i = 0; i < n; ++i) {  // half of Q is enough: with its lower triangle, half the diagonal, a'Qa = 2 a'T
                    const V u = load(&room.A[i][p]), v = load(&room.A[i][chunk.full + p]);
                    V tu = 0.5 * Q[i][i] * u, tv = 0.5 * Q[i][i] * v;
                    for (int j = 0; j < i; ++j) {
                        tu += Q[i][j] * load(&room.A[j][p]);
                        tv += Q[i][j] * load(&room.A[j][chunk.full + p]);
                    }
                    m[0] += 2.0 * u * tu;
                    m[1] += u * tv + v * tu;
                    m[2] += 2.0 * v * tv;
                }
                const V rv = load(&room.A[n][chunk.full + p]) / load(chunk.in[7] + p);
                const V ru = (load(&room.A[n][p]) - load(chunk.in[6] + p) * rv) / load(chunk.in[5] + p);
                for (int i = 0; i < W && p + i < size; ++i) {
                    const int64_t at = lo + p + i;
                    residual(at, 0) = ru[i], residual(at, 1) = rv[i];
                    influence(at, 0) = m[0][i], influence(at, 1) = m[1][i], influence(at, 2) = m[2][i];
                }
            }
        });
    }
}

}  // namespace
