// SPDX-License-Identifier: GPL-3.0-or-later
// The plain C interface; core/render/cpu.py declares the same structures to ctypes. Raise HOLOREEL_ABI with every change.
#pragma once

#include <cstdint>

#define HOLOREEL_ABI 8
#define HOLOREEL_API extern "C" __attribute__((visibility("default")))

struct HoloreelCamera {
    double fx, fy, cx, cy;
    double world_to_camera[12];  // the upper 3 x 4, row by row
    int32_t width, height;
};

struct HoloreelRules {
    double alpha_max, alpha_min, transmittance_min, low_pass, near_plane, jacobian_clamp;
    int32_t detach_motion_time;
    int32_t cull_faded;
};

// N rows in each array. With `spacetime` the parameters are raw (Eqs. 6-9); without it `scales` are linear, `opacities` lie
// in [0, 1], and motions, omegas, trbf_centers, trbf_log_scales and time are ignored. `rows`, where not null, lists the
// `listed` rows that are drawn, in ascending order, as if there were no others; there is no backward pass then.
struct HoloreelGaussians {
    int64_t count;
    int32_t channels;
    int32_t spacetime;
    double time;
    const float *means, *motions, *quats, *omegas, *scales, *opacities, *features, *trbf_centers, *trbf_log_scales;
    const uint32_t* rows;
    int64_t listed;
};

// features (H, W, C), alpha (H, W), background (C) or null for black; depth and transmittance (H, W) or null. Transmittance
// is 1 - alpha without the rounding, which matters where little is left of it; the gradient of alpha needs it.
struct HoloreelImages {
    float *features, *alpha, *depth, *transmittance;
    const float* background;
};

// Gradients of the images; any may be null.
struct HoloreelImageGradients {
    const float *features, *alpha, *depth;
};

// Gradients of the Gaussians' arrays, overwritten; any may be null. The density arrays are added to, where not null.
struct HoloreelGradients {
    float *means, *motions, *quats, *omegas, *scales, *opacities, *features, *trbf_centers, *trbf_log_scales;
    float* density_gradient;
    int32_t* density_views;
    float* density_radius_px;
};

// out = base + output relu(hidden [dir, time, ray origin, ray direction]) per pixel of 9 features [base, dir, time], then the
// activation: 0 none, 1 clamp to [0, 1], 2 sigmoid. `hidden` is (6, 12), `output` (3, 6), row by row; rays are in the world,
// directions unit vectors through pixel centers.
struct HoloreelDecoder {
    const float *hidden, *output;
    int32_t activation;
    int32_t unused;
};

// Where a lens's pixels (H, W) lie in a pinhole's picture, the source (H', W', C): `places` (H + 2, W + 2, 2) are x and y, in
// its pixels, of the lens's pixel centers and of those one beyond the border. A pixel is the mean of `samples`² bicubic
// samples at the middles of its parts, whose places are interpolated; 0 where not `valid` (H, W). What lies outside the
// source is 0. `spans` (H, ceil(W / 64), 2) are the first and last source row that each block of 64 pixels looks at.
struct HoloreelWarp {
    const float* places;
    const uint8_t* valid;
    const int32_t* spans;
    int32_t width, height, source_width, source_height, channels, samples;
};

// One tensor for Adam: rows of `columns` values. The step size is rate times the row's and the column's factor (null: 1);
// values are held in [low, high].
struct HoloreelAdamGroup {
    float* values;
    const float* gradient;
    float *mean, *mean_square;
    const float *row_rates, *column_rates;
    int64_t rows, columns;
    double rate, low, high;
};

struct HoloreelTimings {  // seconds
    double project, sort, bin, blend, backward_blend, backward_gather;
};
