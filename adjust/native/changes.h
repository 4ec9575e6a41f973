// Score tests of columns that a system does not have, from each of several runs of its rows on (see adjust.statistics.changes).
#pragma once
#include "dense.h"

namespace {

struct SparseRows {
    explicit SparseRows(Reader &r) : ptr(r), column(r), entry(r) {}
    Ints ptr, column;
    Vector entry;
};

// What the runs so far add up to, of q columns in w: x, s (n, w) = B'A of the last one and of those before it, mark (n) the run that
// touched a row of x, touched (n) which these are; left (q, w) = B'B less what own takes over, U B'A as shared (q, c); of
// columns (2, w) the squares B'B and the gradient B'e.
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
            add_multiple(A.entry[p], b, &x(i, 0), w);
        }
        for (int64_t a = 0; a < left.n[0]; ++a) {
            add_multiple(b[a], b, &left(a, 0), w);
            columns(0, a) += b[a] * b[a];
        }
        add_multiple(e, b, &columns(1, 0), w);
        return count;
    }
    // (s + x) own (s + x)' - s own s' = x own (x + 2 s)', made symmetric.
    void take_own(const SparseRows &own, int64_t i) const {
        const int64_t w = own.ptr[i] < own.ptr[i + 1] ? x.n[1] : 0;
        double z[2 * WIDEST] = {};
        for (int64_t p = own.ptr[i]; p < own.ptr[i + 1]; ++p) {
            add_multiple(own.entry[p], &x(own.column[p], 0), z, w);
            add_multiple(2.0 * own.entry[p], &s(own.column[p], 0), z, w);
        }
        for (int64_t a = 0; a < smaller(left.n[0], w); ++a) {
            add_multiple(-0.5 * x(i, a), z, &left(a, 0), w);
            add_multiple(-0.5 * z[a], &x(i, 0), &left(a, 0), w);
        }
    }
};

// For whitened columns B (k, w) in the rows first[j] .. of every run j, whose sums are over all runs from j on: the diagonal
// of B'B into squares (J, q), B'(I - A Q A')B into M (J, q, q), B'e into g (J, q). Q = own + U'U, given U' (n, c). w: whole
// vectors, no more than 2 WIDEST, zero behind q of them; later: all zero, mark -1.
inline void change_squares(Ints first, Ints rows, In<double, 2> B, const SparseRows &A, Vector e, const SparseRows &own, In<double, 2> U,
                           const LaterRuns &later, Out<double, 2> squares, Out<double, 3> M, Out<double, 2> g) {
    const int64_t w = B.n[1], c = U.n[1];
    for (int64_t j = first.n[0] - 2; j >= 0; --j) {
        int64_t count = 0;
        for (int64_t k = first[j]; k < first[j + 1]; ++k) count = later.add(j, A, rows[k], e[rows[k]], &B(k, 0), count);
        for (int64_t t = 0; t < count; ++t) {
            const int64_t i = later.touched[t];
            later.take_own(own, i);
            for (int64_t a = 0; a < g.n[1]; ++a) add_multiple(later.x(i, a), &U(i, 0), &later.shared(a, 0), c);
        }
        for (int64_t t = 0; t < count; ++t) {
            double *from = &later.x(later.touched[t], 0);
            add_multiple(1.0, from, &later.s(later.touched[t], 0), w);
            std::memset(from, 0, sizeof(double) * w);
        }
        for (int64_t a = 0; a < g.n[1]; ++a) {
            squares(j, a) = later.columns(0, a), g(j, a) = later.columns(1, a);
            for (int64_t b = 0; b <= a; ++b) {
                const double taken = dot(&later.shared(a, 0), &later.shared(b, 0), c);
                M(j, a, b) = later.left(a, b) - taken, M(j, b, a) = later.left(b, a) - taken;
            }
        }
    }
}

}  // namespace
