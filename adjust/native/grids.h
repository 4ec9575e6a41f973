// The corners of a checkerboard in a small image, by their ring of grey values, and the grid that they form.
#pragma once
#include "lanes.h"

namespace {

using Bytes = Array<const uint8_t, 2>;
constexpr int RING = 16, RADIUS = 5;
constexpr int RING_AT[RING][2] = {{5, 0}, {5, 2}, {4, 4}, {2, 5}, {0, 5}, {-2, 5}, {-4, 4}, {-5, 2}, {-5, 0}, {-5, -2}, {-4, -4}, {-2, -5}, {0, -5}, {2, -5}, {4, -4}, {5, -2}};
constexpr int LANES = 4 * W;  // pixels side by side
typedef int16_t Short __attribute__((vector_size(2 * LANES)));
typedef uint8_t Byte __attribute__((vector_size(LANES)));

inline Short grays(const uint8_t *p) {
    Byte b;
    std::memcpy(&b, p, sizeof b);
    return __builtin_convertvector(b, Short);
}
inline Short magnitude(Short v) { return v < 0 ? -v : v; }

// How much a pixel looks like the corner of four squares: the ring around it changes colour four times, opposite pixels
// are alike, and the middle is between both (Bennett and Lasenby, ChESS, CVIU 118, 2014).
inline Short corner_response(const uint8_t *p, int64_t stride) {
    Short ring[RING], sums = Short{}, alike = Short{}, turns = Short{};
#pragma GCC unroll 16
    for (int n = 0; n < RING; ++n) ring[n] = grays(p + RING_AT[n][1] * stride + RING_AT[n][0]), sums += ring[n];
#pragma GCC unroll 8
    for (int n = 0; n < 8; ++n) alike += magnitude(ring[n] - ring[n + 8]);
#pragma GCC unroll 4
    for (int n = 0; n < 4; ++n) turns += magnitude(ring[n] + ring[n + 8] - ring[n + 4] - ring[n + 12]);
    const Short middle = grays(p) + grays(p - 1) + grays(p + 1) + grays(p - stride) + grays(p + stride);
    return turns - alike - magnitude(sums * 5 - middle * 16) / 5;
}

constexpr int MOST_CORNERS = 600, MOST_STEPS = 64;  // candidates; columns or rows of a grid
struct Candidates {
    int n = 0;
    double u[MOST_CORNERS], v[MOST_CORNERS], cosine[MOST_CORNERS], sine[MOST_CORNERS];  // place, twice the bright axis' angle
    int strength[MOST_CORNERS];
    bool taken[MOST_CORNERS];
};

// The local maxima of the response, an eighth of it, above a share of the largest and so much; false where there are too many.
[[gnu::noinline]] inline bool candidates(Bytes image, Out<uint8_t, 2> response, double share, double above, Candidates &out) {
    const int64_t h = image.n[0], w = image.n[1];
    Byte largest = Byte{};
    std::memset(response.data, 0, h * w);
    for (int64_t v = RADIUS; v < h - RADIUS; ++v)
        for (int64_t u = RADIUS; u < w - RADIUS; u += LANES) {
            const int64_t from = smaller(u, w - RADIUS - LANES);  // the last ones again
            const Short found = corner_response(&image.data[v * w + from], w);
            const Byte eighth = __builtin_convertvector(found > 0 ? found / 8 : Short{}, Byte);
            std::memcpy(&response.data[v * w + from], &eighth, sizeof eighth);
            largest = largest > eighth ? largest : eighth;
        }
    int most = 0;
    for (int i = 0; i < LANES; ++i) most = largest[i] > most ? largest[i] : most;
    const int least = int(smaller(larger(share * most, above), 256.0));
    for (int64_t v = RADIUS; v < h - RADIUS; ++v)
        for (int64_t u = RADIUS; u < w - RADIUS; ++u) {
            const uint8_t *at = &response.data[v * w + u];
            if (*at < least) continue;
            bool peak = true;
            double total = 0.0, x = 0.0, y = 0.0;
            for (int j = -2; j <= 2 && peak; ++j)
                for (int i = -2; i <= 2; ++i) {
                    const int other = at[j * w + i];
                    peak = peak && (j * 5 + i < 0 ? other < *at : other <= *at);
                    total += other, x += double(other) * i, y += double(other) * j;
                }
            if (!peak) continue;
            if (out.n == MOST_CORNERS) return false;
            double c = 0.0, s = 0.0;
            for (const auto &d : RING_AT) {
                const double gray = image.data[(v + d[1]) * w + u + d[0]], square = double(d[0] * d[0] + d[1] * d[1]);
                c += gray * (d[0] * d[0] - d[1] * d[1]) / square, s += gray * 2.0 * d[0] * d[1] / square;
            }
            const double size = root(c * c + s * s);
            if (!(size > 0.0)) continue;
            out.u[out.n] = double(u) + x / total, out.v[out.n] = double(v) + y / total;
            out.cosine[out.n] = c / size, out.sine[out.n] = s / size;
            out.strength[out.n] = *at, out.taken[out.n++] = false;
        }
    return true;
}

// A grid that grows from one corner to the next: along an edge of a square the bright axis turns by a right angle.
struct Growing {
    struct Node {
        int candidate, a, b;
        double step[2][2];  // px, to the next along a and along b
    };
    Candidates &all_of;
    int n = 0, low[2] = {}, high[2] = {};
    Node nodes[MOST_CORNERS];
    int16_t at[2 * MOST_STEPS + 1][2 * MOST_STEPS + 1];  // number of the node, -1

