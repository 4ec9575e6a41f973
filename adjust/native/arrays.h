// What Python gives: views of NumPy's arrays with their shapes, read one after the other from a list of arguments.
#pragma once
#include <array>
#include <bit>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <tuple>
#include <type_traits>
#include <utility>

namespace {  // one copy for every instruction set: nothing here may be shared between translation units

#ifdef CHECKED  // set by the debug build alone: an index outside its array stops the program
constexpr bool checked = true;
[[noreturn]] inline void outside(int64_t at, int64_t n) {
    std::fprintf(stderr, "index %lld is outside an array of %lld\n", static_cast<long long>(at), static_cast<long long>(n));
    __builtin_trap();
}
#else
constexpr bool checked = false;
[[noreturn]] inline void outside(int64_t, int64_t) { __builtin_trap(); }
#endif

struct Argument {
    void *data;  // of an array; the bits of a scalar
    int64_t shape[4];
};

// Reads arguments in order; one with a text writes down of which kind they have to be instead.
struct Reader {
    const Argument *next;
    char *described;

    [[gnu::noinline]] Argument take(char kind, int dimensions) {
        if (!described) return *next++;
        *described++ = kind;
        *described++ = char('0' + dimensions);
        *described = 0;
        return {};
    }
};

template <class T> constexpr char kind_of() {
    using U = std::remove_const_t<T>;
    constexpr char kind = std::is_same_v<U, double> ? 'f' : std::is_same_v<U, int64_t> ? 'i' : std::is_same_v<U, float> ? 's'
                          : std::is_same_v<U, uint8_t> ? 'u' : std::is_same_v<U, bool> ? 'b' : '?';
    static_assert(kind != '?');
    return std::is_const_v<T> ? kind : char(kind - 'a' + 'A');  // capital letters are written to
}

// An array of N dimensions, row by row.
template <class T, int N> struct Array {
    T *data = nullptr;
    int64_t n[N] = {};

    Array() = default;
    Array(T *at, const std::array<int64_t, N> &shape) : data(at) {
        for (int i = 0; i < N; ++i) n[i] = shape[i];
    }
    explicit Array(Reader &reader) {
        const Argument given = reader.take(kind_of<T>(), N);
        data = static_cast<T *>(given.data);
        for (int i = 0; i < N; ++i) n[i] = given.shape[i];
    }
    operator Array<const T, N>() const {
        Array<const T, N> o;
        o.data = data;
        for (int i = 0; i < N; ++i) o.n[i] = n[i];
        return o;
    }
    template <class... I> T &operator()(I... index) const {
        static_assert(sizeof...(I) == N);
        const int64_t at[] = {int64_t(index)...};
        int64_t offset = 0;
        for (int i = 0; i < N; ++i) {
            if (checked && (at[i] < 0 || at[i] >= n[i])) outside(at[i], n[i]);
            offset = offset * n[i] + at[i];
        }
        return data[offset];
    }
    // Part i along the first dimension.
    auto operator[](int64_t i) const {
        if (checked && (i < 0 || i >= n[0])) outside(i, n[0]);
        if constexpr (N == 1) {
            return data[i];
        } else {
            Array<T, N - 1> o;
            int64_t size = 1;
            for (int k = 1; k < N; ++k) o.n[k - 1] = n[k], size *= n[k];
            o.data = data + i * size;
            return o;
        }
    }
};
template <class T, int N> using In = Array<const T, N>;
template <class T, int N> using Out = Array<T, N>;
using Ints = In<int64_t, 1>;
using Vector = In<double, 1>;

template <class T> T taken(Reader &reader) {
    if constexpr (std::is_same_v<T, int64_t> || std::is_same_v<T, double>) {
        const Argument given = reader.take(std::is_same_v<T, double> ? 'd' : 'n', 0);
        T value;
        std::memcpy(&value, &given.data, sizeof value);
        return value;
    } else {
        return T(reader);  // an array, or several in a structure
    }
}

struct Entry {
    const char *name;
    int64_t (*run)(const Argument *);
    void (*describe)(char *);
};

// The function F as Python calls it: with a list of arguments; its own parameters say of which kind each must be.
template <auto F> struct Bound;
template <class R, class... P, R (*F)(P...)> struct Bound<F> {
    struct Call {  // between its braces the arguments are read in order (a std::tuple of so many is slow to compile)
        int64_t result = 0;
        explicit Call(const std::remove_cvref_t<P> &...given) {
            R (*volatile called)(P...) = F;  // not inlined: behind all that is read here its loops would lack registers
            if constexpr (std::is_void_v<R>) called(given...);
            else result = int64_t(called(given...));
        }
    };
    static int64_t run(const Argument *arguments) {
        Reader reader{arguments, nullptr};
        return Call{taken<std::remove_cvref_t<P>>(reader)...}.result;
    }
    static void describe(char *out) {
        Reader reader{nullptr, out};
        *out = 0;
        (void(taken<std::remove_cvref_t<P>>(reader)), ...);
    }
};
template <auto F> constexpr Entry entry(const char *name) { return {name, Bound<F>::run, Bound<F>::describe}; }

inline int64_t smaller(int64_t a, int64_t b) { return a < b ? a : b; }
inline int64_t larger(int64_t a, int64_t b) { return a > b ? a : b; }
inline double smaller(double a, double b) { return a < b ? a : b; }
inline double larger(double a, double b) { return a > b ? a : b; }

}  // namespace
