// SPDX-License-Identifier: GPL-3.0-or-later
// The deferred shading network for a run of rays. Included once by each width's translation unit, in a namespace of its own.
#pragma once

#include <cmath>
#include <cstring>

#include "draw.hpp"
#include "simd.hpp"

namespace holoreel {
namespace HOLOREEL_NAMESPACE {

using namespace videorf;

// Of kGroup rays side by side: out = matrix in + bias, the matrix row by row.
HOLOREEL_INLINE const float* layer(const float* weights, int outputs, int inputs, const float (*in)[kGroup], float (*out)[kGroup]) {
    const float* bias = weights + outputs * inputs;
    for (int o = 0; o < outputs; o++) {
        float sum[kGroup];
        for (int i = 0; i < kGroup; i++) sum[i] = bias[o];
        for (int k = 0; k < inputs; k++) {
            const float weight = weights[o * inputs + k];
            for (int i = 0; i < kGroup; i++) sum[i] += weight * in[k][i];
        }
        std::memcpy(out[o], sum, sizeof sum);
    }
    return bias + outputs;
}

HOLOREEL_INLINE void rectify(float (*values)[kGroup], int count) {
    for (int o = 0; o < count; o++)
        for (int i = 0; i < kGroup; i++) values[o][i] = values[o][i] > 0 ? values[o][i] : 0.0f;
}

// PE(d) = [d, sin d, cos d, sin 2d, cos 2d, ...] of directions whose parts lie in -1 ... 1. Taylor's series there are good to 1e-12,
// and doubled angles lose little of that in float64.
HOLOREEL_INLINE void encode(const float* directions, int frequencies, float (*out)[kGroup]) {
    for (int a = 0; a < 3; a++) {
        double sine[kGroup], cosine[kGroup];
        for (int i = 0; i < kGroup; i++) {
            const double x = directions[3 * i + a], xx = x * x;
            out[a][i] = directions[3 * i + a];
            double s = 0, c = 0;
            for (int k = 15; k > 1; k -= 2) {  // backward, as Horner
                s = (1 - s) * xx / (k * (k - 1));
                c = (1 - c) * xx / ((k - 1) * (k - 2));
            }
            sine[i] = x * (1 - s);
            cosine[i] = 1 - c;
        }
        for (int k = 0; k < frequencies; k++) {
            float *sines = out[3 + 6 * k + a], *cosines = out[6 + 6 * k + a];
            for (int i = 0; i < kGroup; i++) {
                sines[i] = static_cast<float>(sine[i]);
                cosines[i] = static_cast<float>(cosine[i]);
                const double twice = 2 * sine[i] * cosine[i];
                cosine[i] = 1 - 2 * sine[i] * sine[i];
                sine[i] = twice;
            }
        }
    }
}

// Colors (kGroup, 3) of kGroup rays with their sums (kGroup, channels) and directions.
void shade_group(const VideorfNetwork& network, const float* accumulated, int channels, const float* directions, float* colors) {
    alignas(32) float first[kMaxUnits][kGroup], second[kMaxUnits][kGroup];
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
    for (int c = 0; c < 3; c++)
        for (int i = 0; i < kGroup; i += kLanes) {
            const F x = min(max(load(second[c] + i), negate(limit)), limit);
            store(second[c] + i, div(one, add(one, exp2(negate(mul(x, set1(1.44269504f)))))));
        }
    for (int i = 0; i < kGroup; i++)
        for (int c = 0; c < 3; c++) colors[3 * i + c] = second[c][i];
}

}  // namespace HOLOREEL_NAMESPACE
}  // namespace holoreel