    explicit Growing(Candidates &c) : all_of(c) { std::memset(at, -1, sizeof at); }
    int16_t &cell(int a, int b) { return at[a + MOST_STEPS][b + MOST_STEPS]; }

    // Whether a corner is free, as strong as its neighbours are, and its bright axis across that of another.
    bool follows(int from, int i) const {
        const double along = all_of.cosine[i] * all_of.cosine[from] + all_of.sine[i] * all_of.sine[from];
        return !all_of.taken[i] && 3 * all_of.strength[i] > all_of.strength[from] && along < -0.3;
    }
    // The one that follows nearest to a place, -1 where none is within reach.
    int nearest(int from, double u, double v, double reach) const {
        int best = -1;
        double square = reach * reach;
        for (int i = 0; i < all_of.n; ++i) {
            const double du = all_of.u[i] - u, dv = all_of.v[i] - v, d = du * du + dv * dv;
            if (d < square && follows(from, i)) square = d, best = i;
        }
        return best;
    }
    void add(int candidate, int a, int b, const double (&step)[2][2]) {
        Node &node = nodes[n];
        node.candidate = candidate, node.a = a, node.b = b;
        std::memcpy(node.step, step, sizeof step);
        cell(a, b) = int16_t(n++), all_of.taken[candidate] = true;
        low[0] = a < low[0] ? a : low[0], high[0] = a > high[0] ? a : high[0];
        low[1] = b < low[1] ? b : low[1], high[1] = b > high[1] ? b : high[1];
    }
    // From a corner, with the nearest that follows and the nearest of those about a quarter turn from that.
    bool begin(int seed) {
        const double u = all_of.u[seed], v = all_of.v[seed];
        double step[2][2], least = __builtin_inf();
        all_of.taken[seed] = true;
        const int first = nearest(seed, u, v, 1e3);
        if (first < 0) return false;
        step[0][0] = all_of.u[first] - u, step[0][1] = all_of.v[first] - v;
        for (int i = 0; i < all_of.n; ++i) {
            const double du = all_of.u[i] - u, dv = all_of.v[i] - v, size = std::hypot(du, dv);
            const double across = magnitude(du * step[0][1] - dv * step[0][0]) / std::hypot(step[0][0], step[0][1]);
            if (follows(seed, i) && size < least && across > 0.7 * size) least = size, step[1][0] = du, step[1][1] = dv;
        }
        if (!std::isfinite(least)) return false;
        add(seed, 0, 0, step);
        return true;
    }
    void grow() {
        for (int k = 0; k < n; ++k)
            for (int side = 0; side < 4; ++side) {
                const Node node = nodes[k];
                const int axis = side / 2, sign = side % 2 ? -1 : 1, a = node.a + (axis == 0) * sign, b = node.b + (axis == 1) * sign;
                if (n == MOST_CORNERS || a < -MOST_STEPS || a > MOST_STEPS || b < -MOST_STEPS || b > MOST_STEPS || cell(a, b) >= 0) continue;
                const double u = all_of.u[node.candidate], v = all_of.v[node.candidate];
                const double du = sign * node.step[axis][0], dv = sign * node.step[axis][1];
                const int found = nearest(node.candidate, u + du, v + dv, 0.3 * std::hypot(du, dv));
                if (found < 0) continue;
                double step[2][2];
                std::memcpy(step, node.step, sizeof step);
                step[axis][0] = sign * (all_of.u[found] - u), step[axis][1] = sign * (all_of.v[found] - v);
                add(found, a, b, step);
            }
    }
    // Lines at the border, of which less than half is there, are what stands beside the board.
    void trim() {
        for (bool again = true; again;) {
            again = false;
            for (int side = 0; side < 4; ++side) {
                const int axis = side / 2, line = side % 2 ? high[axis] : low[axis];
                int there = 0;
                for (int k = low[1 - axis]; k <= high[1 - axis]; ++k) there += (axis == 0 ? cell(line, k) : cell(k, line)) >= 0;
                if (low[axis] == high[axis] || 2 * there >= high[1 - axis] - low[1 - axis] + 1) continue;
                (side % 2 ? high[axis] : low[axis]) += side % 2 ? -1 : 1;
                again = true;
            }
        }
    }
};

inline bool too_small(Bytes image) { return image.n[0] <= 2 * RADIUS || image.n[1] < 2 * RADIUS + 32; }

// How many places of an image of 8 bit have a response (an eighth of it) of so much, MOST_CORNERS at most. response: work.
inline int64_t count_crossings(Bytes image, double above, Out<uint8_t, 2> response) {
    static thread_local Candidates found;
    found.n = 0;
    return !too_small(image) && !candidates(image, response, 0.0, larger(above, 1.0), found) ? MOST_CORNERS : found.n;
}

// The corners (rows, columns, 2) px of the one board of so many that is whole in an image of 8 bit, good to half a pixel;
// false where there is none, or more of it: a finder that looks longer is to be asked then. response: work.
inline bool find_grid(Bytes image, Out<uint8_t, 2> response, Out<double, 3> grid) {
    static thread_local Candidates found;
    const int rows = int(grid.n[0]), columns = int(grid.n[1]);
    found.n = 0;
    if (too_small(image) || !candidates(image, response, 0.15, 4.0, found)) return false;
    for (int tried = 0; tried < 8; ++tried) {
        int seed = -1;
        for (int i = 0; i < found.n; ++i)
            if (!found.taken[i] && (seed < 0 || found.strength[i] > found.strength[seed])) seed = i;
        if (seed < 0) return false;
        Growing growing(found);
        if (!growing.begin(seed)) continue;
        growing.grow();
        growing.trim();
        const int na = growing.high[0] - growing.low[0] + 1, nb = growing.high[1] - growing.low[1] + 1;
        const bool turned = na == rows && nb == columns;
        if (!turned && (na != columns || nb != rows)) continue;
        bool whole = true;
        for (int i = 0; i < rows * columns; ++i) {
            const int row = i / columns, column = i % columns;
            const int k = growing.cell(growing.low[0] + (turned ? row : column), growing.low[1] + (turned ? column : row));
            whole = whole && k >= 0;
            if (k >= 0) grid(row, column, 0) = found.u[growing.nodes[k].candidate], grid(row, column, 1) = found.v[growing.nodes[k].candidate];
        }
        if (!whole) continue;
        return true;
    }
    return false;
}

}  // namespace
