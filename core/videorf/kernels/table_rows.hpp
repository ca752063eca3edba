// SPDX-License-Identifier: GPL-3.0-or-later
// Adam and noise, row by row. Included once by each width's translation unit, in a namespace of its own.
#pragma once

#include <cmath>

#include "rows_simd.hpp"
#include "tables.hpp"

namespace holoreel {
namespace HOLOREEL_NAMESPACE {

using namespace videorf;

// Rows of `channels` values in vectors of C: the lanes behind them hold anything.
template <int C, bool kWhole> struct Rows {
    using Row = typename RowOf<C>::type;
    int channels;

    HOLOREEL_INLINE_MEMBER Row load(const float* table, int64_t row) const { return load_one(table + row * width()); }
    HOLOREEL_INLINE_MEMBER Row load_one(const float* p) const {
        if (kWhole) return load_row<C>(p);
        Row row = {};
        std::memcpy(&row, p, sizeof(float) * channels);
        return row;
    }
    HOLOREEL_INLINE_MEMBER void store(float* table, int64_t row, Row value) const {
        std::memcpy(table + row * width(), &value, sizeof(float) * width());
    }
    HOLOREEL_INLINE_MEMBER int width() const { return kWhole ? C : channels; }
};

template <class Row> HOLOREEL_INLINE Row held(Row x, Row low, Row high) {
    const Row above = x < low ? low : x;
    return above > high ? high : above;
}

template <int C, bool kWhole> void moments_of_rows(const VideorfStep& s, int64_t first, int64_t last) {
    using Row = typename RowOf<C>::type;
    const Rows<C, kWhole> rows{s.channels};
    const double count = static_cast<double>(s.rows);
    const Row zero = {}, one = zero + 1.0f, step = rows.load_one(s.step), per_step = one / step;
    const Row temporal = static_cast<float>(s.temporal / count) * per_step;
    const float beta1 = static_cast<float>(s.beta1), rest1 = static_cast<float>(1 - s.beta1);
    const float beta2 = static_cast<float>(s.beta2), rest2 = static_cast<float>(1 - s.beta2);
    float weights[4];
    for (int kind = 0; kind < 4; kind++) weights[kind] = static_cast<float>(s.weights[kind] / count);
    const bool with_space = s.neighbors > 0 && (weights[0] != 0 || weights[1] != 0 || weights[2] != 0 || weights[3] != 0);
    const bool with_time = s.temporal != 0 && s.previous;
    for (int64_t row = first; row < last; row++) {
        const Row here = rows.load(s.values, row);
        Row total = rows.load(s.gradient, row);
        if (with_space) {
            Row slope = zero;
            for (int k = 0; k < s.neighbors; k++) {
                const Row there = rows.load(s.values, s.near[row * s.neighbors + k]);
                slope += weights[s.kinds[row * s.neighbors + k] & 3] * held((here - there) * per_step, -one, one);
            }
            total += per_step * slope;
        }
        if (with_time) total += temporal * held((here - rows.load(s.previous, row)) * per_step, -one, one);
        rows.store(s.mean, row, beta1 * rows.load(s.mean, row) + rest1 * total);
        rows.store(s.square, row, beta2 * rows.load(s.square, row) + rest2 * (total * total));
    }
}

template <int C, bool kWhole> void move_rows(const VideorfStep& s, int64_t first, int64_t last) {
    using Row = typename RowOf<C>::type;
    const Rows<C, kWhole> rows{s.channels};
    const double count = static_cast<double>(s.count);
    const float unbias = static_cast<float>(1 / std::sqrt(1 - std::pow(s.beta2, count)));
    const float epsilon = static_cast<float>(s.epsilon);
    const Row rates = rows.load_one(s.rates) * static_cast<float>(1 / (1 - std::pow(s.beta1, count)));
    const Row low = rows.load_one(s.low), high = rows.load_one(s.high);
    for (int64_t row = first; row < last; row++) {
        Row root = rows.load(s.square, row);
        for (int c = 0; c < C; c++) root[c] = std::sqrt(root[c]);
        const Row moved = rows.load(s.values, row) - rates * rows.load(s.mean, row) / (root * unbias + epsilon);
        rows.store(s.values, row, held(moved, low, high));
    }
}

// The numbers are Wellons' "lowbias32" of their place in the table: they hang on nothing else.
template <int C, bool kWhole>
void noise_rows(const float* values, const float* step, int32_t channels, uint32_t key, int64_t first, int64_t last,
                float* out) {
    if (kWhole) channels = C;
    for (int64_t row = first; row < last; row++) {
        const uint32_t at = static_cast<uint32_t>(row * channels);
        for (int c = 0; c < channels; c++) {
            uint32_t x = (at + static_cast<uint32_t>(c)) * 0x9E3779B9u + key;
            x = (x ^ x >> 16) * 0x7FEB352Du;
            x = (x ^ x >> 15) * 0x846CA68Bu;
            x ^= x >> 16;
            const float share = (static_cast<float>(static_cast<int32_t>(x >> 8)) + 0.5f) * (1.0f / (1 << 24)) - 0.5f;
            out[row * channels + c] = values[row * channels + c] + step[c] * share;
        }
    }
}

template <int C, bool kWhole> const TableKernels* table_kernels_of() {
    static const TableKernels kernels = {moments_of_rows<C, kWhole>, move_rows<C, kWhole>, noise_rows<C, kWhole>};
    return &kernels;
}

static const TableKernels* tables_of(int channels) {
    if (channels <= 4) return channels == 4 ? table_kernels_of<4, true>() : table_kernels_of<4, false>();
    if (channels <= 8) return channels == 8 ? table_kernels_of<8, true>() : table_kernels_of<8, false>();
    return channels == 16 ? table_kernels_of<16, true>() : table_kernels_of<16, false>();
}

}  // namespace HOLOREEL_NAMESPACE
}  // namespace holoreel
