// Cholesky factors of the normal equations of poses (blocks of six), clique by clique; see adjust.native.elimination.
#pragma once
#include "dense.h"

namespace {

constexpr int64_t POSE = 6;
constexpr int64_t PANEL = 12, BLOCK = 48;  // rows whose products are subtracted at once: among themselves, and from all others
constexpr double LOST = 0x1p-24;  // share of its diagonal below which a pivot counts as zero, as GTSAM has it

// The elimination tree of a graph with its nodes in the order of elimination, and how many nodes below each its column has
// (Davis 2005, algorithm 849, LDL). mark: scratch.
inline void elimination_tree(Ints ptr, Ints neighbour, Out<int64_t, 1> parent, Out<int64_t, 1> count, Out<int64_t, 1> mark) {
    for (int64_t k = 0; k < parent.n[0]; ++k) {
        parent.data[k] = -1, mark.data[k] = k, count.data[k] = 0;
        for (int64_t p = ptr[k]; p < ptr[k + 1]; ++p)
            for (int64_t i = neighbour[p]; i < k && mark[i] != k; i = parent[i]) {
                if (parent[i] < 0) parent.data[i] = k;
                ++count.data[i], mark.data[i] = k;
            }
    }
}

// Cliques, parents first: a node joins that of its parent where this is the first one eliminated there so far, and the
// column gets few zeros. clique (N,) of each node, above (C,) its parent. count grows by the zeros. Returns C.
inline int64_t gather_cliques(Ints parent, Out<int64_t, 1> count, Out<int64_t, 1> clique, Out<int64_t, 1> above, Out<int64_t, 1> first) {
    int64_t n = 0;
    for (int64_t j = parent.n[0] - 1; j >= 0; --j) {
        const int64_t p = parent[j], c = p < 0 ? -1 : clique[p];
        if (c >= 0 && first[c] == p && 8 * (count[p] + 1 - count[j]) <= count[p] + 1) {
            clique.data[j] = c, count.data[j] = count[p] + 1;
        } else {
            clique.data[j] = n, above.data[n++] = c;
        }
        first.data[clique[j]] = j;
    }
    return n;
}

// Nodes of every clique: those eliminated there, then those above, each in the order of elimination. n_front: in, how many
// are eliminated there. child, next, mark: scratch.
inline void clique_nodes(Ints ptr, Ints neighbour, Ints clique, Ints above, Ints key_ptr, Ints n_front, Out<int64_t, 1> keys, Out<int64_t, 1> child,
                         Out<int64_t, 1> next, Out<int64_t, 1> mark) {
    const int64_t count = above.n[0], n = clique.n[0];
    for (int64_t c = 0; c < count; ++c) child.data[c] = -1, next.data[c] = key_ptr[c];
    for (int64_t j = 0; j < n; ++j) keys.data[next.data[clique[j]]++] = j, mark.data[j] = -1;
    for (int64_t c = count - 1; c >= 0; --c) {
        const int64_t begin = key_ptr[c], middle = begin + n_front[c];
        int64_t end = middle;
        const auto take = [&](int64_t k) {  // into its place among those above
            if (clique[k] == c || mark[k] == c) return;
            mark.data[k] = c;
            int64_t at = end++;
            for (; at > middle && keys[at - 1] > k; --at) keys.data[at] = keys[at - 1];
            keys.data[at] = k;
        };
        for (int64_t i = begin; i < middle; ++i)
            for (int64_t p = ptr[keys[i]]; p < ptr[keys[i] + 1]; ++p)
                if (neighbour[p] > keys[i]) take(neighbour[p]);
        for (int64_t b = child[c]; b >= 0; b = next[b])
            for (int64_t i = key_ptr[b] + n_front[b]; i < key_ptr[b + 1]; ++i) take(keys[i]);
        if (above[c] >= 0) next.data[c] = child[above[c]], child.data[above[c]] = c;
    }
}

// C -= P'P of P (m, .) and rows C from first to last, upper triangle and a little below; rows of ld numbers, whole tiles.
template <int R, int K> inline void gram_tile(const double *P, int64_t ld, int64_t m, int64_t k, int64_t j, double *C, int64_t ldc) {
    V c[R][K] = {};
    for (int64_t i = 0; i < m; ++i, P += ld) {
        V b[K];
#pragma GCC unroll 2
        for (int v = 0; v < K; ++v) b[v] = load(P + j + v * W);
#pragma GCC unroll 6
        for (int r = 0; r < R; ++r) {
            const V a = all<V>(P[k + r]);
#pragma GCC unroll 2
            for (int v = 0; v < K; ++v) c[r][v] += a * b[v];
        }
    }
    for (int r = 0; r < R; ++r)
        for (int v = 0; v < K; ++v) store(C + (k + r) * ldc + j + v * W, load(C + (k + r) * ldc + j + v * W) - c[r][v]);
}
inline void subtract_gram(const double *P, int64_t ld, int64_t m, int64_t first, int64_t last, int64_t n, double *C, int64_t ldc) {
    for (int64_t i = 0; i < m; i += BLOCK)
        for (int64_t k = first; k < last; k += POSE)
            for (int64_t j = k / (2 * W) * (2 * W); j < n; j += 2 * W) gram_tile<POSE, 2>(P + i * ld, ld, smaller(BLOCK, m - i), k, j, C, ldc);
}

// R with R'R = A and R^-T S of the rows [A S], n long, ld apart, by their upper triangle; the first row without pivot or -1.
inline int64_t factor_rows(double *A, int64_t rows, int64_t n, int64_t ld, const double *diagonal) {
    for (int64_t b = 0; b < rows; b += BLOCK) {
        const int64_t bound = smaller(b + BLOCK, rows);
        for (int64_t p = b; p < bound; p += PANEL) {
            const int64_t end = smaller(p + PANEL, bound);
            for (int64_t i = p; i < end; ++i) {
                double *row = A + i * ld;
                if (!(row[i] > LOST * diagonal[i])) return i;
                const double f = 1.0 / root(row[i]);
                for (int64_t j = i; j < n; ++j) row[j] *= f;
                for (int64_t k = i + 1; k < end; ++k) add_multiple(-row[k], row + k, A + k * ld + k, n - k);
            }
            subtract_gram(A + p * ld, ld, end - p, end, bound, n, A, ld);
        }
        subtract_gram(A + b * ld, ld, bound - b, bound, rows, n, A, ld);
    }
    return -1;
}

struct Cliques {
    explicit Cliques(Reader &r) : home(r), key_ptr(r), keys(r), n_front(r), at(r), data(r) {}
    Ints home, key_ptr, keys, n_front, at;
    Out<double, 1> data;

