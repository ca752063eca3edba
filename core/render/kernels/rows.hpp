// SPDX-License-Identifier: GPL-3.0-or-later
// Four Gaussians at once, in double precision: what is done per Gaussian is written in these vectors (an extension of GCC
// and Clang), and the compiler makes of them what the processor has.
#pragma once

#include <cmath>
#include <cstdint>

namespace holoreel {

constexpr int kRows = 4;
typedef double D __attribute__((vector_size(kRows * sizeof(double))));
typedef int64_t Mask __attribute__((vector_size(kRows * sizeof(int64_t))));  // all bits of a lane, or none

inline D all(double x) { return D{x, x, x, x}; }
inline bool any(Mask m) { return (m[0] | m[1] | m[2] | m[3]) != 0; }
inline Mask finite(D x) { return x - x == all(0.0); }
inline D clamp(D x, double low, double high) {
    x = x < all(low) ? all(low) : x;
    return x > all(high) ? all(high) : x;
}
inline D sqrt(D x) {
    for (int k = 0; k < kRows; k++) x[k] = __builtin_sqrt(x[k]);
    return x;
}

// e^x to the last bits or so, for x held in [-708, 709]; NaN stays NaN.
inline D exp(D x) {
    x = clamp(x, -708.0, 709.0);
    const D shifted = x * 1.4426950408889634 + 6755399441055744.0;  // the nearest integer n, in the lowest bits
    const D n = shifted - 6755399441055744.0;
    const D f = (x - n * 0.693147180369123816490) - n * 1.90821492927058770002e-10;
    D sum = all(1.0 / 479001600);
    constexpr double factors[] = {1.0 / 39916800, 1.0 / 3628800, 1.0 / 362880, 1.0 / 40320, 1.0 / 5040, 1.0 / 720,
                                  1.0 / 120,      1.0 / 24,      1.0 / 6,      1.0 / 2,     1.0,        1.0};
    for (double factor : factors) sum = sum * f + factor;
    return (D)((Mask)sum + ((Mask)shifted << 52));
}

// Up to four rows of the arrays; lanes beyond `count` repeat the last one.
struct RowSet {
    int64_t rows[kRows];
    int count;

    // The next of a list of row numbers that has `left` more.
    RowSet(const uint32_t* list, int64_t left) : count(left < kRows ? static_cast<int>(left) : kRows) {
        for (int lane = 0; lane < kRows; lane++) rows[lane] = list[lane < count ? lane : count - 1];
    }
    RowSet(int64_t first, int64_t end) : count(end - first < kRows ? static_cast<int>(end - first) : kRows) {
        for (int lane = 0; lane < kRows; lane++) rows[lane] = first + (lane < count ? lane : count - 1);
    }

    template <int K>
    void load(const float* array, D* out) const {
        const float *a = array + K * rows[0], *b = array + K * rows[1], *c = array + K * rows[2], *d = array + K * rows[3];
        for (int k = 0; k < K; k++) out[k] = D{a[k], b[k], c[k], d[k]};
    }
    // Writes the lanes in `wanted`, if there is an array.
    template <int K>
    void store(float* array, const D* values, Mask wanted) const {
        if (!array) return;
        for (int lane = 0; lane < count; lane++)
            if (wanted[lane])
                for (int k = 0; k < K; k++) array[K * rows[lane] + k] = static_cast<float>(values[k][lane]);
    }
};

}  // namespace holoreel
