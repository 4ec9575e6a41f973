// Rows of a table of numbers as text.
#pragma once
#include "vectors.h"

namespace {

typedef In<uint8_t, 1> Bytes;

constexpr int64_t LONGEST = 27;  // characters of a number and its comma: one below LARGEST with a sign, a point, decimals
constexpr double LARGEST = 1e17;

// x with so many decimals, the nearest, the even one of two; nothing where it is not finite. power: 10^decimals.
inline uint8_t *decimal_text(double x, double power, int64_t decimals, uint8_t *out) {
    const double size = magnitude(x) * power;
    if (!(size >= 0.0 && size <= LARGEST)) return out;
    uint64_t whole = uint64_t(std::nearbyint(size));
    if (x < 0.0 && whole > 0) *out++ = '-';
    uint8_t digits[24];
    int64_t n = 0;
    for (; whole > 0 || n <= decimals; whole /= 10) digits[n++] = uint8_t('0' + whole % 10);
    for (; n > 0;) {
        if (n == decimals) *out++ = '.';
        *out++ = digits[--n];
    }
    return out;
}

// For each row the text of its block, that of its item, and its numbers, with commas between them; the length of all. Word
// i of a list is from ptr[i] to ptr[i + 1]. -1 where a number is too large for a fixed point, or the room too small.
inline int64_t number_rows(Bytes of_block, Ints block_ptr, Ints block, Bytes of_item, Ints item_ptr, Ints item, In<double, 2> values,
                           Vector power, Ints decimals, Out<uint8_t, 1> out) {
    uint8_t *at = out.data;
    const auto copy = [&](Bytes words, Ints ptr, int64_t i) {
        const int64_t n = ptr[i + 1] - ptr[i];
        std::memcpy(at, words.data + ptr[i], n);
        at += n;
    };
    const auto needed = [&](int64_t i) {
        return block_ptr[block[i] + 1] - block_ptr[block[i]] + item_ptr[item[i] + 1] - item_ptr[item[i]] + LONGEST * values.n[1] + 1;
    };
    for (int64_t i = 0; i < values.n[0]; ++i) {
        if (needed(i) > out.data + out.n[0] - at) return -1;
        copy(of_block, block_ptr, block[i]), copy(of_item, item_ptr, item[i]);
        for (int64_t j = 0; j < values.n[1]; ++j) {
            const double x = values(i, j), size = magnitude(x) * power[j];
            if (size > LARGEST && size < __builtin_inf()) return -1;
            *at++ = ',';
            at = decimal_text(x, power[j], decimals[j], at);
        }
        *at++ = '\n';
    }
    return at - out.data;
}

}  // namespace
