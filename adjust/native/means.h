// Robust means of rigid motions: the chordal mean of those that agree, reweighted until it stays.
#pragma once
#include "views.h"

namespace {

// Shift, and turn times ``lever``, added in squares: half of the turn has the sine |A - B| / sqrt(8) (Hartley et al.,
// IJCV 103, 2013, section 4).
inline double pose_distance(const double *a, const double *b, double lever) {
    double shift = 0.0, turn = 0.0;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) turn += (a[4 * i + j] - b[4 * i + j]) * (a[4 * i + j] - b[4 * i + j]);
        shift += (a[4 * i + 3] - b[4 * i + 3]) * (a[4 * i + 3] - b[4 * i + 3]);
    }
    const double angle = 2.0 * lever * std::asin(smaller(root(turn / 8.0), 1.0));
    return root(shift + angle * angle);
}

// The rotation nearest to m in the Frobenius norm, by the dominant quaternion (Davenport 1968; Horn, JOSA A 4, 1987).
inline void nearest_rotation(const Mat &m, Pose &out) {
    double K[4][4], values[4], U[4][4];
    const Vec axis = {m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]};
    const double trace = m[0][0] + m[1][1] + m[2][2];
    K[0][0] = trace;
    for (int i = 0; i < 3; ++i) {
        K[0][1 + i] = K[1 + i][0] = axis[i];
        for (int j = 0; j < 3; ++j) K[1 + i][1 + j] = m[i][j] + m[j][i] - (i == j ? trace : 0.0);
    }
    eigen(K, values, U);
    int best = 0;
    for (int i = 1; i < 4; ++i)
        if (values[i] > values[best]) best = i;
    const double w = U[0][best];
    const Vec q = {U[1][best], U[2][best], U[3][best]};
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) out[i][j] = 2.0 * (q[i] * q[j] + w * skew(q, i, j)) + (i == j ? w * w - dot3(q, q) : 0.0);
}

constexpr int MEAN_STEPS = 20;
constexpr double MEAN_SETTLED = 1e-4;  // of the scale: a further step tells nothing that the motions do

// Means (k,) of motions (n,), those of each by ptr (k + 1,), from the motions first (k,): Geman and McClure's weights at
// three times the median distance. member: (n,) numbers in order; of neighbours of equal number the nearest counts.
// nearest: (n,), work: (2, n), scratch.
inline void robust_means(In<double, 3> poses, Ints ptr, Ints member, Ints first, double lever, Out<double, 3> means, Out<int64_t, 1> nearest,
                         Out<double, 2> work) {
    double *away = work.data, *sorted = away + poses.n[0];
    for (int64_t k = 0; k < first.n[0]; ++k) {
        Pose mean, next = {{}, {}, {}, {0.0, 0.0, 0.0, 1.0}};
        std::memcpy(mean, &poses(first[k], 0, 0), sizeof mean);
        for (int step = 0; step < MEAN_STEPS; ++step) {
            int64_t n = 0;
            for (int64_t i = ptr[k]; i < ptr[k + 1]; ++i) {
                const double d = pose_distance(&poses(i, 0, 0), mean[0], lever);
                const bool other = i == ptr[k] || member[i] != member[i - 1];
                if (!other && d >= away[n - 1]) continue;
                n += other, away[n - 1] = d, nearest(n - 1) = i;
            }
            std::memcpy(sorted, away, sizeof(double) * n);
            const double scale = larger(3.0 * median(sorted, n), 1e-12);
            double sum = 0.0;
            Mat total = {};
            Vec shift = {};
            for (int64_t m = 0; m < n; ++m) {
                const double *pose = &poses(nearest[m], 0, 0), ratio = away[m] / scale, root = 1.0 / (1.0 + ratio * ratio), weight = root * root;
                sum += weight;
                for (int a = 0; a < 3; ++a) {
                    for (int b = 0; b < 3; ++b) total[a][b] += weight * pose[4 * a + b];
                    shift[a] += weight * pose[4 * a + 3];
                }
            }
            nearest_rotation(total, next);
            for (int a = 0; a < 3; ++a) next[a][3] = shift[a] / sum;
            const bool stays = pose_distance(next[0], mean[0], lever) < MEAN_SETTLED * scale;
            std::memcpy(mean, next, sizeof mean);
            if (stays) break;
        }
        std::memcpy(&means(k, 0, 0), mean, sizeof mean);
    }
}

}  // namespace
