// Poses that only image points of known targets touch, reduced by Schur complements; see adjust.observations.images.reduction.
//
// A pose's columns are its own six, then those of the keys its blocks share with others, then the residual.
#pragma once
#include "images.h"

namespace {

constexpr double WEAKEST_PIVOT = 0x1p-24;  // share of a diagonal that must be left, as GTSAM's Cholesky asks

struct Reduction {
    explicit Reduction(Reader &r) : block_ptr(r), block(r), col_ptr(r), col(r), place(r) {}
    Ints block_ptr, block, col_ptr, col, place;
};

// Room of a run of poses: upper triangles of their own normal matrices, derivatives, products, and where columns go.
struct Scratch {
    double *M, *G, *K, *N;
    int64_t *to, size;
};

// For the columns of a block's keys: where they stand among those of its pose, and the pose's derivative G (6, w).
inline void by_own_columns(int64_t b, int64_t w, const Segments &S, Ints place, In<double, 3> C, In<double, 3> D, const Scratch &x) {
    double E[6][MAX_KEY];
    std::memset(x.G, 0, sizeof(double) * 6 * w);
    for (int64_t s = S.ptr[b]; s < S.ptr[b + 1]; ++s) {
        const int64_t o = S.place[s];
        for (int64_t j = 0; j < S.n[s]; ++j) x.to[o + j] = place[s] + j;
        if (S.kind[s] == LENS || S.kind[s] == WARP) continue;
        pose_by_key(s, S, C, D, E);
        for (int i = 0; i < 6; ++i)
            for (int64_t j = 0; j < S.n[s]; ++j) x.G[i * w + o + j] += E[i][j];
    }
}

// Add a block's normal matrix H (n, n), chained to the w columns of its keys, and its residual, to M's upper triangle.
inline void add_block(int64_t b, int n, int64_t nl, int64_t w, const Segments &S, In<double, 2> H, const Scratch &x) {
    const int64_t v = w + 1;
    for (int i = 0; i < n; ++i) {
        double *K = x.K + i * v;
        for (int64_t j = 0; j < w; ++j) {
            double k = 0.0;
            for (int a = 0; a < 6; ++a) k += H(i, nl + a) * x.G[a * w + j];
            K[j] = k;
        }
        K[w] = H(i, n - 1);
    }
    std::memset(x.N, 0, sizeof(double) * v * v);
    const auto chained = [](int64_t) {};
    each_segment(S, b, nl, [&](int64_t s, int64_t at) {
        for (int64_t j = 0; j < S.n[s]; ++j)
            for (int i = 0; i < n; ++i) x.K[i * v + S.place[s] + j] += S.factor[s] * H(i, at + j);
    }, chained);
    each_segment(S, b, nl, [&](int64_t s, int64_t at) {
        for (int64_t i = 0; i < S.n[s]; ++i)
            for (int64_t j = 0; j < v; ++j) x.N[(S.place[s] + i) * v + j] += S.factor[s] * x.K[(at + i) * v + j];
    }, chained);
    for (int64_t i = 0; i < w; ++i)
        for (int a = 0; a < 6; ++a)
            if (const double g = x.G[a * w + i]; g != 0.0)
                for (int64_t j = 0; j < v; ++j) x.N[i * v + j] += g * x.K[(nl + a) * v + j];
    x.N[w * v + w] = H(n - 1, n - 1);
    for (int64_t i = 0; i < v; ++i)
        for (int64_t j = i; j < v; ++j) {
            const int64_t p = x.to[i], q = x.to[j];
            x.M[smaller(p, q) * x.size + larger(p, q)] += x.N[i * v + j];
        }
}

// First six rows of M (m, m) to [L' T] with L L' their own block; the rest loses T' T; upper triangles. False where the
// block has no inverse to speak of.
inline bool eliminate_pose(double *M, int64_t ld, int64_t m) {
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
            for (int64_t j = i + 1; j < m; ++j) row[j] -= a * M[k * ld + j];
        }
        for (int64_t j = i + 1; j < m; ++j) row[j] /= pivot;
    }
    for (int64_t i = 6; i < m; ++i)
        for (int k = 0; k < 6; ++k) {
            const double a = M[k * ld + i];
            if (a == 0.0) continue;
            for (int64_t j = i; j < m; ++j) M[i * ld + j] -= a * M[k * ld + j];
        }
    return true;
}

// Reduce the poses in run[1:]: L (J, 6, 6) upper and T stay for what follows; the sums are those of turn = run[0]. rest
// (runs, n + 1, n + 1): upper triangle of the normal matrix of the interface and the residual, diagonal that before
// anything was reduced. damping: share of its own diagonal that is added to a pose's. bad[turn]: a pose without an
// inverse. work, to: scratch, v (2 v + 29) numbers and v places, v: columns of a pose or of a block + 1, at most.
inline void reduce_poses(Ints run, const Reduction &a, const Blocks &blocks, const Lenses &lenses, const Segments &S, Ints width, In<double, 3> C,
                         In<double, 3> D, double damping, In<double, 3> H, Out<double, 3> L, Out<double, 1> T, Out<double, 2> diagonal,
                         Out<double, 3> rest, Out<int64_t, 1> bad, Out<double, 1> work, Out<int64_t, 1> to) {
    const int64_t turn = run[0], size = to.n[0], end = rest.n[1] - 1;
    Scratch x{work.data, work.data + size * size, nullptr, nullptr, to.data, size};
    x.K = x.G + 6 * size, x.N = x.K + MAX_LOCAL * size;
    for (int64_t index = 1; index < run.n[0]; ++index) {
        const int64_t j = run[index], first = a.col_ptr[j], k = a.col_ptr[j + 1] - first, m = k + 7;
        for (int64_t i = 0; i < m; ++i) std::memset(x.M + i * size, 0, sizeof(double) * m);
        for (int64_t i = a.block_ptr[j]; i < a.block_ptr[j + 1]; ++i) {
            const int64_t b = a.block[i], nl = lenses.n_free[blocks.camera[b]], w = width[b];
            x.to[w] = m - 1;
            by_own_columns(b, w, S, a.place, C, D, x);
            add_block(b, int(nl + 7 + blocks.n_warp[b]), nl, w, S, H[b], x);
        }
        for (int i = 0; i < 6; ++i) x.M[i * size + i] *= 1.0 + damping;
        for (int64_t i = 0; i < k; ++i) diagonal(turn, a.col[first + i]) += x.M[(6 + i) * size + 6 + i];
        if (!eliminate_pose(x.M, size, m)) {
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
