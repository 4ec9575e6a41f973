// Camera poses of single views, refined and judged by the angles between rays and points; see adjust.start.closed_forms.views.
#pragma once
#include "dense.h"
#include "vectors.h"

namespace {

constexpr double ROBUST = 3.0;   // times the median offset: where Cauchy's weight is a half
constexpr double ENOUGH = 1e-7;  // share of the square sum: what a further step could take off is far less
constexpr double BEHIND = 1e3;   // offset of a point behind the camera, more than any in front can be
constexpr int VIEW_CHUNK = 64;   // points whose rows are squared together

// Views of points x on unit rays, one after the other by ptr; pose k is one of view of[k].
struct Views {
    explicit Views(Reader &r) : of(r), ptr(r), x(r), rays(r) {}
    Ints of, ptr;
    In<double, 2> x, rays;

    int64_t first(int64_t k) const { return ptr[of[k]]; }
    int64_t size(int64_t k) const { return ptr[of[k] + 1] - first(k); }
};

// The first of n numbers, put in another order, for which `first` holds; how many. No branch: which way each goes is chance.
template <class F> inline int64_t parted(double *a, int64_t n, F &&first) {
    int64_t m = 0;
    for (int64_t i = 0; i < n; ++i) {
        const double x = a[i];
        a[i] = a[m], a[m] = x;
        m += first(x);
    }
    return m;
}
// The k-th smallest, from 0, of n numbers, which are put in another order: none before k is larger (Hoare, Algorithm 65:
// FIND, Comm. ACM 4(7), 1961).
inline double selected(double *a, int64_t n, int64_t k) {
    while (n > 1) {
        const double x = a[0], y = a[n / 2], z = a[n - 1], pivot = larger(smaller(x, y), smaller(larger(x, y), z));
        const int64_t below = parted(a, n, [&](double v) { return v < pivot; });
        if (k < below) {
            n = below;
            continue;
        }
        const int64_t upto = below + parted(a + below, n - below, [&](double v) { return !(pivot < v); });
        if (k < upto) return pivot;
        a += upto, n -= upto, k -= upto;
    }
    return *a;
}
// The median of n numbers, at least one, which are put in another order.
inline double median(double *a, int64_t n) {
    const double upper = selected(a, n, n / 2);
    if (n % 2) return upper;
    double lower = a[0];
    for (int64_t i = 1; i < n / 2; ++i) lower = larger(lower, a[i]);
    return 0.5 * (lower + upper);
}

// W points of a view in the camera, from the j-th on: depths along their rays and squares of the distances from these.
struct Seen {
    V depth, across2;

    Seen(In<double, 2> pose, const Views &v, int64_t j, int64_t left) {
        V x[3], ray[3], p[3];
        columns(&v.x(j, 0), left, x), columns(&v.rays(j, 0), left, ray);
        for (int a = 0; a < 3; ++a) p[a] = pose(a, 0) * x[0] + pose(a, 1) * x[1] + pose(a, 2) * x[2] + pose(a, 3);
        depth = p[0] * ray[0] + p[1] * ray[1] + p[2] * ray[2], across2 = V{};
        for (int a = 0; a < 3; ++a) {
            const int b = (a + 1) % 3, c = (a + 2) % 3;
            const V across = p[b] * ray[c] - p[c] * ray[b];
            across2 += across * across;
        }
    }
};

// Of each listed pose the rms offset of its points, rad, and whether all lie in front.
inline void errors_of_views(Ints which, const Views &v, In<double, 3> poses, Out<double, 1> rms, Out<bool, 1> in_front) {
    for (int64_t i = 0; i < which.n[0]; ++i) {
        const int64_t k = which[i], first = v.first(k), n = v.size(k);
        V total = V{}, behind = V{};
        for (int64_t j = 0; j < n; j += W) {
            const Seen s(poses[k], v, first + j, n - j);
            const V depth = larger(magnitude(s.depth), all<V>(1e-12));
            behind = s.depth > 0.0 ? behind : all<V>(1.0);
            total += first_lanes(n - j) * (s.across2 / (depth * depth));
        }
        rms.data[k] = root(sum(total) / double(n));
        in_front.data[k] = sum(behind) == 0.0;
    }
}

// Tangents of the angles between rays and points of each listed view, infinite for points behind, and their medians.
// work: room for the largest view.
inline void offsets_of_views(Ints which, const Views &v, In<double, 3> poses, Out<double, 1> out, Out<double, 1> medians, Out<double, 1> work) {
    for (int64_t i = 0; i < which.n[0]; ++i) {
        const int64_t k = which[i], first = v.first(k), n = v.size(k);
        if (n == 0) continue;
        for (int64_t j = 0; j < n; j += W) {
            const Seen s(poses[k], v, first + j, n - j);
            const V depth = larger(s.depth, all<V>(1e-12)), offset = s.depth > 0.0 ? root(s.across2 / (depth * depth)) : all<V>(__builtin_inf());
            store_lanes(&out.data[first + j], n - j, offset), store_lanes(&work.data[j], n - j, offset);
        }
        medians.data[k] = median(work.data, n);
    }
}

// The points of a view side by side, in whole vectors: the last one again behind the end, where it has no weight.
struct Stack {
    enum Row { X = 0, RAY = 3, ACROSS = 6, WEIGHT = 12, SIZE = 13, STATE = 14, ROWS = 26 };
    double *work;
    int64_t n, full;

