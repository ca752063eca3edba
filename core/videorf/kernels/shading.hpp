// SPDX-License-Identifier: GPL-3.0-or-later
// The deferred shading network for a run of rays. Included once by each width's translation unit, in a namespace of its own.
#pragma once

#include "draw.hpp"
#include "rows_simd.hpp"

namespace holoreel {
namespace HOLOREEL_NAMESPACE {

using namespace videorf;

// One number of each of kGroup rays.
using Group = RowOf<kGroup>::type;
typedef double Group64 __attribute__((vector_size(kGroup * sizeof(double))));

// out = matrix in + bias, the matrix row by row, then the bias; returns what lies behind them. Four rows at a time: one would
// wait for its own sums.
HOLOREEL_INLINE const float* layer(const float* weights, int outputs, int inputs, const Group* in, Group* out) {
    const float* bias = weights + outputs * inputs;
    int o = 0;
    for (; o + 4 <= outputs; o += 4) {
        const float* row = weights + o * inputs;
        Group a = bias[o] - Group{}, b = bias[o + 1] - Group{}, c = bias[o + 2] - Group{}, d = bias[o + 3] - Group{};
        for (int k = 0; k < inputs; k++, row++) {
            a += row[0] * in[k];
            b += row[inputs] * in[k];
            c += row[2 * inputs] * in[k];
            d += row[3 * inputs] * in[k];
        }
        out[o] = a, out[o + 1] = b, out[o + 2] = c, out[o + 3] = d;
    }
    for (; o < outputs; o++) {
        out[o] = bias[o] - Group{};
        for (int k = 0; k < inputs; k++) out[o] += weights[o * inputs + k] * in[k];
    }
    return bias + outputs;
}

HOLOREEL_INLINE void rectify(Group* values, int count) {
    for (int o = 0; o < count; o++) values[o] = values[o] > 0 ? values[o] : Group{};
}

// PE(d) = [d, sin d, cos d, sin 2d, cos 2d, ...] of directions whose parts lie in -1 ... 1. Taylor's series there are good to
// 1e-12, and doubled angles lose little of that in float64.
HOLOREEL_INLINE void encode(const float* directions, int frequencies, Group* out) {
    for (int a = 0; a < 3; a++) {
        Group64 x;
        for (int i = 0; i < kGroup; i++) {
            out[a][i] = directions[3 * i + a];
            x[i] = directions[3 * i + a];
        }
        if (frequencies == 0) continue;
        const Group64 xx = x * x, one = Group64{} + 1.0;
        const auto term = [&](Group64 rest, double factor) { return (one - rest) * (xx * (1.0 / factor)); };
        Group64 sine = {}, cosine = {};
        sine = term(term(term(term(term(term(term(sine, 210), 156), 110), 72), 42), 20), 6);  // 15 * 14, 13 * 12 ...
        cosine = term(term(term(term(term(term(term(cosine, 182), 132), 90), 56), 30), 12), 2);  // 14 * 13, 12 * 11 ...
        sine = x * (one - sine);
        cosine = one - cosine;
        for (int k = 0; k < frequencies; k++) {
            out[3 + 6 * k + a] = __builtin_convertvector(sine, Group);
            out[6 + 6 * k + a] = __builtin_convertvector(cosine, Group);
            const Group64 twice = 2.0 * sine * cosine;
            cosine = one - 2.0 * sine * sine;
            sine = twice;
        }
    }
}

// Colors (kGroup, 3) of kGroup rays with their sums (kGroup, channels) and directions.
void shade_group(const VideorfNetwork& network, const float* accumulated, int channels, const float* directions,
                 float* colors) {
    Group first[kMaxUnits], second[kMaxUnits];
    for (int c = 0; c < network.features; c++)
        for (int i = 0; i < kGroup; i++) first[c][i] = accumulated[i * channels + 1 + c];
    int inputs = network.features;
    if (network.frequencies >= 0) {
        encode(directions, network.frequencies, first + inputs);
        inputs += 3 + 6 * network.frequencies;
    }
    const float* weights = layer(network.weights, network.hidden, inputs, first, second);
    rectify(second, network.hidden);
    weights = layer(weights, network.hidden, network.hidden, second, first);
    rectify(first, network.hidden);
    layer(weights, 3, network.hidden, first, second);
    const F one = set1(1.0f), limit = set1(80.0f);
    for (int c = 0; c < 3; c++) {
        float color[kGroup];
        store_row<kGroup>(color, second[c]);
        for (int i = 0; i < kGroup; i += kLanes) {
            const F x = min(max(load(color + i), negate(limit)), limit);
            store(color + i, div(one, add(one, exp2(negate(mul(x, set1(1.44269504f)))))));
        }
        for (int i = 0; i < kGroup; i++) colors[3 * i + c] = color[i];
    }
}

}  // namespace HOLOREEL_NAMESPACE
}  // namespace holoreel
