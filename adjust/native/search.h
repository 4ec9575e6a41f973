// Hypotheses of which spot is which beacon: three spots named at a time, all poses, consensus of the rest.
#pragma once
#include "minimal.h"

namespace {

constexpr double BORDER = 0.05;  // tangent of an angle: a beacon just outside may still be the one of a spot at the border

// Least and largest distance between points of two rays at depths nearest to farthest.
inline void ray_gap(const Mat &o, const Mat &d, int i, int j, double nearest, double farthest, double *out) {
    const Vec a = {o[i][0] - o[j][0], o[i][1] - o[j][1], o[i][2] - o[j][2]};
    const double c = dot3(d[i], d[j]), p = dot3(a, d[i]), q = dot3(a, d[j]);
    const auto apart = [&](double s, double u) {
        const Vec v = {a[0] + s * d[i][0] - u * d[j][0], a[1] + s * d[i][1] - u * d[j][1], a[2] + s * d[i][2] - u * d[j][2]};
        return root(dot3(v, v));
    };
    out[1] = larger(larger(apart(nearest, nearest), apart(nearest, farthest)), larger(apart(farthest, nearest), apart(farthest, farthest)));
    double s = 0.5 * (nearest + farthest), u = s;
    for (int k = 0; k < 40; ++k) {  // alternate: the distance is convex on the square of depths
        u = smaller(larger(c * s + q, nearest), farthest);
        s = smaller(larger(c * u - p, nearest), farthest);
    }
    out[0] = apart(s, u);
}

struct Sky {
    explicit Sky(Reader &r)
        : origin(r), ray(r), camera(r), allowed(r), x_in_world(r), camera_R(r), camera_t(r), field(r), gate(taken<double>(r)), named(r),
          missed(r) {}
    In<double, 2> origin, ray;  // of the spots, in the station
    Ints camera;
    In<bool, 2> allowed;  // beacons of every spot
    In<double, 2> x_in_world;
    In<double, 3> camera_R;
    In<double, 2> camera_t, field;
    double gate;  // rad
    Vector named, missed;

    // Coarse score of a pose: named for every spot with a beacon within gate, less for its distance, and missed off for
    // every beacon that a camera should have seen. match: the beacons, -1 for none. best: scratch, one number a spot.
    double consensus(const Mat &R, const Vec &t, int64_t *match, double *best) const {
        const int64_t n = camera.n[0];
        double score = 0.0;
        for (int64_t i = 0; i < n; ++i) best[i] = gate * gate, match[i] = -1;
        for (int64_t b = 0; b < x_in_world.n[0]; ++b) {
            Vec q;
            into(R[0], 3, t, 1, &x_in_world(b, 0), q);
            for (int64_t c = 0; c < camera_R.n[0]; ++c) {
                const double *T = &camera_R(c, 0, 0), *f = &field(c, 0);
                const Vec w = {q[0] - camera_t(c, 0), q[1] - camera_t(c, 1), q[2] - camera_t(c, 2)};
                const double size = root(dot3(w, w));
                Vec p;
                for (int a = 0; a < 3; ++a) p[a] = T[a] * w[0] + T[3 + a] * w[1] + T[6 + a] * w[2];
                bool inside;
                if (f[4] < 1.5) {
                    inside = p[2] > f[4] * size;
                } else {
                    const double x = p[0] / p[2], y = p[1] / p[2];
                    inside = p[2] > 0 && f[0] < x && x < f[1] && f[2] < y && y < f[3];
                    if (p[2] <= 0 || x < f[0] - BORDER || x > f[1] + BORDER || y < f[2] - BORDER || y > f[3] + BORDER) continue;
                }
                int64_t chosen = -1;
                double nearest = gate * gate;
                for (int64_t i = 0; i < n; ++i) {
                    if (camera[i] != c || !allowed(i, b)) continue;
                    double apart = 0.0;
                    for (int a = 0; a < 3; ++a) {
                        const double d = w[a] / size - ray(i, a);
                        apart += d * d;
                    }
                    if (apart < nearest) chosen = i, nearest = apart;
                }
                if (chosen < 0) {
                    if (inside) score -= missed[c];
                } else if (nearest < best[chosen]) {
                    best[chosen] = nearest, match[chosen] = b;
                }
            }
        }
        for (int64_t i = 0; i < n; ++i)
            if (match[i] >= 0) score += named[i] - 4.0 * best[i] / (gate * gate);
        return score;
    }
};

struct Kept {
    explicit Kept(Reader &r) : R(r), t(r), score(r), match(r) {}
    Out<double, 3> R;
    Out<double, 2> t;
    Out<double, 1> score;
    Out<int64_t, 2> match;

