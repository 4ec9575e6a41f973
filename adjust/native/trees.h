// Recursions over the cliques of a Bayes tree, flattened; see adjust.precision.tree.
//
// Clique c has the keys keys[key_ptr[c]] .. keys[key_ptr[c + 1] - 1], the first n_front[c] of them frontal, parents
// before children. Blocks of front x width numbers, row by row, begin at at[c]: in data first [R S], later
// [R^-1, -R^-1 S]; in cov the rows of the covariance that belong to the frontal keys.
#pragma once
#include <algorithm>

#include "dense.h"

namespace {

struct Tree {
    explicit Tree(Reader &r) : home(r), key_ptr(r), keys(r), dims(r), front(r), width(r), at(r), cov(r) {}
    Ints home, key_ptr, keys, dims, front, width, at;
    Out<double, 1> cov;

    // Column at which a key begins in a clique, -1 where it is not in it.
    int64_t offset_in(int64_t clique, int64_t key) const {
        int64_t o = 0;
        for (int64_t i = key_ptr[clique]; i < key_ptr[clique + 1]; o += dims[keys[i++]])
            if (keys[i] == key) return o;
        return -1;
    }
    // Covariance of keys a and b, which share a clique, into out (row length ld); whether they do. The key whose home
    // lies deeper was eliminated first, so that its clique holds the other one.
    bool block(int64_t a, int64_t b, double *out, int64_t ld) const {
        const bool flip = home[b] > home[a];
        const int64_t deep = flip ? b : a, high = flip ? a : b, c = home[deep];
        const int64_t row = offset_in(c, deep), column = offset_in(c, high), n = width[c];
        if (column < 0) return false;
        const double *from = cov.data + at[c] + row * n + column;
        for (int64_t i = 0; i < dims[deep]; ++i)
            for (int64_t j = 0; j < dims[high]; ++j) out[flip ? j * ld + i : i * ld + j] = from[i * n + j];
        return true;
    }
};

inline int64_t tree_block(const Tree &tree, int64_t a, int64_t b, Out<double, 2> out) { return tree.block(a, b, out.data, out.n[1]); }

// Diagonal of A Q A' of the rows of every chunk c: row_ptr[c] .. of found, over its keys key_ptr[c] .. of key. J: from
// start[c] on the derivatives by one key after the other, each (rows, its dimension). lost: chunks of which two keys share
// no clique. room: for the largest block of Q.
inline void row_influences(Ints row_ptr, Ints key_ptr, Ints key, Ints start, Vector J, const Tree &tree, Out<double, 1> found, Out<bool, 1> lost,
                           Out<double, 1> room) {
    for (int64_t c = 0; c < start.n[0]; ++c) {
        const int64_t first = row_ptr[c], rows = row_ptr[c + 1] - first;
        const double *a = J.data + start[c];
        for (int64_t x = key_ptr[c]; x < key_ptr[c + 1]; ++x) {
            const int64_t n = tree.dims[key[x]];
            const double *b = J.data + start[c];
            for (int64_t y = key_ptr[c]; y <= x; ++y) {
                const int64_t m = tree.dims[key[y]];
                if (!tree.block(key[x], key[y], room.data, m)) lost.data[c] = true;
                else
                    for (int64_t r = 0; r < rows; ++r) {
                        double sum = 0.0;
                        for (int64_t i = 0; i < n; ++i)
                            for (int64_t j = 0; j < m; ++j) sum += a[r * n + i] * room.data[i * m + j] * b[r * m + j];
                        found.data[first + r] += x == y ? sum : 2.0 * sum;
                    }
                b += rows * m;
            }
            a += rows * n;
        }
    }
}

constexpr int64_t BAND = 24, COLUMNS = 128;  // rows, and columns, of an inverse that are found at once

// Numbers of scratch that invert_cliques takes.
inline int64_t inversion_room(Ints front, Ints width) {
    int64_t most = 0;
    for (int64_t c = 0; c < front.n[0]; ++c) most = larger(most, (front[c] + BAND) * padded_most(width[c]));
    return most;
}

// [R S] to [R^-1, -R^-1 S] in place, from the last rows up; the first singular clique or -1. work: scratch.
inline int64_t invert_cliques(Ints front, Ints width, Ints at, Out<double, 1> data, Out<double, 1> work) {
    for (int64_t c = 0; c < front.n[0]; ++c) {
        const int64_t nf = front[c], n = width[c], ld = padded(n);
        double *A = data.data + at[c], *found = work.data, *X = found + nf * ld;
        for (int64_t i = 0; i < nf; ++i)
            if (!(magnitude(A[i * n + i]) > 0.0)) return c;
        std::memset(found, 0, sizeof(double) * nf * ld);
        for (int64_t end = nf; end > 0; end -= smaller(BAND, end)) {
            const int64_t begin = larger(end - BAND, 0);
            for (int64_t j = end / (2 * W) * (2 * W); j < n; j += COLUMNS)  // below row j, column j of R^-1 is zero
                product(A + begin * n + end, n, found + end * ld + j, ld, X + j, ld, end - begin, smaller(COLUMNS, n - j), smaller(nf, j + COLUMNS) - end);
            for (int64_t i = end - 1; i >= begin; --i) {
                double *x = X + (i - begin) * ld, *row = found + i * ld;
                for (int64_t j = i; j < end; ++j) x[j] = 0.0;
                for (int64_t j = nf; j < n; ++j) x[j] += A[i * n + j];
                for (int64_t k = i + 1; k < end; ++k) add_multiple(A[i * n + k], found + k * ld + k, x + k, n - k);
                const double d = 1.0 / A[i * n + i];
                row[i] = d;
                for (int64_t j = i + 1; j < n; ++j) row[j] = -d * x[j];
            }
        }
        for (int64_t i = 0; i < nf; ++i) std::memcpy(A + i * n, found + i * ld, sizeof(double) * n);
    }
    return -1;
}

inline int64_t room_for_rows(int64_t nf, int64_t ns, int64_t pf, int64_t ps) {
    return 2 * nf * pf + ns * (ps + pf) + nf * ps;
}

// Numbers of scratch that covariance_rows takes.
inline int64_t covariance_room(Ints front, Ints width) {
    int64_t most = 0;
    for (int64_t c = 0; c < front.n[0]; ++c) {
        const int64_t nf = front[c], ns = width[c] - nf;
        most = larger(most, room_for_rows(nf, ns, padded_most(nf), padded_most(ns)));
    }
    return most;
}

// Q_ss (rows of ps numbers) of the keys of clique c that are not its own, from the cliques that are nearer to the root. where
// (K,): scratch.
inline void gather_covariance(const Tree &t, int64_t c, int64_t n_front, int64_t *where, double *Q, int64_t ps) {
    const int64_t begin = t.key_ptr[c] + n_front, end = t.key_ptr[c + 1];
    int64_t r = 0, last = -1;
    for (int64_t i = begin; i < end; r += t.dims[t.keys[i++]]) {
        const int64_t a = t.keys[i], h = t.home[a], n = t.width[h], rows = t.dims[a];
        int64_t o = 0, s = 0;
        for (int64_t k = t.key_ptr[h]; h != last && k < t.key_ptr[h + 1]; o += t.dims[t.keys[k++]]) where[t.keys[k]] = o;
        last = h;
        const double *from = t.cov.data + t.at[h] + where[a] * n;
        for (int64_t j = begin; j < end; s += t.dims[t.keys[j++]]) {
            const int64_t b = t.keys[j], columns = t.dims[b];
            if (t.home[b] > h) continue;
            for (int64_t x = 0; x < rows; ++x)
                for (int64_t y = 0; y < columns; ++y) Q[(r + x) * ps + s + y] = from[x * n + where[b] + y];
            if (t.home[b] == h) continue;
            for (int64_t y = 0; y < columns; ++y)
                for (int64_t x = 0; x < rows; ++x) Q[(s + y) * ps + r + x] = from[x * n + where[b] + y];
        }
    }
}

// Q_fs = T Q_ss and Q_ff = R^-1 R^-T + T Q_sf, with T = -R^-1 S, parents first (Takahashi, Fagan and Chen 1973).
inline void covariance_rows(const Tree &t, Ints n_front, Vector data, Out<double, 1> work, Out<int64_t, 1> where) {
    for (int64_t c = 0; c < t.front.n[0]; ++c) {
        const int64_t nf = t.front[c], n = t.width[c], ns = n - nf, pf = padded(nf), ps = padded(ns);
        const double *A = data.data + t.at[c];
        double *C = t.cov.data + t.at[c];
        double *P = work.data, *X = P + nf * pf, *Q = X + nf * pf, *turned = Q + ns * ps, *Y = turned + ns * pf;
        std::memset(P, 0, sizeof(double) * nf * pf);
        for (int64_t i = 0; i < nf; ++i)
            for (int64_t j = i; j < nf; ++j) P[j * pf + i] = A[i * n + j];
        for (int64_t i = 0; i < nf; i += BAND)  // row i of R^-1 begins at its diagonal
            product(A + i * n + i, n, P + i * pf, pf, X + i * pf, pf, smaller(BAND, nf - i), nf, nf - i);
        for (int64_t i = 0; i < ns; ++i) {
            std::memset(Q + i * ps + ns, 0, sizeof(double) * (ps - ns));
            std::memset(turned + i * pf + nf, 0, sizeof(double) * (pf - nf));
        }
        gather_covariance(t, c, n_front[c], where.data, Q, ps);
        if (ns) {
            for (int64_t i = 0; i < nf; ++i)
                for (int64_t j = 0; j < ns; ++j) turned[j * pf + i] = A[i * n + nf + j];
            product(A + nf, n, Q, ps, Y, ps, nf, ns, ns);
            product(Y, ps, turned, pf, X, pf, nf, nf, ns, true);
        }
        for (int64_t i = 0; i < nf; ++i) {
            std::memcpy(C + i * n, X + i * pf, sizeof(double) * nf);
            std::memcpy(C + i * n + nf, Y + i * ps, sizeof(double) * ns);
        }
    }
}

// Joint covariance (n, n) of all keys of clique c, in their order. where (K,): scratch.
inline void clique_covariance(const Tree &t, Ints n_front, int64_t c, Out<double, 2> out, Out<int64_t, 1> where) {
    const int64_t nf = t.front[c], n = t.width[c];
    std::memcpy(out.data, t.cov.data + t.at[c], sizeof(double) * nf * n);
    for (int64_t i = 0; i < nf; ++i)
        for (int64_t j = nf; j < n; ++j) out(j, i) = out(i, j);
    gather_covariance(t, c, n_front[c], where.data, out.data + nf * n + nf, n);
}

// Joint covariances (p, 2 d, 2 d) of pairs of keys of dimension d that share a clique; a key -1 is a constant. The first
// pair that shares none, or -1.
inline int64_t joint_blocks(const Tree &t, Ints first, Ints second, Out<double, 3> out) {
    const int64_t d = out.n[1] / 2, ld = out.n[2];
    for (int64_t p = 0; p < first.n[0]; ++p) {
        double *o = &out(p, 0, 0);
        std::memset(o, 0, sizeof(double) * ld * ld);
        const int64_t a = first[p], b = second[p];
        if (a >= 0) t.block(a, a, o, ld);
        if (b >= 0) t.block(b, b, o + d * ld + d, ld);
        if (a < 0 || b < 0) continue;
        if (!t.block(a, b, o + d, ld)) return p;
        for (int64_t i = 0; i < d; ++i)
            for (int64_t j = 0; j < d; ++j) o[(d + j) * ld + i] = o[i * ld + d + j];
    }
    return -1;
}

constexpr int64_t STRIP = 32;  // rows of a clique's block that are turned or cut to a triangle at once

// Numbers of scratch that solve_cliques takes for m columns.
inline int64_t solution_room(Ints width, int64_t m) {
    int64_t most = 0;
    for (int64_t c = 0; c < width.n[0]; ++c) most = larger(most, width[c] * (STRIP + 2 * padded_most(m)));
    return most;
}

// Q x in place (D, m). With R'u = x, R y = u: over the cliques up (parents first) from leaves to roots, which hold every
// ancestor of where x is not zero; then back over down, which hold every ancestor of where Q x is wanted. first: row of x
// at which a key begins. rows: scratch as wide as the widest clique.
inline void solve_cliques(Ints up, Ints down, Ints key_ptr, Ints keys, Ints dims, Ints first, Ints front, Ints width, Ints at, Vector data,
                          Out<double, 2> x, Out<int64_t, 1> rows, Out<double, 1> work) {
    const int64_t m = x.n[1], pm = padded(m), line = sizeof(double) * m;
    const auto place = [&](int64_t c) {
        int64_t o = 0;
        for (int64_t i = key_ptr[c]; i < key_ptr[c + 1]; ++i)
            for (int64_t j = 0; j < dims[keys[i]]; ++j) rows.data[o++] = first[keys[i]] + j;
    };
    // C (n, m) = A B with B the first rows of x in the clique, and A (n, inner) of what entry(i, j) says: of its first rows
    // zero behind the diagonal, or of all before it
    const auto times = [&](int64_t n, int64_t inner, bool behind, auto entry) {
        double *B = work.data, *C = B + inner * pm, *A = C + n * pm;
        std::memset(B, 0, sizeof(double) * inner * pm);
        for (int64_t i = 0; i < inner; ++i) std::memcpy(B + i * pm, x.data + rows[i] * m, line);
        for (int64_t i = 0; i < n; i += STRIP) {
            const int64_t some = smaller(STRIP, n - i), begin = behind ? 0 : i, end = behind ? smaller(inner, i + some) : inner, ld = end - begin;
            for (int64_t k = 0; k < some; ++k)
                for (int64_t j = begin; j < end; ++j) A[k * ld + j - begin] = entry(i + k, j);
            product(A, ld, B + begin * pm, pm, C + i * pm, pm, some, m, ld);
        }
        return C;
    };
    for (int64_t index = up.n[0] - 1; index >= 0; --index) {
        const int64_t c = up[index], nf = front[c], n = width[c];
        const double *R = data.data + at[c];
        place(c);
        const double *C = times(n, nf, true, [&](int64_t i, int64_t j) { return j <= i ? R[j * n + i] : 0.0; });
        for (int64_t i = 0; i < n; ++i) {
            double *to = x.data + rows[i] * m;
            if (i < nf) std::memcpy(to, C + i * pm, line);
            else add_multiple(1.0, C + i * pm, to, m);
        }
    }
    for (int64_t index = 0; index < down.n[0]; ++index) {
        const int64_t c = down[index], nf = front[c], n = width[c];
        const double *R = data.data + at[c];
        place(c);
        const double *C = times(nf, n, false, [&](int64_t i, int64_t j) { return i <= j ? R[i * n + j] : 0.0; });
        for (int64_t i = 0; i < nf; ++i) std::memcpy(x.data + rows[i] * m, C + i * pm, line);
    }
}

// The ways of some keys up a tree. parents: of cliques, which have lower numbers. of_key, of_clique: zero at first; of set s
// 2 s + 2 for keys that were asked for and are left, and cliques that a way has reached; 2 s + 1 for what else was seen.
struct Ways {
    explicit Ways(Reader &r) : parents(r), n_front(r), of_key(r), of_clique(r), way(r), heap(r) {}
    Ints parents, n_front;
    Out<int64_t, 1> of_key, of_clique, way, heap;  // the last two have room for all cliques
    int64_t seen = -1, wanted = 0, waiting = 0, length = 0;  // length: of the way

