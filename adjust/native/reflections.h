// [R S] of cliques of poses by reflections of the rows themselves (multifrontal QR: Duff and Reid 1983, Liu 1986): what a
// normal matrix squares away is kept, as of corridors whose ends tell of each other through thousands of pairs.
#pragma once
#include <algorithm>
#include "elimination.h"

namespace {

constexpr double LOST_IN_ROWS = 0x1p-80;  // share of its diagonal, a square, below which a pivot counts as zero

// The rows of one clique, n long, and the column at which each begins; order, w: scratch.
struct Rows {
    double *F;
    int64_t *begin, *order;
    double *w;
    int64_t n, m = 0;

    double *add(int64_t first) {
        begin[m] = first;
        return static_cast<double *>(std::memset(F + m++ * n, 0, sizeof(double) * n));
    }
    // To a triangle by Householder's reflections: take(j, row) of every column j in turn, null where no row has it.
    void reflect(auto take) {
        for (int64_t i = 0; i < m; ++i) order[i] = i;
        std::sort(order, order + m, [&](int64_t a, int64_t b) { return begin[a] != begin[b] ? begin[a] < begin[b] : a < b; });
        for (int64_t j = 0, head = 0, end = 0; j < n; ++j) {
            double squares = 0.0;
            for (; end < m && begin[order[end]] <= j; ++end) {}
            for (int64_t i = head; i < end; ++i) squares += F[order[i] * n + j] * F[order[i] * n + j];
            if (squares == 0.0) {
                take(j, static_cast<double *>(nullptr));
                continue;
            }
            double *pivot = F + order[head++] * n;
            const double x = pivot[j], alpha = x > 0.0 ? -root(squares) : root(squares), f = 1.0 / (alpha * (alpha - x));
            if (head < end) {
                std::memset(w, 0, sizeof(double) * n);
                add_multiple(x - alpha, pivot + j + 1, w + j + 1, n - j - 1);
                for (int64_t i = head; i < end; ++i) add_multiple(F[order[i] * n + j], F + order[i] * n + j + 1, w + j + 1, n - j - 1);
                add_multiple(-f * (x - alpha), w + j + 1, pivot + j + 1, n - j - 1);
                for (int64_t i = head; i < end; ++i) add_multiple(-f * F[order[i] * n + j], w + j + 1, F + order[i] * n + j + 1, n - j - 1);
                pivot[j] = alpha;
            }
            take(j, pivot);
        }
    }
};

// The upper triangle whose square is what is known of a single node, as rows that begin at a column; none where it is zero.
inline void add_own(const double *own, int64_t at, Rows &rows) {
    double L[POSE][POSE] = {};
    for (int64_t j = 0; j < POSE; ++j) {
        double *row = L[j];
        for (int64_t k = j; k < POSE; ++k) {
            row[k] = own[j * POSE + k];
            for (int64_t i = 0; i < j; ++i) row[k] -= L[i][j] * L[i][k];
        }
        const bool some = row[j] > 0x1p-48 * own[j * POSE + j];
        const double f = some ? 1.0 / root(row[j]) : 0.0;
        for (int64_t k = j; k < POSE; ++k) row[k] *= f;
        if (some) std::memcpy(rows.add(at + j) + at + j, row + j, sizeof(double) * (POSE - j));
    }
}

// As eliminate, of the same pairs. order: the cliques, each after all below it, which stand side by side. pair_ptr, pairs: the
// pairs of every clique, the deepest that has both ends. rest: room for what is left on the way. The rest: scratch.
inline int64_t eliminate_rows(const Cliques &t, Ints parents, Ints order, Ints pair_ptr, Ints pairs, Ints first, Ints second, In<double, 3> by_first,
                              In<double, 3> by_second, In<double, 3> own, Out<double, 1> rest, Out<double, 1> work, Out<int64_t, 2> rows,
                              Out<int64_t, 1> where, Out<int64_t, 1> pending, Out<double, 1> diagonal) {
    std::memset(t.data.data, 0, sizeof(double) * t.data.n[0]);
    for (int64_t k = 0; k < t.home.n[0]; ++k)
        for (int64_t i = 0; i < POSE; ++i) diagonal.data[POSE * k + i] = own(k, i, i);
    const auto measure = [&](int64_t k, const double *A) {
        for (int64_t i = 0; k >= 0 && i < POSE * POSE; ++i) diagonal.data[POSE * k + i % POSE] += A[i] * A[i];
    };
    for (int64_t e = 0; e < first.n[0]; ++e) measure(first[e], &by_first(e, 0, 0)), measure(second[e], &by_second(e, 0, 0));
    int64_t waiting = 0;
    double *top = rest.data;
    for (int64_t index = 0; index < order.n[0]; ++index) {
        const int64_t c = order[index], nf = POSE * t.n_front[c], n = t.width(c), ns = n - nf, begin = t.key_ptr[c];
        Rows mine{work.data + n, &rows(0, 0), &rows(1, 0), work.data, n};
        for (int64_t k = begin; k < t.key_ptr[c + 1]; ++k) where.data[t.keys[k]] = POSE * (k - begin);
        for (int64_t p = pair_ptr[c]; p < pair_ptr[c + 1]; ++p) {
            const int64_t e = pairs[p], a = first[e], b = second[e], of_a = a < 0 ? n : where[a], of_b = b < 0 ? n : where[b];
            for (int64_t i = 0; i < POSE; ++i) {
                double *row = mine.add(smaller(of_a, of_b));
                if (a >= 0) std::memcpy(row + of_a, &by_first(e, i, 0), sizeof(double) * POSE);
                if (b >= 0) std::memcpy(row + of_b, &by_second(e, i, 0), sizeof(double) * POSE);
            }
        }
        for (int64_t k = begin; k < begin + t.n_front[c]; ++k) add_own(&own(t.keys[k], 0, 0), where[t.keys[k]], mine);
        for (; waiting && parents[pending[waiting - 1]] == c; --waiting) {
            const int64_t b = pending[waiting - 1], keys = t.key_ptr[b] + t.n_front[b], wide = POSE * (t.key_ptr[b + 1] - keys);
            top -= wide * wide;
            for (int64_t i = 0; i < wide; ++i) {
                const double *from = top + i * wide;
                if (from[i] == 0.0) continue;
                double *row = mine.add(where[t.keys[keys + i / POSE]] + i % POSE);
                for (int64_t j = i; j < wide; ++j) row[where[t.keys[keys + j / POSE]] + j % POSE] = from[j];
            }
        }
        double *A = t.data.data + t.at[c];
        int64_t lost = -1;
        std::memset(top, 0, sizeof(double) * ns * ns);
        mine.reflect([&](int64_t j, const double *row) {
            if (j < nf && (!row || !(row[j] * row[j] > LOST_IN_ROWS * diagonal[POSE * t.keys[begin] + j]))) lost = lost < 0 ? j : lost;
            double *to = j < nf ? A + j * n : top + (j - nf) * ns - nf;
            for (int64_t k = j; row && k < n; ++k) to[k] = row[j] < 0.0 ? -row[k] : row[k];
        });
        if (lost >= 0) return t.keys[begin] + lost / POSE;
        top += ns * ns;
        pending.data[waiting++] = c;
    }
    return -1;
}

}  // namespace
