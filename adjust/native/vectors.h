// Vectors of three, matrices of three by three and poses of four by four, as plain arrays.
#pragma once
#include "lanes.h"

namespace {

typedef double Vec[3];
typedef double Mat[3][3];
typedef double Pose[4][4];

inline double dot3(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline double distance(const double *a, const double *b) {
    const Vec d = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
    return root(dot3(d, d));
}
inline void cross3(const double *a, const double *b, double *out) {
    out[0] = a[1] * b[2] - a[2] * b[1], out[1] = a[2] * b[0] - a[0] * b[2], out[2] = a[0] * b[1] - a[1] * b[0];
}
inline void copy_pose(In<double, 2> from, Pose &to) { std::memcpy(to, from.data, sizeof to); }
// R' (x - t), R row by row with rows of ld numbers.
inline void into(const double *R, int ld, const double *t, int step, const double *x, double *out) {
    const Vec d = {x[0] - t[0], x[1] - t[step], x[2] - t[2 * step]};
    for (int a = 0; a < 3; ++a) out[a] = R[a] * d[0] + R[ld + a] * d[1] + R[2 * ld + a] * d[2];
}
// Element of the cross-product matrix of q.
inline double skew(const double *q, int i, int j) {
    if (i == j) return 0.0;
    return (j - i + 3) % 3 == 1 ? -q[3 - i - j] : q[3 - i - j];
}

// Exp(w) (Rodrigues).
inline void turn_by(const double *w, Mat &out) {
    const double square = dot3(w, w), angle = root(square);
    double a = 1.0 - square / 6.0, b = 0.5;
    if (angle > 1e-6) a = std::sin(angle) / angle, b = (1.0 - std::cos(angle)) / square;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) out[i][j] = a * skew(w, i, j) + b * w[i] * w[j] + (i == j ? 1.0 - b * square : 0.0);
}
// pose * (Exp(step[:3]), step[3:]).
inline void retracted(const Pose &pose, const double *step, Pose &out) {
    Mat turn;
    turn_by(step, turn);
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) out[i][j] = pose[i][0] * turn[0][j] + pose[i][1] * turn[1][j] + pose[i][2] * turn[2][j];
        out[i][3] = pose[i][3] + dot3(pose[i], step + 3);
        out[3][i] = 0.0;
    }
    out[3][3] = 1.0;
}
// Log(r), through the quaternion: exact up to half a turn.
inline void turn_of(const Mat &r, double *out) {
    // four multiples of the quaternion (w, x, y, z): that with the largest square is the sharpest
    double w = 1 + r[0][0] + r[1][1] + r[2][2], x = 1 + r[0][0] - r[1][1] - r[2][2];
    double y = 1 - r[0][0] + r[1][1] - r[2][2], z = 1 - r[0][0] - r[1][1] + r[2][2];
    const double d0 = r[2][1] - r[1][2], d1 = r[0][2] - r[2][0], d2 = r[1][0] - r[0][1];
    const double s0 = r[1][0] + r[0][1], s1 = r[0][2] + r[2][0], s2 = r[2][1] + r[1][2];
    if (w >= x && w >= y && w >= z) x = d0, y = d1, z = d2;
    else if (x >= y && x >= z) w = d0, y = s0, z = s1;
    else if (y >= z) w = d1, x = s0, z = s2;
    else w = d2, x = s1, y = s2;
    double size = root(w * w + x * x + y * y + z * z);
    if (w < 0) size = -size;
    w /= size, x /= size, y /= size, z /= size;
    const double sine = root(x * x + y * y + z * z), factor = sine < 1e-12 ? 2.0 : 2.0 * std::atan2(sine, w) / sine;
    out[0] = factor * x, out[1] = factor * y, out[2] = factor * z;
}
inline void turns_by(In<double, 2> w, Out<double, 3> out) {
    for (int64_t i = 0; i < w.n[0]; ++i) turn_by(&w(i, 0), *reinterpret_cast<Mat *>(&out(i, 0, 0)));
}
inline void turns_of(In<double, 3> r, Out<double, 2> out) {
    for (int64_t i = 0; i < r.n[0]; ++i) turn_of(*reinterpret_cast<const Mat *>(&r(i, 0, 0)), &out(i, 0));
}
// The step with retracted(a, step) = b.
inline void step_between(const Pose &a, const Pose &b, double *out) {
    Mat r;
    const Vec d = {b[0][3] - a[0][3], b[1][3] - a[1][3], b[2][3] - a[2][3]};
    for (int i = 0; i < 3; ++i) {
        out[3 + i] = a[0][i] * d[0] + a[1][i] * d[1] + a[2][i] * d[2];
        for (int j = 0; j < 3; ++j) r[i][j] = a[0][i] * b[0][j] + a[1][i] * b[1][j] + a[2][i] * b[2][j];
    }
    turn_of(r, out);
}
// Inverse of the right Jacobian of SO(3) (Chirikjian 2012, eq. 10.86): the derivative of Log(Exp(w) Exp(d)) by d at zero.
inline void turn_derivative(const double *w, Mat &out) {
    const double square = dot3(w, w), angle = root(square);
    const double beta = angle < 1e-4 ? 1.0 / 12.0 : 1.0 / square - (1.0 + std::cos(angle)) / (2.0 * angle * std::sin(angle));
    for (int i = 0; i < 3; ++i)  // beta [w]x [w]x = beta (w w' - w^2)
        for (int j = 0; j < 3; ++j) out[i][j] = 0.5 * skew(w, i, j) + beta * w[i] * w[j] + (i == j ? 1.0 - beta * square : 0.0);
}
// Derivative of step_between(a, retracted(b, d)) by d at zero, where step = step_between(a, b).
inline void step_derivative(const double *step, double (&out)[6][6]) {
    Mat turn, by_turn;
    turn_by(step, turn);
    turn_derivative(step, by_turn);
    std::memset(out, 0, sizeof out);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) out[i][j] = by_turn[i][j], out[3 + i][3 + j] = turn[i][j];
}

}  // namespace
