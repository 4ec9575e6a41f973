// Chains of poses and their derivatives by every link; see adjust.frames.chains.
#pragma once
#include "vectors.h"

namespace {

// R (B, 3, 3), t (B, 3) of all chains, C (links, 6, 6): Ad of the inverse of what follows a link, or of minus that and itself
// where the link is inverted (Sola, Deray and Atchuthan 2018, section II.G).
inline void evaluate_chains(In<double, 3> slot_R, In<double, 2> slot_t, Ints ptr, Ints slot, In<bool, 1> inverse, Out<double, 3> R, Out<double, 2> t,
                            Out<double, 3> C) {
    for (int64_t b = 0; b + 1 < ptr.n[0]; ++b) {
        Mat turn = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, next;
        Vec shift = {}, moved;
        for (int64_t link = ptr[b + 1] - 1; link >= ptr[b]; --link) {
            const auto A = slot_R[slot[link]];
            const auto a = slot_t[slot[link]];
            const bool back = inverse[link];
            for (int i = 0; i < 3; ++i) {
                moved[i] = back ? 0.0 : a[i];
                for (int k = 0; k < 3; ++k) moved[i] += back ? A(k, i) * (shift[k] - a[k]) : A(i, k) * shift[k];
                for (int j = 0; j < 3; ++j) {
                    next[i][j] = 0.0;
                    for (int k = 0; k < 3; ++k) next[i][j] += (back ? A(k, i) : A(i, k)) * turn[k][j];
                }
            }
            const Mat &T = back ? next : turn;
            const Vec &s = back ? moved : shift;
            const double sign = back ? -1.0 : 1.0;
            for (int i = 0; i < 3; ++i) {  // -T' [s]x has the rows s x (column of T)
                const int j = (i + 1) % 3, k = (i + 2) % 3;
                for (int c = 0; c < 3; ++c) {
                    C(link, c, i) = C(link, 3 + c, 3 + i) = sign * T[i][c], C(link, c, 3 + i) = 0.0;
                    C(link, 3 + c, i) = sign * (s[j] * T[k][c] - s[k] * T[j][c]);
                }
            }
            std::memcpy(turn, next, sizeof turn);
            std::memcpy(shift, moved, sizeof shift);
        }
        std::memcpy(&R(b, 0, 0), turn, sizeof turn);
        std::memcpy(&t(b, 0), shift, sizeof shift);
    }
}

}  // namespace
