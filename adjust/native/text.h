// Rows of a table of numbers as text.
#pragma once
#include "vectors.h"

namespace {

typedef In<uint8_t, 1> Bytes;

constexpr int64_t LONGEST = 27;  // characters of a number and its comma: one below LARGEST with a sign, a point, decimals
constexpr double LARGEST = 1e17;

constexpr auto POWERS_OF_TEN = [] {
    std::array<uint64_t, 20> out{1};
    for (size_t i = 1; i < out.size(); ++i) out[i] = 10 * out[i - 1];
    return out;
}();
constexpr auto TWO_DIGITS = [] {
    std::array<uint8_t, 200> out{};
    for (size_t i = 0; i < out.size(); ++i) out[i] = uint8_t('0' + (i % 2 ? i / 2 % 10 : i / 20));
    return out;
}();

// Decimal digits of x, none of zero.
inline int64_t n_digits(uint64_t x) {
    const int64_t least = (std::bit_width(x) * 1233) >> 12;  // 1233 / 4096 is just above log10(2)
    return least + (x >= POWERS_OF_TEN[size_t(least)]);
}

// The n digits of x, zeros in front where it has fewer, with a point after so many of them where some follow.
inline uint8_t *with_point(uint64_t x, int64_t n, int64_t before, uint8_t *out) {
    const int64_t shift = before < n;  // to its place once the digits stand
    int64_t i = n + shift;
    for (; i >= 2 + shift; i -= 2, x /= 100) std::memcpy(out + i - 2, TWO_DIGITS.data() + 2 * (x % 100), 2);
    if (i > shift) out[shift] = uint8_t('0' + x % 10);
    if (shift == 0) return out + n;
    for (int64_t k = 0; k < before; ++k) out[k] = out[k + 1];
    out[before] = '.';
    return out + n + 1;
}

// x with so many decimals, the nearest, the even one of two; nothing where it is not finite. power: 10^decimals.
inline uint8_t *decimal_text(double x, double power, int64_t decimals, uint8_t *out) {
    const double size = magnitude(x) * power;
    if (!(size >= 0.0 && size <= LARGEST)) return out;
    const uint64_t whole = uint64_t(std::nearbyint(size));
    if (x < 0.0 && whole > 0) *out++ = '-';
    const int64_t n = larger(n_digits(whole), decimals + 1);
    return with_point(whole, n, n - decimals, out);
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

// A number as digits * 10^exponent.
struct Decimal {
    uint64_t digits;
    int64_t exponent;
};

constexpr int64_t LEAST_POWER = -292, POWERS = 617;  // of ten, which the doubles need

// floor(log2(10^e)) and floor(log10(2^e)), or of 3/4 of it, for the exponents of doubles.
inline int64_t log2_of_power_of_ten(int64_t e) { return (e * 1741647) >> 19; }
inline int64_t log10_of_power_of_two(int64_t e, bool three_quarters) { return (e * 1262611 - (three_quarters ? 524031 : 0)) >> 22; }

// floor(c g / 2^128), its last bit set where something was cut off; g is the power of ten, rounded up in its last bit.
inline uint64_t scaled(uint64_t high, uint64_t low, uint64_t c) {
    __extension__ typedef unsigned __int128 Wide;
    const Wide y = Wide(high) * c + uint64_t((Wide(low) * c) >> 64);
    return uint64_t(y >> 64) | uint64_t(uint64_t(y) > 1);
}

// The shortest decimal that is read as the positive x again, of those the nearest: Giulietti, The Schubfach way to render
// doubles (2020). powers: the upper and lower 64 bits of 10^e from LEAST_POWER on, 128 bits of each.
inline Decimal shortest(double x, In<int64_t, 2> powers) {
    const uint64_t bits = std::bit_cast<uint64_t>(x), fraction = bits & ((uint64_t(1) << 52) - 1), biased = bits >> 52;
    const uint64_t c = biased ? fraction | uint64_t(1) << 52 : fraction;
    const int64_t q = int64_t(biased ? biased : 1) - 1075;
    const bool uneven = fraction == 0 && biased > 1;  // the next smaller double is nearer than the next larger
    const int64_t k = log10_of_power_of_two(q, uneven), h = q + log2_of_power_of_ten(-k) + 1;
    const uint64_t high = uint64_t(powers(-k - LEAST_POWER, 0)), low = uint64_t(powers(-k - LEAST_POWER, 1));
    const uint64_t v = scaled(high, low, (4 * c) << h), odd = c & 1;  // four times x / 10^k
    const uint64_t lower = scaled(high, low, (4 * c - (uneven ? 1 : 2)) << h) + odd, upper = scaled(high, low, (4 * c + 2) << h) - odd;
    const uint64_t s = v / 4, tens = s / 10;
    if (s >= 10) {
        const bool below = lower <= 40 * tens, above = 40 * tens + 40 <= upper;
        if (below != above) return {tens + above, k + 1};
    }
    const bool below = lower <= 4 * s, above = 4 * s + 4 <= upper;
    if (below != above) return {s + above, k};
    const uint64_t middle = 4 * s + 2;
    return {s + (v > middle || (v == middle && (s & 1))), k};
}

constexpr int64_t WHOLE = 17;    // significant digits that no double needs more than
constexpr int64_t LONGEST_NUMBER = 24;  // characters: a sign, 17 digits, a point, an exponent

// x with at most so many significant digits as Python writes it: with WHOLE of them like repr, else like "%.*g".
inline uint8_t *significant_text(double x, int64_t significant, In<int64_t, 2> powers, uint8_t *out) {
    if (std::signbit(x)) *out++ = '-', x = -x;
    Decimal found = x == 0.0 ? Decimal{0, 0} : shortest(x, powers);
    int64_t n = n_digits(found.digits);
    if (n > significant) {
        const uint64_t unit = POWERS_OF_TEN[size_t(n - significant)];
        const uint64_t kept = found.digits / unit, rest = found.digits % unit;
        found = {kept + (2 * rest > unit || (2 * rest == unit && (kept & 1))), found.exponent + n - significant};
    }
    for (; found.digits > 0 && found.digits % 10 == 0; found.digits /= 10) ++found.exponent;
    n = larger(n_digits(found.digits), int64_t(1));
    const int64_t before = x == 0.0 ? 1 : n + found.exponent;  // digits before the point
    const bool by_power = before < -3 || before > (significant == WHOLE ? 16 : significant);
    const int64_t point = by_power ? 1 : before;
    if (point <= 0) {
        *out++ = '0', *out++ = '.';
        for (int64_t i = point; i < 0; ++i) *out++ = '0';
    }
    out = with_point(found.digits, n, point > 0 ? point : n, out);
    for (int64_t i = n; i < point; ++i) *out++ = '0';
    if (!by_power) {
        if (significant == WHOLE && n <= point) *out++ = '.', *out++ = '0';
        return out;
    }
    const int64_t power = before - 1, size = power < 0 ? -power : power;
    *out++ = 'e', *out++ = power < 0 ? '-' : '+';
    if (size >= 100) *out++ = uint8_t('0' + size / 100);
    *out++ = uint8_t('0' + size / 10 % 10), *out++ = uint8_t('0' + size % 10);
    return out;
}

enum class Part : int64_t { text, word, numbers };

// Records of one form as text: for each row the parts (kind, which) in turn: words[which]; the word that column `which` of
// the row names; its next `which` values with ", " between them, words[0] for what is not finite. Ends of the rows (n,); the
// length of all, -1 where the room is too small.
inline int64_t record_rows(Bytes words, Ints ptr, In<int64_t, 2> word, In<double, 2> values, In<int64_t, 2> parts, int64_t significant,
                           In<int64_t, 2> powers, Out<int64_t, 1> ends, Out<uint8_t, 1> out) {
    uint8_t *at = out.data;
    const uint8_t *const end = out.data + out.n[0];
    const int64_t room = larger(LONGEST_NUMBER, ptr[1] - ptr[0]) + 2;
    const auto copied = [&](int64_t i) {
        const int64_t size = ptr[i + 1] - ptr[i];
        if (size > end - at) return false;
        std::memcpy(at, words.data + ptr[i], size_t(size));
        at += size;
        return true;
    };
    for (int64_t row = 0; row < ends.n[0]; ++row) {
        for (int64_t p = 0, column = 0; p < parts.n[0]; ++p) {
            const Part kind = Part(parts(p, 0));
            const int64_t which = parts(p, 1);
            if (kind != Part::numbers) {
                if (!copied(kind == Part::text ? which : word(row, which))) return -1;
                continue;
            }
            if (which * room > end - at) return -1;
            for (int64_t i = 0; i < which; ++i, ++column) {
                if (i > 0) *at++ = ',', *at++ = ' ';
                const double x = values(row, column);
                if (magnitude(x) < __builtin_inf()) at = significant_text(x, significant, powers, at);
                else copied(0);
            }
        }
        ends.data[row] = at - out.data;
    }
    return at - out.data;
}

}  // namespace