    double *row(int i) const { return work + i * full; }
    V at(int i, int64_t p) const { return load(row(i) + p); }

    Stack(double *room, const Views &v, int64_t k) : work(room), n(v.size(k)), full((n + W - 1) / W * W) {
        for (int64_t i = 0; i < full; ++i) {
            const int64_t j = v.first(k) + smaller(i, n - 1);
            for (int a = 0; a < 3; ++a) row(X + a)[i] = v.x(j, a), row(RAY + a)[i] = v.rays(j, a);
            row(WEIGHT)[i] = i < n;
        }
        // two unit vectors across each ray (Duff et al., J. Comput. Graph. Techn. 6(1), 2017)
        for (int64_t p = 0; p < full; p += W) {
            const V x = at(RAY, p), y = at(RAY + 1, p), z = at(RAY + 2, p), one = all<V>(1.0);
            const V sign = z >= 0.0 ? one : -one, a = -1.0 / (sign + z), b = x * y * a;
            const V both[6] = {1.0 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y};
            for (int i = 0; i < 6; ++i) store(row(ACROSS + i) + p, both[i]);
        }
    }

    // Points (3) in the camera, offsets (2) rad across their rays and depth along them, to the rows from `state` on; the
    // weighted square sum of the offsets.
    double offsets(const Pose &pose, int state) const {
        V total = V{};
        for (int64_t p = 0; p < full; p += W) {
            const V x = at(X, p), y = at(X + 1, p), z = at(X + 2, p);
            V q[3], depth = V{};
            for (int a = 0; a < 3; ++a) {
                q[a] = pose[a][0] * x + pose[a][1] * y + pose[a][2] * z + pose[a][3];
                depth += q[a] * at(RAY + a, p);
                store(row(state + a) + p, q[a]);
            }
            const V inverse = 1.0 / (depth > 1e-12 ? depth : all<V>(1e-12));
            for (int k = 0; k < 2; ++k) {
                const int c = ACROSS + 3 * k;
                V r = (at(c, p) * q[0] + at(c + 1, p) * q[1] + at(c + 2, p) * q[2]) * inverse;
                r = depth > 0.0 ? r : all<V>(BEHIND);
                store(row(state + 3 + k) + p, r);
                total += at(WEIGHT, p) * r * r;
            }
            store(row(state + 5) + p, depth);
        }
        return sum(total);
    }

    // Cauchy's weights, by the offsets of a state.
    void weigh(int state) const {
        const auto square = [&](int64_t p) { return at(state + 3, p) * at(state + 3, p) + at(state + 4, p) * at(state + 4, p); };
        for (int64_t p = 0; p < full; p += W) store(row(SIZE) + p, square(p));
        const double limit = larger(ROBUST * ROBUST * median(row(SIZE), n), 1e-24);
        for (int64_t p = 0; p < full; p += W) store(row(WEIGHT) + p, first_lanes(n - p) * (limit / (limit + square(p))));
    }

