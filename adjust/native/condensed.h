// Rows of image blocks with the normal equations of all their points: over the keys, and by what a block could have besides.
#pragma once
#include "images.h"

namespace {

constexpr int MAX_ROWS = MAX_LOCAL + N_SHAPE;

// What the derivatives by x, y, z and z again of the points are multiplied by for the shape of their target: those of block b
// stand in table from first[b] on; -1: none.
struct Shapes {
    explicit Shapes(Reader &r) : first(r), point(r), table(r) {}
    Ints first, point;
    In<double, 2> table;
};
// Where rows (g, m) of g blocks go: by lens, camera, target and shape (g, m, ..), residuals e (g, m); over the keys,
// which have the columns (g, w), -1 for what is held, the entries that are not zero one row after the other, length (g, m) of each.
struct CondensedRows {
    explicit CondensedRows(Reader &r) : columns(r), lens(r), camera(r), target(r), shape(r), e(r), length(r), entry(r), column(r) {}
    In<int64_t, 2> columns;
    Out<double, 3> lens, camera, target, shape;
    Out<double, 2> e;
    Out<int64_t, 2> length;
    Out<double, 3> entry;
    Out<int64_t, 3> column;
};

// Derivatives by the shape, behind the n local columns and the residual of a chunk; what fills up its last vector weighs nothing.
inline void shape_columns(const Batch &B, int64_t b, const Shapes &shapes, int64_t lo, const Chunk &chunk, int n, Room &room) {
    const int64_t z = B.lenses.n_free[B.blocks.camera[b]] + 5, first = shapes.first[b];
    alignas(64) double factor[N_SHAPE][CHUNK] = {};
    for (int p = 0; p < chunk.m && first >= 0; ++p)
        for (int s = 0; s < N_SHAPE; ++s) factor[s][p] = shapes.table(first + shapes.point[lo + p], s);
    for (int s = 0; s < N_SHAPE; ++s) {
        const double *by_point = room.A[smaller(z - 2 + s, z)];
        double *out = room.A[n + 1 + s];
        for (int p = 0; p < chunk.full; p += W) {
            const V f = load(&factor[s][p]);
            store(out + p, f * load(by_point + p)), store(out + chunk.full + p, f * load(by_point + chunk.full + p));
        }
    }
}

// Rows T of block b by its n local unknowns, the shape and the residual: the triangle of its normal equations, or as they are.
inline void local_rows(const Batch &B, int64_t b, const Shapes &shapes, bool triangle, Room &room, double (*T)[MAX_ROWS]) {
    const int n = int(B.n_local(b)), k = n + N_SHAPE + 1;
    const auto place = [&](int64_t c) { return c < n ? c : c == n ? k - 1 : c - 1; };
    double N[MAX_ROWS][MAX_ROWS] = {};
    V least = V{};
    clear_unused(B, b, room);
    each_chunk(B, b, [&](int64_t lo, int size) {
        const Chunk chunk(B, lo, size, room);
        local_columns(B, b, chunk, least, room);
        shape_columns(B, b, shapes, lo, chunk, n, room);
        if (triangle) return add_gram(room.A, k, 2 * chunk.full, N);
        for (int p = 0; p < size; ++p)
            for (int s = 0; s < 2; ++s)
                for (int c = 0; c < k; ++c) T[2 * (lo - B.blocks.ptr[b] + p) + s][place(c)] = room.A[c][s * chunk.full + p];
    });
    if (!triangle) return;
    for (int j = 0; j < k; ++j)
        for (int c = j; c < k; ++c) T[smaller(place(j), place(c))][larger(place(j), place(c))] = N[j][c];
    half_cholesky(T, k);
}

// By a motion of the camera in its own axes, Ad(T^-1)' of that by one of the target (6,).
inline void by_camera(const double *pose, const double *R, const double *t, double *camera) {
    double *shift = camera + 3;
    for (int i = 0; i < 3; ++i) shift[i] = dot3(R + 3 * i, pose + 3);
    cross3(t, shift, camera);
    for (int i = 0; i < 3; ++i) camera[i] += dot3(R + 3 * i, pose);
}

// Of listed blocks, which have equally many points and columns, rows with the normal equations of their own; how many entries.
inline int64_t condensed_rows(Ints which, const Batch &B, const Segments &S, In<double, 3> C, In<double, 3> D, const Shapes &shapes,
                              const CondensedRows &out) {
    Room room;
    double T[MAX_ROWS][MAX_ROWS], E[6][MAX_KEY];
    const int64_t m = out.e.n[1], w = out.columns.n[1];
    int64_t found = 0;
    for (int64_t i = 0; i < which.n[0]; ++i) {
        const int64_t b = which[i], nl = B.lenses.n_free[B.blocks.camera[b]], n = B.n_local(b), k = n + N_SHAPE + 1;
        const int64_t rows = m < k ? m : n;  // those of a triangle behind have nothing of the keys
        local_rows(B, b, shapes, m == k, room, T);
        for (int64_t j = 0; j < m; ++j) {
            for (int64_t c = 0; c < out.lens.n[2]; ++c) out.lens(i, j, c) = c < nl ? T[j][c] : 0.0;
            by_camera(T[j] + nl, &B.poses.R(b, 0, 0), &B.poses.t(b, 0), &out.camera(i, j, 0));
            std::memcpy(&out.target(i, j, 0), T[j] + nl, sizeof(double) * 6);
            std::memcpy(&out.shape(i, j, 0), T[j] + n, sizeof(double) * N_SHAPE);
            out.e(i, j) = T[j][k - 1], out.length(i, j) = 0;
        }
        double *by_key = out.entry.data + found;
        std::memset(by_key, 0, sizeof(double) * rows * w);
        each_segment(S, b, nl,
            [&](int64_t s, int64_t first) {
                for (int64_t j = 0; j < rows; ++j)
                    for (int64_t c = 0; c < S.n[s]; ++c) by_key[j * w + S.place[s] + c] += S.factor[s] * T[j][first + c];
            },
            [&](int64_t s) {
                pose_by_key(s, S, C, D, E);
                for (int64_t j = 0; j < rows; ++j)
                    for (int a = 0; a < 6; ++a)
                        for (int64_t c = 0; c < S.n[s]; ++c) by_key[j * w + S.place[s] + c] += T[j][nl + a] * E[a][c];
            });
        for (int64_t j = 0; j < rows; ++j)
            for (int64_t c = 0; c < w; ++c)
                if (const double v = by_key[j * w + c]; v != 0.0 && out.columns(i, c) >= 0) {
                    out.entry.data[found] = v, out.column.data[found++] = out.columns(i, c);
                    ++out.length.data[i * m + j];
                }
    }
    return found;
}

}  // namespace