    void begin() { seen += 2, wanted = waiting = length = 0; }
    void push(int64_t clique) {
        heap.data[waiting++] = clique;
        std::push_heap(heap.data, heap.data + waiting);
    }
    // Whether it was not yet.
    bool ask(int64_t key, int64_t home) {
        if (of_key[key] > seen) return false;
        of_key.data[key] = seen + 1;
        ++wanted;
        if (of_clique[home] < seen) {
            of_clique.data[home] = seen;
            push(home);
        }
        return true;
    }
    // The first clique, from the leaves up, with all keys that are left, or -1; the way below it, parents last. fresh(key): of
    // each that is met there for the first time.
    int64_t climb(const Tree &t, auto fresh) {
        for (int64_t reached = 0; waiting;) {
            std::pop_heap(heap.data, heap.data + waiting);
            const int64_t c = heap[--waiting], begin = t.key_ptr[c], end = t.key_ptr[c + 1], p = parents[c];
            reached -= of_clique[c] > seen;
            int64_t inside = 0;
            for (int64_t i = begin; i < end; ++i) inside += of_key[t.keys[i]] > seen;
            if (!reached && inside == wanted) return c;
            for (int64_t i = begin; i < end; ++i) {
                const int64_t k = t.keys[i];
                const bool left = of_key[k] > seen, own = i < begin + n_front[c];
                if (of_key[k] < seen) fresh(k);
                wanted -= own && left;
                if (own || !left) of_key.data[k] = seen;
            }
            way.data[length++] = c;
            if (p < 0) continue;
            if (of_clique[p] < seen) push(p);
            reached += of_clique[p] <= seen;
            of_clique.data[p] = seen + 1;
        }
        return -1;
    }
};

// Numbers of scratch that sets_among takes, of sets of m rows at most.
inline int64_t sets_room(Ints width, int64_t m) {
    int64_t most = 0;
    for (int64_t c = 0; c < width.n[0]; ++c) most = larger(most, width[c] * (width[c] + 2 * padded_most(m)));
    return larger(most, solution_room(width, m));
}

// G (m, m) += x' Q x of those rows x (., m) of the keys of a clique that the ways have met.
inline void add_covariance(const Tree &t, int64_t clique, const Ways &ways, Ints first, const double *x, int64_t m, double *work, double *G) {
    const int64_t begin = t.key_ptr[clique], end = t.key_ptr[clique + 1], pm = padded(m);
    const auto met = [&](int64_t i) { return ways.of_key[t.keys[i]] >= ways.seen; };
    int64_t n = 0, at = 0;
    for (int64_t i = begin; i < end; ++i) n += met(i) * t.dims[t.keys[i]];
    double *Q = work, *X = Q + n * n, *Y = X + n * pm;
    for (int64_t i = begin; i < end; ++i) {
        const int64_t a = t.keys[i], rows = t.dims[a];
        if (!met(i)) continue;
        for (int64_t r = 0; r < rows; ++r) {
            std::memcpy(X + (at + r) * pm, x + (first[a] + r) * m, sizeof(double) * m);
            std::memset(X + (at + r) * pm + m, 0, sizeof(double) * (pm - m));
        }
        for (int64_t j = begin, column = 0; j <= i; ++j) {
            if (!met(j)) continue;
            const int64_t columns = t.dims[t.keys[j]];
            t.block(a, t.keys[j], Q + at * n + column, n);
            for (int64_t r = 0; r < rows; ++r)
                for (int64_t k = 0; k < columns; ++k) Q[(column + k) * n + at + r] = Q[(at + r) * n + column + k];
            column += columns;
        }
        at += rows;
    }
    product(Q, n, X, pm, Y, pm, n, m, n);
    for (int64_t r = 0; r < n; ++r)
        for (int64_t i = 0; i < m; ++i) add_multiple(X[r * pm + i], Y + r * pm, G + i * m, m);
}

// A Q A' of sets of sparse rows A (row_ptr, columns, entries), set s from row set_ptr[s] on, one after the other in out: u'u
// with R'u = A' on the ways to the first clique that holds all that is left, and this with its covariance. key_of: of every
// column. x: for every column as many numbers as the largest set has rows.
inline void sets_among(Ints set_ptr, Ints row_ptr, Ints columns, Vector entries, const Tree &t, Ways ways, Ints key_of, Ints first, Vector data,
                       Out<double, 1> out, Out<double, 1> x, Out<int64_t, 1> rows, Out<double, 1> work) {
    double *G = out.data;
    for (int64_t s = 0; s + 1 < set_ptr.n[0]; ++s) {
        const int64_t begin = set_ptr[s], m = set_ptr[s + 1] - begin;
        const auto clear = [&](int64_t k) { std::memset(x.data + first[k] * m, 0, sizeof(double) * m * t.dims[k]); };
        ways.begin();
        for (int64_t e = row_ptr[begin]; e < row_ptr[begin + m]; ++e)
            if (const int64_t k = key_of[columns[e]]; ways.ask(k, t.home[k])) clear(k);
        const int64_t top = ways.climb(t, clear);
        for (int64_t r = 0; r < m; ++r)
            for (int64_t e = row_ptr[begin + r]; e < row_ptr[begin + r + 1]; ++e) x.data[columns[e] * m + r] += entries[e];
        std::reverse(ways.way.data, ways.way.data + ways.length);
        solve_cliques({ways.way.data, {ways.length}}, {ways.way.data, {0}}, t.key_ptr, t.keys, t.dims, first, t.front, t.width, t.at, data,
                      {x.data, {key_of.n[0], m}}, rows, work);
        std::memset(G, 0, sizeof(double) * m * m);
        for (int64_t i = 0; i < ways.length; ++i) {
            const double *u = x.data + first[t.keys[t.key_ptr[ways.way[i]]]] * m;
            for (int64_t r = 0; r < t.front[ways.way[i]]; ++r, u += m)
                for (int64_t k = 0; k < m; ++k) add_multiple(u[k], u, G + k * m, m);
        }
        if (top >= 0) add_covariance(t, top, ways, first, x.data, m, work.data, G);
        G += m * m;
    }
}

}  // namespace
