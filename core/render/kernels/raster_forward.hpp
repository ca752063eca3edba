// SPDX-License-Identifier: GPL-3.0-or-later
// One tile of the picture, front to back. Included by the translation units of both widths.
#pragma once

#include "raster_tile.hpp"

namespace holoreel {
namespace HOLOREEL_NAMESPACE {

// Writes pixel after pixel what lies channel after channel. Called with a constant where that saves a loop.
template <int C>
HOLOREEL_INLINE void interleave(const float (*values)[kLanes], int lanes, int channels, float* out) {
    for (int lane = 0; lane < lanes; lane++, out += channels)
        for (int c = 0; c < channels; c++) out[c] = values[c][lane];
}

HOLOREEL_INLINE void store_first(float* out, F value, int lanes) {
    if (lanes == kLanes) {
        store(out, value);
        return;
    }
    float values[kLanes];
    store(values, value);
    for (int lane = 0; lane < lanes; lane++) out[lane] = values[lane];
}

template <int C, bool kDepth>
void forward_tile(const TileJob& job, int tile) {
    constexpr int kSums = C + (kDepth ? 2 : 0);  // with depth: the sums of w z and of w
    const Tile t(job, tile);
    F transmittance[kVectors];
    F sums[kVectors][kSums];
    for (int k = 0; k < t.rows * kGroups; k++) {
        transmittance[k] = t.inside(k, set1(1.0f));
        for (int c = 0; c < kSums; c++) sums[k][c] = set1(0.0f);
    }
    const F transmittance_min = set1(job.transmittance_min), alpha_max = set1(job.alpha_max);
    const F log2_alpha_min = set1(job.log2_alpha_min);

    int until_check = kCheckEvery;
    for (int64_t e = t.begin; e < t.end; e++) {
        prefetch_record<C>(job, e + kPrefetch < t.end ? e + kPrefetch : t.end - 1);
        const Record& record = record_at<C>(job, e);
        const Touched touched(record, t);
        F channels[C + 1];
        for (int c = 0; c < C + (kDepth ? 1 : 0); c++) channels[c] = set1(record.channels()[c]);
        for (int group = touched.group_begin; group < touched.group_end; group++) {
            Falloff falloff(record, t, group, touched.row_begin);
            for (int row = touched.row_begin; row < touched.row_end; row++, falloff.next_row()) {
                const int k = row * kGroups + group;
                const F before = transmittance[k];
                const F p = falloff.log2_alpha();
                const Mask seen = both(ge(p, log2_alpha_min), gt(before, set1(0.0f)));
                const F alpha = min(exp2(p), alpha_max);
                const F after = fnma(alpha, before, before);
                const Mask drawn = both(seen, ge(after, transmittance_min));
                const F weight = keep(drawn, mul(alpha, before));
                transmittance[k] = select(drawn, after, select(seen, negate(before), before));
                F* sum = sums[k];
                for (int c = 0; c < C + (kDepth ? 1 : 0); c++) sum[c] = fma(weight, channels[c], sum[c]);
                if (kDepth) sum[C + 1] = add(sum[C + 1], weight);
            }
        }
        if (--until_check == 0) {
            if (!any_live(transmittance, t.rows * kGroups)) break;
            until_check = kCheckEvery;
        }
    }

    F background[C];
    for (int c = 0; c < C; c++) background[c] = set1(job.background && c < job.channels ? job.background[c] : 0.0f);
    for (int k = 0; k < t.rows * kGroups; k++) {
        const F rest = abs(transmittance[k]);
        float values[C][kLanes];
        for (int c = 0; c < C; c++) store(values[c], fma(rest, background[c], sums[k][c]));
        const int lanes = t.lanes_inside(k);
        const int64_t first = t.pixel(k);
        float* features = job.features + first * job.channels;
        if (job.channels == C)
            interleave<C>(values, lanes, C, features);
        else
            interleave<C>(values, lanes, job.channels, features);
        const F covered = kDepth ? sums[k][kSums - 1] : sub(set1(1.0f), rest);
        store_first(job.alpha + first, covered, lanes);
        if (job.transmittance) store_first(job.transmittance + first, rest, lanes);
        if (kDepth) store_first(job.depth + first, keep(gt(covered, set1(0.0f)), div(sums[k][C], covered)), lanes);
    }
}

}  // namespace HOLOREEL_NAMESPACE
}  // namespace holoreel