    int64_t width(int64_t c) const { return POSE * (key_ptr[c + 1] - key_ptr[c]); }
    int64_t place(int64_t c, int64_t key) const {  // what is eliminated in a clique is numbered one after the other
        if (home[key] == c) return POSE * (key - keys[key_ptr[c]]);
        int64_t i = key_ptr[c] + n_front[c];
        while (keys[i] != key) ++i;
        return POSE * (i - key_ptr[c]);
    }
    double *block(int64_t row, int64_t column) const {
        const int64_t c = home[row];
        return data.data + at[c] + place(c, row) * width(c) + place(c, column);
    }
};

// to += A'B, or g -= A' e, of six rows.
inline void add_product(const double *A, const double *B, double *to, int64_t ld) {
    for (int64_t i = 0; i < POSE; ++i) {
        double sum[POSE] = {};
        for (int64_t k = 0; k < POSE; ++k)
#pragma GCC unroll 6
            for (int64_t j = 0; j < POSE; ++j) sum[j] += A[k * POSE + i] * B[k * POSE + j];
        for (int64_t j = 0; j < POSE; ++j) to[i * ld + j] += sum[j];
    }
}
inline void add_gradient(const double *A, const double *e, double *g) {
    for (int64_t k = 0; k < POSE; ++k)
        for (int64_t i = 0; i < POSE; ++i) g[i] -= A[k * POSE + i] * e[k];
}

// The right hand side -A'e of pairs: first, second (E,) their nodes, -1 a constant; white, by_first, by_second: weighted.
inline void pair_gradient(Ints first, Ints second, In<double, 2> white, In<double, 3> by_first, In<double, 3> by_second, Out<double, 2> g) {
    for (int64_t e = 0; e < first.n[0]; ++e) {
        if (first[e] >= 0) add_gradient(&by_first(e, 0, 0), &white(e, 0), &g(first[e], 0));
        if (second[e] >= 0) add_gradient(&by_second(e, 0, 0), &white(e, 0), &g(second[e], 0));
    }
}

// Numbers of scratch that eliminate takes.
inline int64_t elimination_room(Ints key_ptr, Ints n_front) {
    int64_t most = 0;
    for (int64_t c = 0; c < n_front.n[0]; ++c) {
        const int64_t nf = POSE * n_front[c], n = POSE * (key_ptr[c + 1] - key_ptr[c]);
        most = larger(most, nf * padded_most(n) + (n - nf) * padded_most(n - nf) + WIDEST);
    }
    return most;
}

// [R S] of every clique from the normal matrix of the pairs (as in pair_gradient) and of what is known of single nodes (own),
// leaves first; what a clique leaves is subtracted in those above it. The first node without pivot, or -1. rank: of the nodes
// in the order of elimination. work, where, diagonal: scratch.
inline int64_t eliminate(const Cliques &t, Ints rank, Ints first, Ints second, In<double, 3> by_first, In<double, 3> by_second, In<double, 3> own,
                         Out<double, 1> work, Out<int64_t, 1> where, Out<double, 1> diagonal) {
    std::memset(t.data.data, 0, sizeof(double) * t.data.n[0]);
    for (int64_t k = 0; k < t.home.n[0]; ++k) {
        double *to = t.block(k, k);
        const int64_t n = t.width(t.home[k]);
        for (int64_t i = 0; i < POSE; ++i)
            for (int64_t j = 0; j < POSE; ++j) to[i * n + j] = own(k, i, j);
    }
    for (int64_t e = 0; e < first.n[0]; ++e) {
        const int64_t a = first[e], b = second[e];
        const double *A = &by_first(e, 0, 0), *B = &by_second(e, 0, 0);
        if (a >= 0) add_product(A, A, t.block(a, a), t.width(t.home[a]));
        if (b >= 0) add_product(B, B, t.block(b, b), t.width(t.home[b]));
        if (a < 0 || b < 0) continue;
        if (rank[a] < rank[b]) add_product(A, B, t.block(a, b), t.width(t.home[a]));
        else add_product(B, A, t.block(b, a), t.width(t.home[b]));
    }
    for (int64_t k = 0; k < t.home.n[0]; ++k)
        for (int64_t i = 0; i < POSE; ++i) diagonal.data[POSE * k + i] = t.block(k, k)[i * (t.width(t.home[k]) + 1)];
    for (int64_t c = t.at.n[0] - 1; c >= 0; --c) {
        const int64_t nf = POSE * t.n_front[c], n = t.width(c), ns = n - nf, ld = padded(n), ldu = padded(ns), begin = t.key_ptr[c];
        double *A = t.data.data + t.at[c], *F = work.data, *U = F + nf * ld + 2 * W;
        for (int64_t i = 0; i < nf; ++i) {
            std::memcpy(F + i * ld, A + i * n, sizeof(double) * n);
            std::memset(F + i * ld + n, 0, sizeof(double) * (ld - n));
        }
        const int64_t lost = factor_rows(F, nf, n, ld, diagonal.data + POSE * t.keys[begin]);
        if (lost >= 0) return t.keys[begin] + lost / POSE;
        for (int64_t i = 0; i < nf; ++i) {
            std::memset(A + i * n, 0, sizeof(double) * i);
            std::memcpy(A + i * n + i, F + i * ld + i, sizeof(double) * (n - i));
        }
        std::memset(U, 0, sizeof(double) * ns * ldu);
        subtract_gram(F + nf, ld, nf, 0, ns, ns, U, ldu);
        int64_t last = -1;
        for (int64_t i = begin + t.n_front[c], x = 0; i < t.key_ptr[c + 1]; ++i, x += POSE) {
            const int64_t h = t.home[t.keys[i]], wide = t.width(h);
            if (h != last)
                for (int64_t k = t.key_ptr[h]; k < t.key_ptr[h + 1]; ++k) where.data[t.keys[k]] = POSE * (k - t.key_ptr[h]);
            last = h;
            double *to = t.data.data + t.at[h] + where[t.keys[i]] * wide;
            for (int64_t j = i, some; j < t.key_ptr[c + 1]; j += some) {  // as many at once as stand side by side there
                const int64_t place = where[t.keys[j]], y = x + POSE * (j - i);
                for (some = 1; j + some < t.key_ptr[c + 1] && where[t.keys[j + some]] == place + POSE * some;) ++some;
                for (int64_t r = 0; r < POSE; ++r) add_multiple(1.0, U + (x + r) * ldu + y, to + r * wide + place, POSE * some);
            }
        }
    }
    return -1;
}

// x with R'R x = g in place (N, 6): leaves to roots, then back. room: as long as the widest clique.
inline void solve_poses(const Cliques &t, Out<double, 2> x, Out<double, 1> room) {
    double *y = room.data;
    const auto gather = [&](int64_t c) {
        for (int64_t i = t.key_ptr[c]; i < t.key_ptr[c + 1]; ++i) std::memcpy(y + POSE * (i - t.key_ptr[c]), &x(t.keys[i], 0), 8 * POSE);
    };
    const auto scatter = [&](int64_t c, int64_t end) {
        for (int64_t i = t.key_ptr[c]; i < end; ++i) std::memcpy(&x(t.keys[i], 0), y + POSE * (i - t.key_ptr[c]), 8 * POSE);
    };
    for (int64_t c = t.at.n[0] - 1; c >= 0; --c) {
        const int64_t nf = POSE * t.n_front[c], n = t.width(c);
        const double *A = t.data.data + t.at[c];
        gather(c);
        for (int64_t i = 0; i < nf; ++i, A += n) add_multiple(-(y[i] /= A[i]), A + i + 1, y + i + 1, n - i - 1);
        scatter(c, t.key_ptr[c + 1]);
    }
    for (int64_t c = 0; c < t.at.n[0]; ++c) {
        const int64_t nf = POSE * t.n_front[c], n = t.width(c);
        gather(c);
        for (int64_t i = nf - 1; i >= 0; --i) {
            const double *A = t.data.data + t.at[c] + i * n;
            y[i] = (y[i] - dot(A + i + 1, y + i + 1, n - i - 1)) / A[i];
        }
        scatter(c, t.key_ptr[c] + t.n_front[c]);
    }
}

}  // namespace