    // Put a pose among the best; one naming may stand for several poses (mirror solutions), told by their turn. Of four
    // spots or more (count) different triples give about the same pose; three give all theirs at once.
    int64_t keep(const Mat &turn, const Vec &shift, double points, const int64_t *naming, int64_t count, int64_t kept) const {
        const double alike = count > 3 ? 2.9 : 3.0 - 1e-9;
        const int64_t n = match.n[1], room = score.n[0];
        int64_t place = -1;
        for (int64_t e = 0; e < kept && place < 0; ++e) {
            if (std::memcmp(&match(e, 0), naming, sizeof(int64_t) * n) != 0) continue;
            double trace = 0.0;
            for (int a = 0; a < 3; ++a)
                for (int b = 0; b < 3; ++b) trace += R(e, a, b) * turn[a][b];
            if (!(trace > alike)) continue;
            if (score[e] >= points) return kept;
            place = e;
        }
        if (place < 0 && kept < room) place = kept++;
        if (place < 0) {
            place = 0;
            for (int64_t e = 1; e < room; ++e)
                if (score[e] < score[place]) place = e;
            if (score[place] >= points) return kept;
        }
        std::memcpy(&R(place, 0, 0), turn, sizeof turn), std::memcpy(&t(place, 0), shift, sizeof shift);
        score.data[place] = points;
        std::memcpy(&match(place, 0), naming, sizeof(int64_t) * n);
        return kept;
    }
};

// Try the beacons allowed on triples (T, 3) of spots; keep the best poses, each naming once. Stops after most three-point
// problems, or when the best consensus makes it hopeless that a triple of true spots was not among those tried (the usual
// stop of RANSAC, with all beacons tried on each triple). Returns how many poses were kept. work, match: scratch, one
// number a spot and the distances between all beacons; one place a spot.
inline int64_t search(const Sky &sky, In<int64_t, 2> triples, double nearest, double farthest, int64_t most, const Kept &out, Out<double, 1> work,
                      Out<int64_t, 1> match) {
    const int64_t n = sky.camera.n[0], m = sky.x_in_world.n[0];
    double *best = work.data, *apart = best + n;
    for (int64_t a = 0; a < m; ++a)
        for (int64_t b = 0; b < m; ++b) apart[a * m + b] = distance(&sky.x_in_world(a, 0), &sky.x_in_world(b, 0));
    Mat R[MAX_SOLUTIONS], o, d, x;
    Vec t[MAX_SOLUTIONS];
    int64_t kept = 0, solved = 0, most_named = 0;
    for (int64_t number = 0; number < triples.n[0]; ++number) {
        if (most_named >= 4) {
            const double inliers = double(most_named) / double(n);
            // four named spots may still be chance: some more triples. All named leaves nothing to look for
            const double more = most_named == n && n > 4 ? 0.0 : 3.0;
            if (double(number) > std::log(1e-6) / std::log(1.0 - smaller(inliers * inliers * inliers, 0.9999999)) - 1.0 + more) break;
        }
        const int64_t *spot = &triples(number, 0);
        for (int i = 0; i < 3; ++i)
            for (int a = 0; a < 3; ++a) o[i][a] = sky.origin(spot[i], a), d[i][a] = sky.ray(spot[i], a);
        double g01[2], g12[2], g02[2];
        ray_gap(o, d, 0, 1, nearest, farthest, g01), ray_gap(o, d, 1, 2, nearest, farthest, g12), ray_gap(o, d, 0, 2, nearest, farthest, g02);
        const auto fits = [&](const double *gap, int64_t p, int64_t q) { return gap[0] <= apart[p * m + q] && apart[p * m + q] <= gap[1]; };
        for (int64_t a = 0; a < m; ++a) {
            if (!sky.allowed(spot[0], a)) continue;
            for (int64_t b = 0; b < m; ++b) {
                if (b == a || !sky.allowed(spot[1], b) || !fits(g01, a, b)) continue;
                for (int64_t c = 0; c < m; ++c) {
                    if (c == a || c == b || !sky.allowed(spot[2], c) || !fits(g12, b, c) || !fits(g02, a, c)) continue;
                    if (solved++ >= most) return kept;
                    for (int i = 0; i < 3; ++i) x[0][i] = sky.x_in_world(a, i), x[1][i] = sky.x_in_world(b, i), x[2][i] = sky.x_in_world(c, i);
                    const int count = three_point_poses(o, d, x, nearest, farthest, R, t);
                    for (int s = 0; s < count; ++s) {
                        const double score = sky.consensus(R[s], t[s], match.data, best);
                        if (match[spot[0]] != a || match[spot[1]] != b || match[spot[2]] != c) continue;
                        int64_t named = 0;
                        for (int64_t e = 0; e < n; ++e) named += match[e] >= 0;
                        most_named = larger(most_named, named);
                        kept = out.keep(R[s], t[s], score, match.data, named, kept);
                    }
                }
            }
        }
    }
    return kept;
}

}  // namespace
