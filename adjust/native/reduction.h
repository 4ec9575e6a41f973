// Poses that only image points of known targets touch, reduced by Schur complements; see adjust.observations.images.reduction.
//
// A pose's columns are its own six, then those of the keys its blocks share with others, then the residual.
#pragma once
#include "dense.h"
#include "images.h"

namespace {

constexpr double WEAKEST_PIVOT = 0x1p-24;  // share of a diagonal that must be left, as GTSAM's Cholesky asks

struct Reduction {
    explicit Reduction(Reader &r) : block_ptr(r), block(r), col_ptr(r), col(r), place(r) {}
    Ints block_ptr, block, col_ptr, col, place;
};

// Room of a run of poses, rows of ``size`` numbers in whole vectors: their own normal matrices, what the unknowns of a
// block follow from, this the other way round, products; and where columns go.
struct Scratch {
    double *M, *G, *turned, *K, *N;
    int64_t *to, size;
};

// Add a block's normal matrix H (n, n), chained to the w columns of its keys, and its residual, to M.
inline void add_block(int64_t b, int n, int64_t nl, int64_t w, const Segments &S, Ints place, In<double, 3> C, In<double, 3> D, In<double, 2> H,
                      const Scratch &x) {
    const int64_t v = w + 1;
    block_by_keys(b, nl, S, C, D, Out<double, 2>(x.G, {n, x.size}));
    x.G[(n - 1) * x.size + w] = 1.0;
    for (int i = 0; i < n; ++i)
        for (int64_t j = 0; j < v; ++j) x.turned[j * n + i] = x.G[i * x.size + j];
    product(H.data, H.n[1], x.G, x.size, x.K, x.size, n, v, n);
    product(x.turned, n, x.K, x.size, x.N, x.size, v, v, n);
    for (int64_t s = S.ptr[b]; s < S.ptr[b + 1]; ++s)
        for (int64_t j = 0; j < S.n[s]; ++j) x.to[S.place[s] + j] = place[s] + j;
    const int64_t *to = x.to;
    for (int64_t i = 0; i < v; ++i) {
        double *row = x.M + to[i] * x.size;
        const double *added = x.N + i * x.size;
        for (int64_t j = 0; j < v; ++j) row[to[j]] += added[j];
    }
}

// First six rows of M (m, m) to [L' T] with L L' their own block; the rest loses T' T; upper triangles. False where the
// block has no inverse to speak of. turned: room.
inline bool eliminate_pose(double *M, int64_t ld, int64_t m, double *turned) {
    for (int i = 0; i < 6; ++i) {
        double *row = M + i * ld;
        double p = row[i];
        const double given = p;
        for (int k = 0; k < i; ++k) p -= M[k * ld + i] * M[k * ld + i];
        if (!(p > WEAKEST_PIVOT * given)) return false;
        const double pivot = root(p);
        row[i] = pivot;
        for (int k = 0; k < i; ++k) {
            const double a = M[k * ld + i];
            add_multiple(-a, M + k * ld + i + 1, row + i + 1, m - i - 1);
        }
        const double f = 1.0 / pivot;
        for (int64_t j = i + 1; j < m; ++j) row[j] *= f;
    }
    for (int64_t i = 6; i < m; ++i)
        for (int k = 0; k < 6; ++k) turned[6 * (i - 6) + k] = -M[k * ld + i];
    product(turned, 6, M, ld, M + 6 * ld, ld, m - 6, m, 6, true);
    return true;
}

// Reduce the poses in run[1:]: L (J, 6, 6) upper and T stay for what follows; the sums are those of turn = run[0]. rest
// (runs, n + 1, n + 1): upper triangle of the normal matrix of the interface and the residual, diagonal that before
// anything was reduced. damping: share of its own diagonal that is added to a pose's. bad[turn]: a pose without an
// inverse. work, to: scratch, v (2 v + 3 MAX_LOCAL) numbers and v places, v: columns of a pose or of a block + 1, at most,
// in whole vectors.
inline void reduce_poses(Ints run, const Reduction &a, const Blocks &blocks, const Lenses &lenses, const Segments &S, Ints width, In<double, 3> C,
                         In<double, 3> D, double damping, In<double, 3> H, Out<double, 3> L, Out<double, 1> T, Out<double, 2> diagonal,
                         Out<double, 3> rest, Out<int64_t, 1> bad, Out<double, 1> work, Out<int64_t, 1> to) {
    const int64_t turn = run[0], size = to.n[0], end = rest.n[1] - 1;
    double *G = work.data + size * size;
    const Scratch x{work.data, G, G + MAX_LOCAL * size, G + 2 * MAX_LOCAL * size, G + 3 * MAX_LOCAL * size, to.data, size};
    for (int64_t index = 1; index < run.n[0]; ++index) {
        const int64_t j = run[index], first = a.col_ptr[j], k = a.col_ptr[j + 1] - first, m = k + 7;
        std::memset(x.M, 0, sizeof(double) * m * size);
        for (int64_t i = a.block_ptr[j]; i < a.block_ptr[j + 1]; ++i) {
            const int64_t b = a.block[i], nl = lenses.n_free[blocks.camera[b]], w = width[b];
            x.to[w] = m - 1;
            add_block(b, int(nl + 7 + blocks.n_warp[b]), nl, w, S, a.place, C, D, H[b], x);
        }
        for (int i = 0; i < 6; ++i) x.M[i * size + i] *= 1.0 + damping;
        for (int64_t i = 0; i < k; ++i) diagonal(turn, a.col[first + i]) += x.M[(6 + i) * size + 6 + i];
        if (!eliminate_pose(x.M, size, m, x.turned)) {
            bad.data[turn] = j;
            return;
        }
        double *t = T.data + 6 * (first + j);
        for (int i = 0; i < 6; ++i) {
            for (int c = 0; c < 6; ++c) L(j, i, c) = c >= i ? x.M[i * size + c] : 0.0;
            for (int64_t c = 0; c <= k; ++c) t[i * (k + 1) + c] = x.M[i * size + 6 + c];
        }
        for (int64_t i = 0; i < k; ++i) {
            const double *row = x.M + (6 + i) * size;
            double *out = &rest(turn, a.col[first + i], 0);
            for (int64_t c = i; c < k; ++c) out[a.col[first + c]] += row[6 + c];
            out[end] += row[m - 1];
        }
        rest(turn, end, end) += x.M[(m - 1) * size + m - 1];
    }
}

// Steps (J, 6) of the reduced poses from that of the interface d (n,); decrease: by how much they alone lower chi-square.
inline void pose_steps(const Reduction &a, In<double, 3> L, Vector T, Vector d, Out<double, 2> out, Out<double, 1> decrease) {
    for (int64_t j = 0; j < out.n[0]; ++j) {
        const int64_t first = a.col_ptr[j], k = a.col_ptr[j + 1] - first;
        const double *t = T.data + 6 * (first + j);
        for (int i = 0; i < 6; ++i, t += k + 1) {
            double v = t[k];
            decrease.data[0] += v * v;
            for (int64_t c = 0; c < k; ++c) v += t[c] * d[a.col[first + c]];
            out(j, i) = -v;
        }
        for (int i = 5; i >= 0; --i) {
            for (int c = i + 1; c < 6; ++c) out(j, i) -= L(j, i, c) * out(j, c);
            out(j, i) /= L(j, i, i);
        }
    }
}

// Rows [L' T] of all poses, without the residual, one after the other.
inline void leaf_rows(const Reduction &a, In<double, 3> L, Vector T, Out<double, 1> out) {
    double *o = out.data;
    for (int64_t j = 0; j < L.n[0]; ++j) {
        const int64_t k = a.col_ptr[j + 1] - a.col_ptr[j];
        const double *t = T.data + 6 * (a.col_ptr[j] + j);
        for (int i = 0; i < 6; ++i, o += 6 + k) {
            std::memcpy(o, &L(j, i, 0), sizeof(double) * 6);
            std::memcpy(o + 6, t + i * (k + 1), sizeof(double) * k);
        }
    }
}

}  // namespace
