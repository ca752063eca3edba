// SPDX-License-Identifier: GPL-3.0-or-later
// Included once by each width's translation unit, in a namespace of its own. Loops over channels are written so that the compiler
// makes vectors of them where it knows how many there are; C = 0 takes any number.
#pragma once

#include <cmath>

#include "tables.hpp"

namespace holoreel {
namespace HOLOREEL_NAMESPACE {

using namespace videorf;

constexpr int kMaxChannels = 16;

static inline float held(float x, float low, float high) {
    const float above = x < low ? low : x;
    return above > high ? high : above;
}

template <int C> void moments_of_rows(const VideorfStep& s, int64_t first, int64_t last) {
    const int channels = C ? C : s.channels;
    float per_step[kMaxChannels], spatial[kMaxChannels], temporal[kMaxChannels];
    for (int c = 0; c < channels; c++) {
        per_step[c] = 1.0f / s.step[c];
        spatial[c] = static_cast<float>(s.spatial / (s.step[c] * static_cast<double>(s.rows)));
        temporal[c] = static_cast<float>(s.temporal / (s.step[c] * static_cast<double>(s.rows)));
    }
    const float beta1 = static_cast<float>(s.beta1), rest1 = static_cast<float>(1 - s.beta1);
    const float beta2 = static_cast<float>(s.beta2), rest2 = static_cast<float>(1 - s.beta2);
    const float at_seam = static_cast<float>(s.seam);
    const bool with_space = s.spatial != 0 && s.neighbors > 0, with_time = s.temporal != 0 && s.previous;
    for (int64_t row = first; row < last; row++) {
        const float* here = s.values + row * channels;
        float total[kMaxChannels];
        for (int c = 0; c < channels; c++) total[c] = s.gradient[row * channels + c];
        if (with_space) {
            float slope[kMaxChannels] = {};
            for (int k = 0; k < s.neighbors; k++) {
                const float* there = s.values + s.near[row * s.neighbors + k] * int64_t(channels);
                const float weight = s.seams[row] >> k & 1 ? at_seam : 1.0f;
                for (int c = 0; c < channels; c++) slope[c] += weight * held((here[c] - there[c]) * per_step[c], -1.0f, 1.0f);
            }
            for (int c = 0; c < channels; c++) total[c] += spatial[c] * slope[c];
        }
        if (with_time) {
            const float* before = s.previous + row * channels;
            for (int c = 0; c < channels; c++)
                total[c] += temporal[c] * held((here[c] - before[c]) * per_step[c], -1.0f, 1.0f);
        }
        float *mean = s.mean + row * channels, *square = s.square + row * channels;
        for (int c = 0; c < channels; c++) {
            mean[c] = beta1 * mean[c] + rest1 * total[c];
            square[c] = beta2 * square[c] + rest2 * (total[c] * total[c]);
        }
    }
}

template <int C> void move_rows(const VideorfStep& s, int64_t first, int64_t last) {
    const int channels = C ? C : s.channels;
    const double count = static_cast<double>(s.count);
    const float unbias = static_cast<float>(1 / std::sqrt(1 - std::pow(s.beta2, count)));
    const float epsilon = static_cast<float>(s.epsilon);
    float rates[kMaxChannels], low[kMaxChannels], high[kMaxChannels];
    for (int c = 0; c < channels; c++) {
        rates[c] = static_cast<float>(s.rates[c] / (1 - std::pow(s.beta1, count)));
        low[c] = s.low[c];
        high[c] = s.high[c];
    }
    for (int64_t row = first; row < last; row++) {
        float* values = s.values + row * channels;
        const float *mean = s.mean + row * channels, *square = s.square + row * channels;
        for (int c = 0; c < channels; c++)
            values[c] = held(values[c] - rates[c] * mean[c] / (std::sqrt(square[c]) * unbias + epsilon), low[c], high[c]);
    }
}

// The numbers are Wellons' "lowbias32" of their place in the table: they hang on nothing else.
template <int C>
void noise_rows(const float* rows, const float* step, int32_t channels, uint32_t key, int64_t first, int64_t last, float* out) {
    if (C) channels = C;
    float steps[kMaxChannels];
    for (int c = 0; c < channels; c++) steps[c] = step[c];
    for (int64_t row = first; row < last; row++) {
        const uint32_t at = static_cast<uint32_t>(row * channels);
        for (int c = 0; c < channels; c++) {
            uint32_t x = (at + static_cast<uint32_t>(c)) * 0x9E3779B9u + key;
            x = (x ^ x >> 16) * 0x7FEB352Du;
            x = (x ^ x >> 15) * 0x846CA68Bu;
            x ^= x >> 16;
            const float share = (static_cast<float>(static_cast<int32_t>(x >> 8)) + 0.5f) * (1.0f / (1 << 24)) - 0.5f;
            out[row * channels + c] = rows[row * channels + c] + steps[c] * share;
        }
    }
}

static const TableKernels* tables_of(int channels) {
    static const TableKernels any = {moments_of_rows<0>, move_rows<0>, noise_rows<0>};
    static const TableKernels four = {moments_of_rows<4>, move_rows<4>, noise_rows<4>};
    static const TableKernels eight = {moments_of_rows<8>, move_rows<8>, noise_rows<8>};
    static const TableKernels sixteen = {moments_of_rows<16>, move_rows<16>, noise_rows<16>};
    return channels == 4 ? &four : channels == 8 ? &eight : channels == 16 ? &sixteen : &any;
}

}  // namespace HOLOREEL_NAMESPACE
}  // namespace holoreel
