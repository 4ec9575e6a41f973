// Independent loops of a network, shortest first; see adjust.relay.cycles.
#pragma once
#include "arrays.h"

namespace {

// A network by compressed adjacency, and room for the shortest ways from one station; depth -1: no way led there yet.
struct Walks {
    explicit Walks(Reader &r) : ptr(r), neighbour(r), pair(r), depth(r), parent(r), by(r), branch(r), order(r), sum(r) {}
    Ints ptr, neighbour, pair;
    Out<int64_t, 1> depth, parent, by, branch, order, sum;

    // Shortest ways from a root to depth `half`; closed(v, e, w, length, sum of labels) of each pair e that closes a loop with two.
    template <class Closed> void from(int64_t root, const int64_t &half, const Ints &label, int64_t &work, Closed closed) const {
        int64_t reached = 1;
        order.data[0] = branch.data[root] = root, depth.data[root] = sum.data[root] = 0;
        for (int64_t k = 0; k < reached && depth[order[k]] <= half; ++k) {
            const int64_t v = order[k], here = depth[v];
            work += ptr[v + 1] - ptr[v];
            for (int64_t i = ptr[v]; i < ptr[v + 1]; ++i) {
                const int64_t w = neighbour[i], e = pair[i], there = depth[w];
                if (there < 0) {
                    if (here >= half) continue;
                    depth.data[w] = here + 1, parent.data[w] = v, by.data[w] = e, branch.data[w] = here ? branch[v] : w;
                    sum.data[w] = sum[v] ^ label[e];
                    order.data[reached++] = w;
                } else if (branch[v] != branch[w] && (here > there || (here == there && v < w)) && e != by[v] && (there == 0 || e != by[w])) {
                    // each closing pair once: from its deeper end, or from the lower number among equals
                    if (sum[v] ^ sum[w] ^ label[e]) closed(v, e, w, here + there + 1);
                }
            }
        }
        while (reached) depth.data[order[--reached]] = -1;
    }

    // Pairs of "way to v, pair e, way back from w", in the order of the walk.
    void write(int64_t v, int64_t e, int64_t w, int64_t *out) const {
        const int64_t there = depth[v];
        for (int64_t i = there; i > 0; v = parent[v]) out[--i] = by[v];
        out[there] = e;
        for (out += there + 1; w != order[0]; w = parent[w]) *out++ = by[w];
    }
};

// Sets of chords as bits, each row the one that is kept with its highest bit there; Gaussian elimination over GF(2).
struct Sets {
    explicit Sets(Reader &r) : chord(r), bits(r), rows(r), kept(r) {}
    Ints chord;  // number of each pair outside a spanning forest, -1 inside
    Out<int64_t, 1> bits;
    Out<int64_t, 2> rows;
    Out<bool, 1> kept;

    // Take in the set of chords of a loop; whether it is independent of those before. work: counts the eliminations.
    bool add(const int64_t *loop, int64_t length, int64_t &work) const {
        int64_t top = -1;
        for (int64_t i = 0; i < length; ++i)
            if (const int64_t c = chord[loop[i]]; c >= 0) {
                bits.data[c >> 6] ^= int64_t(uint64_t(1) << (c & 63));
                top = c >> 6 > top ? c >> 6 : top;
            }
        for (; top >= 0; --top)
            while (bits[top]) {
                ++work;
                const int64_t lead = 64 * top + 63 - std::countl_zero(uint64_t(bits[top]));
                int64_t *row = rows.data + lead * rows.n[1];
                if (!kept[lead]) {
                    for (int64_t k = 0; k <= top; ++k) row[k] = bits[k], bits.data[k] = 0;
                    return kept.data[lead] = true;
                }
                for (int64_t k = 0; k <= top; ++k) bits.data[k] ^= row[k];
            }
        return false;
    }
};

// Labels (L,) of the chords that lead no set, to those that do: so that the sum over each set is zero, as over all loops found.
inline void label_chords(In<int64_t, 2> rows, In<bool, 1> kept, Out<int64_t, 1> label) {
    for (int64_t lead = 0; lead < kept.n[0]; ++lead) {
        if (!kept[lead]) continue;
        label.data[lead] = 0;
        int64_t sum = 0;
        for (int64_t k = 0; 64 * k <= lead; ++k)
            for (uint64_t bits = uint64_t(rows(lead, k)); bits; bits &= bits - 1) sum ^= label[64 * k + std::countr_zero(bits)];
        label.data[lead] = sum;
    }
}

// Horton's loops of one length at every root, the independent ones into found (m, length), the stations at which they
// begin into start (m,). A loop whose labels cancel depends on those found before. work: elementary steps so far; no root is
// begun once they reach the budget. Returns how many.
inline int64_t horton_loops(const Walks &walks, const Sets &sets, Ints label, Ints roots, int64_t budget, Out<int64_t, 1> work,
                            Out<int64_t, 2> found, Out<int64_t, 1> start) {
    const int64_t most = found.n[0], length = found.n[1], half = length / 2;
    int64_t n = 0;
    for (int64_t r = 0; r < roots.n[0] && n < most && work[0] < budget; ++r)
        walks.from(roots[r], half, label, work.data[0], [&](int64_t v, int64_t e, int64_t w, int64_t closed) {
            if (n == most || closed != length) return;
            walks.write(v, e, w, found.data + n * length);
            if (sets.add(found.data + n * length, length, work.data[0])) start.data[n++] = roots[r];
        });
    return n;
}

// The length of the shortest loop whose labels do not cancel, among those that meet the roots; 0 where the budget does not last.
inline int64_t shortest_loop(const Walks &walks, Ints label, Ints roots, int64_t budget, Out<int64_t, 1> work) {
    int64_t shortest = walks.depth.n[0] + 1, half = shortest;
    for (int64_t r = 0; r < roots.n[0]; ++r) {
        if (work[0] >= budget) return 0;
        walks.from(roots[r], half, label, work.data[0], [&](int64_t, int64_t, int64_t, int64_t closed) {
            shortest = smaller(shortest, closed), half = (shortest - 1) / 2;
        });
    }
    return shortest;
}

}  // namespace
