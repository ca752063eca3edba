// SPDX-License-Identifier: GPL-3.0-or-later
// One row of the picture through the decoder, kLanes pixels at a time. Included by the translation units of both widths.
#pragma once

#include "raster.hpp"
#include "simd.hpp"

namespace holoreel {
namespace HOLOREEL_NAMESPACE {

constexpr int kFeatures = 3 + kDecoded;

HOLOREEL_INLINE int lanes_left(int x, int width) { return width - x < kLanes ? width - x : kLanes; }

// From pixel after pixel to channel after channel; lanes beyond the row are 0.
template <int C>
HOLOREEL_INLINE void deinterleave(const float* in, int lanes, F* out) {
    float values[C][kLanes];
    if (lanes < kLanes)
        for (int c = 0; c < C; c++) store(values[c], set1(0.0f));
    for (int lane = 0; lane < lanes; lane++)
        for (int c = 0; c < C; c++) values[c][lane] = in[lane * C + c];
    for (int c = 0; c < C; c++) out[c] = load(values[c]);
}

template <int C>
HOLOREEL_INLINE void interleave_vectors(const F* in, int lanes, float* out) {
    float values[C][kLanes];
    for (int c = 0; c < C; c++) store(values[c], in[c]);
    for (int lane = 0; lane < lanes; lane++)
        for (int c = 0; c < C; c++) out[lane * C + c] = values[c][lane];
}

// The network at kLanes pixels of one row.
struct Network {
    F features[kFeatures];
    F ray[3];        // unit direction in camera axes
    F hidden[kHidden];  // after the rectifier
    F out[3];        // before the activation

    HOLOREEL_INLINE_MEMBER Network(const DecodeJob& job, int row, int x, int lanes) {
        deinterleave<kFeatures>(job.features + (static_cast<int64_t>(row) * job.width + x) * kFeatures, lanes, features);
        const F plane_x = load(job.plane_x + x), plane_y = set1(static_cast<float>((row + 0.5 - job.cy) / job.fy));
        ray[2] = div(set1(1.0f), sqrt(fma(plane_x, plane_x, fma(plane_y, plane_y, set1(1.0f)))));
        ray[0] = mul(plane_x, ray[2]);
        ray[1] = mul(plane_y, ray[2]);
        for (int c = 0; c < 3; c++) out[c] = features[c];
        for (int j = 0; j < kHidden; j++) {
            F sum = set1(job.bias[j]);
            for (int k = 0; k < 3; k++) sum = fma(set1(job.ray_weights[j][k]), ray[k], sum);
            for (int k = 0; k < kDecoded; k++) sum = fma(set1(job.feature_weights[j][k]), features[3 + k], sum);
            hidden[j] = max(sum, set1(0.0f));
            for (int c = 0; c < 3; c++) out[c] = fma(set1(job.output_weights[c][j]), hidden[j], out[c]);
        }
    }
};

// e^-x, with x held where that is neither 0 nor infinite.
HOLOREEL_INLINE F decay(F x) {
    return exp2(max(min(mul(x, set1(-1.44269504f)), set1(99.0f)), set1(-99.0f)));
}

HOLOREEL_INLINE F activate(F x, Activation activation) {
    if (activation == Activation::kSigmoid) return div(set1(1.0f), add(set1(1.0f), decay(x)));
    if (activation == Activation::kClamp) return max(min(x, set1(1.0f)), set1(0.0f));
    return x;
}

// `gradient` carried back through the activation.
HOLOREEL_INLINE F activate_backward(F x, F gradient, Activation activation) {
    if (activation == Activation::kSigmoid) {
        const F e = decay(x), y = div(set1(1.0f), add(set1(1.0f), e));
        return mul(gradient, mul(mul(e, y), y));
    }
    if (activation == Activation::kClamp) return keep(both(ge(x, set1(0.0f)), ge(set1(1.0f), x)), gradient);
    return gradient;
}

static void decode_row(const DecodeJob& job, int row) {
    for (int x = 0; x < job.width; x += kLanes) {
        const int lanes = lanes_left(x, job.width);
        const Network network(job, row, x, lanes);
        F image[3];
        for (int c = 0; c < 3; c++) image[c] = activate(network.out[c], job.activation);
        interleave_vectors<3>(image, lanes, job.image + (static_cast<int64_t>(row) * job.width + x) * 3);
    }
}

static void decode_row_backward(const DecodeJob& job, int row, DecodeSums& total) {
    F sums[DecodeSums::kCount];
    for (int k = 0; k < DecodeSums::kCount; k++) sums[k] = set1(0.0f);
    for (int x = 0; x < job.width; x += kLanes) {
        const int lanes = lanes_left(x, job.width);
        const int64_t pixel = static_cast<int64_t>(row) * job.width + x;
        const Network network(job, row, x, lanes);
        F d_out[3], d_features[kFeatures];
        deinterleave<3>(job.image_gradient + pixel * 3, lanes, d_out);
        for (int c = 0; c < 3; c++) d_features[c] = d_out[c] = activate_backward(network.out[c], d_out[c], job.activation);
        for (int k = 0; k < kDecoded; k++) d_features[3 + k] = set1(0.0f);
        for (int j = 0; j < kHidden; j++) {
            F d = mul(d_out[0], set1(job.output_weights[0][j]));
            for (int c = 1; c < 3; c++) d = fma(d_out[c], set1(job.output_weights[c][j]), d);
            d = keep(gt(network.hidden[j], set1(0.0f)), d);
            F* sum = sums + j * DecodeSums::kPerHidden;
            for (int k = 0; k < kDecoded; k++) {
                sum[k] = fma(d, network.features[3 + k], sum[k]);
                d_features[3 + k] = fma(d, set1(job.feature_weights[j][k]), d_features[3 + k]);
            }
            for (int k = 0; k < 3; k++) sum[kDecoded + k] = fma(d, network.ray[k], sum[kDecoded + k]);
            sum[kDecoded + 3] = add(sum[kDecoded + 3], d);
            for (int c = 0; c < 3; c++) sum[kDecoded + 4 + c] = fma(d_out[c], network.hidden[j], sum[kDecoded + 4 + c]);
        }
        if (job.features_gradient)
            interleave_vectors<kFeatures>(d_features, lanes, job.features_gradient + pixel * kFeatures);
    }
    for (int k = 0; k < DecodeSums::kCount; k++) total.values[k] += sum_one(sums[k]);
}

}  // namespace HOLOREEL_NAMESPACE
}  // namespace holoreel
