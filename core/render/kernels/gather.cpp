// SPDX-License-Identifier: GPL-3.0-or-later
// The second half of the backward pass: each Gaussian sums what its tiles left, in a fixed order and in double, and carries
// it back through projection and evaluation to its raw parameters.
#include <algorithm>
#include <cmath>

#include "frame.hpp"
#include "projection.hpp"
#include "thread_pool.hpp"
#include "vectorize.hpp"

namespace holoreel {

namespace {

constexpr double kLog2E = 1.4426950408889634;

void fill_zero(float* target, int64_t i, int width) {
    if (target) std::fill_n(target + i * width, width, 0.0f);
}

void clear_row(const HoloreelGradients& out, int64_t i, int channels) {
    fill_zero(out.means, i, 3);
    fill_zero(out.motions, i, 9);
    fill_zero(out.quats, i, 4);
    fill_zero(out.omegas, i, 4);
    fill_zero(out.scales, i, 3);
    fill_zero(out.opacities, i, 1);
    fill_zero(out.features, i, channels);
    fill_zero(out.trbf_centers, i, 1);
    fill_zero(out.trbf_log_scales, i, 1);
}

// From the tile sums to the splat: with f = -|w|²/2 and w = W d, df/dmean = Wᵀw and df/dcov = ½ Wᵀ w wᵀ W.
SplatGradient splat_gradient(const Splats& s, const D* sums) {
    constexpr double unscale = 1.1774100225154747;  // sqrt(2 / log2(e)): the tiles' u, v are W d times sqrt(log2(e) / 2)
    const D u = sums[1] * unscale, v = sums[2] * unscale;
    const D uu = sums[3] * (2.0 / kLog2E), uv = sums[4] * (2.0 / kLog2E), vv = sums[5] * (2.0 / kLog2E);
    SplatGradient d;
    d.x = s.w11 * u;
    d.y = s.w12 * u + s.w22 * v;
    d.cov_xx = 0.5 * s.w11 * s.w11 * uu;
    d.cov_xy = 0.5 * s.w11 * (s.w12 * uu + s.w22 * uv);
    d.cov_yy = 0.5 * (s.w12 * s.w12 * uu + 2.0 * s.w12 * s.w22 * uv + s.w22 * s.w22 * vv);
    return d;
}

void update_density(const HoloreelGradients& out, const RowSet& rows, Mask wanted, const Splats& s,
                    const SplatGradient& d) {
    const D pull = sqrt(d.x * d.x + d.y * d.y);
    const D middle = 0.5 * (s.cov_xx + s.cov_yy), half = 0.5 * (s.cov_xx - s.cov_yy);
    const D radius = 3.0 * sqrt(middle + sqrt(half * half + s.cov_xy * s.cov_xy));
    for (int lane = 0; lane < rows.count; lane++) {
        if (!wanted[lane]) continue;
        const int64_t i = rows.rows[lane];
        if (out.density_gradient) out.density_gradient[i] += static_cast<float>(pull[lane]);
        if (out.density_views) out.density_views[i]++;
        if (out.density_radius_px)
            out.density_radius_px[i] = std::max(out.density_radius_px[i], static_cast<float>(radius[lane]));
    }
}

// Adds up what the tiles of one Gaussian left, in their order.
template <int kWidth>
void sum_tiles(const float* place, uint32_t tiles, int width, double* total) {
    const int count = kWidth ? kWidth : width;
    for (uint32_t tile = 0; tile < tiles; tile++, place += count)
        for (int k = 0; k < count; k++) total[k] += place[k];
}

HOLOREEL_HEAVY_CLONES void gather_chunk(const HoloreelGaussians& g, const View& view, const HoloreelRules& rules,
                                        int64_t chunk, const Frame& frame, const float* sums, bool with_depth,
                                        const HoloreelGradients& out) {
    const int padded = frame.padded_channels, width = kMoments + padded + (with_depth ? 1 : 0);
    const bool density = out.density_gradient || out.density_views || out.density_radius_px;
    const int64_t end = std::min((chunk + 1) * kChunk, frame.count);
    uint32_t visible[kChunk];
    int64_t count = 0;
    for (int64_t i = chunk * kChunk; i < end; i++) {
        if (frame.footprints[i].tiles)
            visible[count++] = static_cast<uint32_t>(i);
        else
            clear_row(out, i, frame.channels);
    }
    for (int64_t k = 0; k < count; k += kRows) {
        const RowSet rows(visible + k, count - k);
        Instant instant{};
        Splats splats{};
        // These hold for what the forward pass saw, unless the arrays were changed in between.
        Mask seen = evaluate(g, rows, rules, instant);
        if (any(seen)) seen &= project(instant, view, rules, splats);
        D moments[kMoments], d_depth = all(0.0);
        for (int lane = 0; lane < rows.count; lane++) {
            const int64_t i = rows.rows[lane];
            if (!seen[lane]) {
                clear_row(out, i, frame.channels);
                continue;
            }
            double total[kMoments + kMaxChannels + 1] = {};
            const Footprint& footprint = frame.footprints[i];
            const float* place = sums + static_cast<int64_t>(footprint.slot) * width;
            if (width == kMoments + 3)
                sum_tiles<kMoments + 3>(place, footprint.tiles, width, total);
            else
                sum_tiles<0>(place, footprint.tiles, width, total);
            for (int k = 0; k < kMoments; k++) moments[k][lane] = total[k];
            if (with_depth) d_depth[lane] = total[kMoments + padded];
            if (out.features)
                for (int c = 0; c < frame.channels; c++)
                    out.features[i * frame.channels + c] = static_cast<float>(total[kMoments + c]);
        }
        if (!any(seen)) continue;
        SplatGradient d_splat = splat_gradient(splats, moments);
        d_splat.depth = d_depth;
        InstantGradient d_instant;
        project_backward(instant, view, d_splat, d_instant);
        d_instant.opacity = moments[0] / instant.opacity;
        evaluate_backward(g, rows, rules, instant, d_instant, seen, out);
        if (density) update_density(out, rows, seen, splats, d_splat);
    }
}

}  // namespace

void gather_gradients(const HoloreelGaussians& g, const HoloreelCamera& camera, const HoloreelRules& rules,
                      const Frame& frame, const float* sums, bool with_depth, const HoloreelGradients& out) {
    const View view(camera, rules);
    pool().run(frame.chunks(),
               [&](int64_t chunk) { gather_chunk(g, view, rules, chunk, frame, sums, with_depth, out); });
}

}  // namespace holoreel
