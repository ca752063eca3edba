// SPDX-License-Identifier: GPL-3.0-or-later
// One tile of the backward pass: the forward pass is replayed front to back, which needs no record of where each pixel
// stopped. With S = <dL/dpicture, picture> of a pixel, what lies behind a Gaussian is S less what came before it.
// Each (Gaussian, tile) pair writes its sums to a place of its own, so nothing is ever added by two threads.
#pragma once

#include "raster_tile.hpp"

namespace holoreel {
namespace HOLOREEL_NAMESPACE {

// The sums over lanes of `kCount` vectors.
template <int kCount>
HOLOREEL_INLINE void sum_all(const F* vectors, float* out) {
    constexpr int kWhole = kCount / kLanes * kLanes;
    for (int k = 0; k < kWhole; k += kLanes) sum_lanes(vectors + k, out + k);
    if (kCount - kWhole > 2) {
        F tail[kLanes];
        float sums[kLanes];
        for (int k = 0; k < kLanes; k++) tail[k] = vectors[kWhole + k < kCount ? kWhole + k : kCount - 1];
        sum_lanes(tail, sums);
        for (int k = kWhole; k < kCount; k++) out[k] = sums[k - kWhole];
    } else {
        for (int k = kWhole; k < kCount; k++) out[k] = sum_one(vectors[k]);
    }
}

// Per pixel: the gradients, and S. The depth of a pixel is a mean, so its gradient acts on (z - depth) / alpha, whose
// weighted sum is zero and so needs no place in S.
template <int C, bool kDepth>
struct PixelGradients {
    F features[kVectors][C];
    F depth[kDepth ? kVectors : 1], depth_gradient[kDepth ? kVectors : 1];
    F behind[kVectors];

    PixelGradients(const TileJob& job, const Tile& t) {
        for (int k = 0; k < t.rows * kGroups; k++) {
            float g[C][kLanes] = {}, z[kLanes] = {}, gz[kLanes] = {}, s[kLanes] = {};
            if (job.channels == C)
                read(job, t.pixel(k), t.lanes_inside(k), C, g, z, gz, s);
            else
                read(job, t.pixel(k), t.lanes_inside(k), job.channels, g, z, gz, s);
            for (int c = 0; c < C; c++) features[k][c] = load(g[c]);
            behind[k] = load(s);
            if (kDepth) {
                depth[k] = load(z);
                depth_gradient[k] = load(gz);
            }
        }
    }

    // One vector's pixels. Called with a constant number of channels where that saves a loop.
    HOLOREEL_INLINE void read(const TileJob& job, int64_t first, int lanes, int channels, float (*g)[kLanes], float* z,
                              float* gz, float* s) {
        for (int lane = 0; lane < lanes; lane++) {
            const int64_t pixel = first + lane;
            const float alpha = job.alpha[pixel];
            double sum = 0.0;
            if (job.grad_features)
                for (int c = 0; c < channels; c++) {
                    g[c][lane] = job.grad_features[pixel * channels + c];
                    sum += static_cast<double>(g[c][lane]) * job.features[pixel * channels + c];
                }
            if (job.grad_alpha) sum -= static_cast<double>(job.grad_alpha[pixel]) * job.transmittance[pixel];
            s[lane] = static_cast<float>(sum);
            if (kDepth && alpha > 0.0f) {
                z[lane] = job.depth[pixel];
                gz[lane] = job.grad_depth[pixel] / alpha;
            }
        }
    }
};

template <int C, bool kDepth>
void backward_tile(const TileJob& job, int tile) {
    constexpr int kWidth = kMoments + C + (kDepth ? 1 : 0);
    const Tile t(job, tile);
    if (t.begin == t.end) return;
    PixelGradients<C, kDepth> gradients(job, t);
    F transmittance[kVectors];
    for (int k = 0; k < t.rows * kGroups; k++) transmittance[k] = t.inside(k, set1(1.0f));
    const F transmittance_min = set1(job.transmittance_min), alpha_max = set1(job.alpha_max);
    const F log2_alpha_min = set1(job.log2_alpha_min);

    int until_check = kCheckEvery;
    int64_t e = t.begin;
    for (; e < t.end; e++) {
        const int64_t ahead = e + kPrefetch < t.end ? e + kPrefetch : t.end - 1;
        prefetch_record<C>(job, ahead);
        const float* place = job.sums + static_cast<int64_t>(job.entries[ahead].slot) * kWidth;
        __builtin_prefetch(place, 1);
        __builtin_prefetch(place + kWidth - 1, 1);

        const Record& record = record_at<C>(job, e);
        const Touched touched(record, t);
        F channels[C];
        for (int c = 0; c < C; c++) channels[c] = set1(record.channels()[c]);
        const F z = set1(record.channels()[C]);
        F sums[kWidth];
        for (int c = 0; c < kWidth; c++) sums[c] = set1(0.0f);

        for (int group = touched.group_begin; group < touched.group_end; group++) {
            Falloff falloff(record, t, group, touched.row_begin);
            for (int row = touched.row_begin; row < touched.row_end; row++, falloff.next_row()) {
                const int k = row * kGroups + group;
                const F before = transmittance[k];
                const F p = falloff.log2_alpha();
                const Mask seen = both(ge(p, log2_alpha_min), gt(before, set1(0.0f)));
                if (!any(seen)) continue;
                const F uncapped = exp2(p);
                const F alpha = min(uncapped, alpha_max);
                const F after = fnma(alpha, before, before);
                const Mask drawn = both(seen, ge(after, transmittance_min));
                const F weight = keep(drawn, mul(alpha, before));
                transmittance[k] = select(drawn, after, select(seen, negate(before), before));

                const F* g = gradients.features[k];
                F value = mul(g[0], channels[0]);  // dL/d(weight)
                for (int c = 1; c < C; c++) value = fma(g[c], channels[c], value);
                for (int c = 0; c < C; c++) sums[kMoments + c] = fma(weight, g[c], sums[kMoments + c]);
                if (kDepth) {
                    value = fma(gradients.depth_gradient[k], sub(z, gradients.depth[k]), value);
                    sums[kMoments + C] = fma(weight, gradients.depth_gradient[k], sums[kMoments + C]);
                }
                const F behind = fnma(weight, value, gradients.behind[k]);
                gradients.behind[k] = behind;
                // dL/dalpha = T value - behind / (1 - alpha); times alpha for dL/d(ln alpha). A capped alpha does not move.
                const F slope = mul(alpha, sub(mul(before, value), div(behind, sub(set1(1.0f), alpha))));
                const F d = keep(both(drawn, gt(alpha_max, uncapped)), slope);
                const F u = falloff.u_now, v = set1(falloff.v_now);
                const F du = mul(d, u), dv = mul(d, v);
                sums[0] = add(sums[0], d);
                sums[1] = add(sums[1], du);
                sums[2] = add(sums[2], dv);
                sums[3] = fma(du, u, sums[3]);
                sums[4] = fma(du, v, sums[4]);
                sums[5] = fma(dv, v, sums[5]);
            }
        }
        sum_all<kWidth>(sums, job.sums + static_cast<int64_t>(job.entries[e].slot) * kWidth);
        if (--until_check == 0) {
            if (!any_live(transmittance, t.rows * kGroups)) {
                e++;
                break;
            }
            until_check = kCheckEvery;
        }
    }
    for (; e < t.end; e++) {
        float* place = job.sums + static_cast<int64_t>(job.entries[e].slot) * kWidth;
        for (int c = 0; c < kWidth; c++) place[c] = 0.0f;
    }
}

}  // namespace HOLOREEL_NAMESPACE
}  // namespace holoreel
