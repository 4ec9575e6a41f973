// Score tests of columns that a system does not have, from each of several runs of its rows on (see adjust.statistics.changes).
#pragma once
#include "dense.h"

namespace {

struct SparseRows {
    explicit SparseRows(Reader &r) : ptr(r), column(r), entry(r) {}
    Ints ptr, column;
    Vector entry;
};

// Whitened columns B (k, q) of some rows: those of row i stand in table from at[i] on.
struct ColumnsOfRows {
    explicit ColumnsOfRows(Reader &r) : rows(r), at(r), table(r) {}
    Ints rows, at;
    Vector table;
};

// What the runs so far add up to, of q columns in w, whole vectors: x, s (n, w) = A'B of the last one and of those before it, mark
// (n) the run that touched a row of x, touched (n) which these are; left (q, w) = B'B less what own takes over, U'A'B as shared
// (c, w); of columns (2, w) the squares B'B and the gradient B'e.
struct LaterRuns {
    explicit LaterRuns(Reader &r) : x(r), s(r), mark(r), touched(r), left(r), shared(r), columns(r) {}
    Out<double, 2> x, s;
    Out<int64_t, 1> mark, touched;
    Out<double, 2> left, shared, columns;

    // Row r of the system, where the columns are b; how many rows of x run j has touched.
    int64_t add(int64_t j, const SparseRows &A, int64_t r, double e, const double *b, int64_t count) const {
        const int64_t w = x.n[1];
        for (int64_t p = A.ptr[r]; p < A.ptr[r + 1]; ++p) {
            const int64_t i = A.column[p];
            if (mark[i] != j) mark.data[i] = j, touched.data[count++] = i;
            add_vectors(A.entry[p], b, &x(i, 0), w);
        }
        for (int64_t a = 0; a < left.n[0]; ++a) {
            if (b[a] != 0.0) add_vectors(b[a], b, &left(a, 0), w);
            columns(0, a) += b[a] * b[a];
        }
        add_vectors(e, b, &columns(1, 0), w);
        return count;
    }
    // (s + x) own (s + x)' - s own s' = x own (x + 2 s)', made symmetric.
    void take_own(const SparseRows &own, int64_t i) const {
        const int64_t w = own.ptr[i] < own.ptr[i + 1] ? x.n[1] : 0;
        alignas(64) double z[2 * WIDEST] = {};
        for (int64_t p = own.ptr[i]; p < own.ptr[i + 1]; ++p) {
            add_vectors(own.entry[p], &x(own.column[p], 0), z, w);
            add_vectors(2.0 * own.entry[p], &s(own.column[p], 0), z, w);
        }
        for (int64_t a = 0; a < smaller(left.n[0], w); ++a) {
            add_vectors(-0.5 * x(i, a), z, &left(a, 0), w);
            add_vectors(-0.5 * z[a], &x(i, 0), &left(a, 0), w);
        }
    }
    // U'x of the rows that a run touched, of K columns of U from c on: their sums in registers.
    template <int K> void share(In<double, 2> U, int64_t c, int64_t count) const {
        for (int64_t v = 0; v < x.n[1]; v += W) {
            V sum[K];
            for (int k = 0; k < K; ++k) sum[k] = load(&shared(c + k, v));
            for (int64_t t = 0; t < count; ++t) {
                const V of_x = load(&x(touched[t], v));
                const double *u = &U(touched[t], c);
#pragma GCC unroll 8
                for (int k = 0; k < K; ++k) sum[k] += u[k] * of_x;
            }
            for (int k = 0; k < K; ++k) store(&shared(c + k, v), sum[k]);
        }
    }
    void share(In<double, 2> U, int64_t count) const {
        int64_t c = 0;
        for (; c + 8 <= U.n[1]; c += 8) share<8>(U, c, count);
        for (; c < U.n[1]; ++c) share<1>(U, c, count);
    }
    // left - shared'shared, of the first q columns.
    void difference(Out<double, 2> M) const {
        const int64_t q = M.n[0], w = x.n[1];
        alignas(64) double row[2 * WIDEST];
        for (int64_t a = 0; a < q; ++a) {
            std::memcpy(row, &left(a, 0), sizeof(double) * w);
            for (int64_t v = 0; v < w; v += W) {
                V sum = load(row + v);
                for (int64_t c = 0; c < shared.n[0]; ++c) sum -= shared(c, a) * load(&shared(c, v));
                store(row + v, sum);
            }
            std::memcpy(&M(a, 0), row, sizeof(double) * q);
        }
    }
    // y += f x, of whole vectors.
    static void add_vectors(double f, const double *x, double *y, int64_t n) {
        for (int64_t i = 0; i < n; i += W) store(y + i, load(y + i) + f * load(x + i));
    }
};

// Of columns B, the rows of run j from first[j] on, and of the sums over all runs from j on: the diagonal of B'B into squares
// (J, q), B'(I - A Q A')B into M (J, q, q), B'e into g (J, q). Q = own + U'U, given U' (n, c). later: all zero, mark -1; w no
// more than 2 WIDEST.
inline void change_squares(Ints first, const ColumnsOfRows &B, const SparseRows &A, Vector e, const SparseRows &own, In<double, 2> U,
                           const LaterRuns &later, Out<double, 2> squares, Out<double, 3> M, Out<double, 2> g) {
    const int64_t w = later.x.n[1], q = g.n[1];
    alignas(64) double b[2 * WIDEST] = {};
    for (int64_t j = first.n[0] - 2; j >= 0; --j) {
        int64_t count = 0;
        for (int64_t k = first[j]; k < first[j + 1]; ++k) {
            bool some = false;
            for (int64_t a = 0; a < q; ++a) b[a] = B.table[B.at[k] + a], some |= b[a] != 0.0;
            if (some) count = later.add(j, A, B.rows[k], e[B.rows[k]], b, count);
        }
        for (int64_t t = 0; t < count; ++t) later.take_own(own, later.touched[t]);
        later.share(U, count);
        for (int64_t t = 0; t < count; ++t) {
            double *from = &later.x(later.touched[t], 0);
            later.add_vectors(1.0, from, &later.s(later.touched[t], 0), w);
            std::memset(from, 0, sizeof(double) * w);
        }
        later.difference(M[j]);
        for (int64_t a = 0; a < q; ++a) squares(j, a) = later.columns(0, a), g(j, a) = later.columns(1, a);
    }
}

}  // namespace