    // N (7, 7; upper) of the step's six and the offsets: a turn, then a shift, in the camera's frame.
    void normal_equations(int state, double (&N)[7][7]) const {
        alignas(64) double J[7][2 * VIEW_CHUNK];
        std::memset(N, 0, sizeof N);
        for (int64_t lo = 0; lo < full; lo += VIEW_CHUNK) {
            const int m = int(smaller(full - lo, int64_t(VIEW_CHUNK)));
            for (int i = 0; i < m; i += W) {
                const int64_t p = lo + i;
                const V q[3] = {at(state, p), at(state + 1, p), at(state + 2, p)}, half = root(at(WEIGHT, p));
                const V scale = half / at(state + 5, p);
                for (int k = 0; k < 2; ++k) {
                    const V r = at(state + 3 + k, p);
                    V j[3];
                    for (int a = 0; a < 3; ++a) j[a] = (at(ACROSS + 3 * k + a, p) - r * at(RAY + a, p)) * scale;
                    for (int a = 0; a < 3; ++a) {  // the derivative by a turn is -j [p]x = p x j
                        const int b = (a + 1) % 3, c = (a + 2) % 3;
                        store(&J[a][k * m + i], q[b] * j[c] - q[c] * j[b]);
                        store(&J[3 + a][k * m + i], j[a]);
                    }
                    store(&J[6][k * m + i], half * r);
                }
            }
            add_gram(J, 7, 2 * m, N);
        }
    }
};

// The step (6) of normal equations damped by a share of their diagonal; false where there is none.
inline bool damped_step(const double (&N)[7][7], double damping, double *step) {
    double A[6][6], most = 0.0;
    for (int i = 0; i < 6; ++i) most = larger(most, N[i][i]);
    for (int i = 0; i < 6; ++i) {
        for (int j = 0; j < i; ++j) A[i][j] = N[j][i];
        A[i][i] = N[i][i] + damping * N[i][i] + 1e-14 * most;
        step[i] = -N[i][6];
    }
    if (!cholesky(&A[0][0], 6, 6)) return false;
    forward_solve(&A[0][0], 6, 6, step, 1);
    backward_solve(&A[0][0], 6, 6, step, 1);
    return true;
}
// (Exp(step[:3]), step[3:]) * pose.
inline void moved(const Pose &pose, const double *step, Pose &out) {
    Mat turn;
    turn_by(step, turn);
    for (int j = 0; j < 4; ++j) {
        for (int i = 0; i < 3; ++i) out[i][j] = turn[i][0] * pose[0][j] + turn[i][1] * pose[1][j] + turn[i][2] * pose[2][j];
        out[3][j] = pose[3][j];
    }
    for (int i = 0; i < 3; ++i) out[i][3] += step[3 + i];
}

// Each listed pose by Levenberg-Marquardt on the offsets across its rays, in place; it stays where a step does not lower
// its error. work: 26 numbers for every point of the largest view, filled up to whole vectors of 8.
inline void refine_views(Ints which, const Views &v, int64_t iterations, int64_t robust, Out<double, 3> poses, Out<double, 1> work) {
    for (int64_t i = 0; i < which.n[0]; ++i) {
        const int64_t k = which[i];
        if (v.size(k) == 0) continue;
        const Stack stack(work.data, v, k);
        int now = Stack::STATE, next = Stack::STATE + 6;
        Pose pose, trial;
        double N[7][7], step[6], damping = 1e-6;
        copy_pose(poses[k], pose);
        stack.offsets(pose, now);
        bool stayed = false;
        for (int64_t n = 0; n < iterations; ++n) {
            if (robust && !stayed) stack.weigh(now);
            if (!stayed) stack.normal_equations(now, N);
            double sum = 0.0;
            const bool possible = damped_step(N, damping, step);
            if (possible) moved(pose, step, trial), sum = stack.offsets(trial, next);
            stayed = !(possible && sum < N[6][6]);
            if (stayed) {
                damping *= 30.0;
                if (damping > 1e3) break;  // a step that small lowers nothing any more
                continue;
            }
            damping *= 0.1;
            std::swap(now, next);
            std::memcpy(pose, trial, sizeof pose);
            if (!(N[6][6] - sum > ENOUGH * N[6][6])) break;
        }
        std::memcpy(&poses(k, 0, 0), pose, sizeof pose);
    }
}

}  // namespace
