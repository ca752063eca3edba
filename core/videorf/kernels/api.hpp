// SPDX-License-Identifier: GPL-3.0-or-later
// The plain C interface; core/videorf/native.py declares the same structures to ctypes. Raise VIDEORF_ABI with every change.
#pragma once

#include <cstdint>

#define VIDEORF_ABI 4
#define VIDEORF_API extern "C" __attribute__((visibility("default")))

// Vertices lowest + spacing * (i, j, k); lookup (X, Y, Z) holds the row of each in the table, -1 where it is empty. The table
// has `rows` rows, of which the last is what empty vertices hold.
struct VideorfLattice {
    int32_t shape[3];
    int32_t rows;
    double lowest[3];
    double spacing;
    const int32_t* lookup;
};

// origins and unit directions (N, 3) in the world; jitter (N) in [0, 1) or null for 1/2. Sample k lies (k + jitter) step
// spacings behind the point where the ray enters the lattice.
struct VideorfRays {
    int64_t count;
    const float *origins, *directions, *jitter;
    double step, transmittance_min;
};

// accumulated (N, C): the transmittance that is left, then the features; depth (N): the weighted distances, summed.
struct VideorfImages {
    float *accumulated, *depth;
};

struct VideorfImageGradients {
    const float *accumulated, *depth;  // either may be null
};

// The deferred shading network: matrix (out, in) and bias of each of its three layers, one after the other. `frequencies` is -1
// where it does not look at the direction.
struct VideorfNetwork {
    int32_t features, frequencies, hidden;
    const float* weights;
};

// A picture to be drawn: origins and unit directions (H, W, 3) of its pixels, and the direction along which depth is measured.
struct VideorfView {
    int32_t width, height;
    const float *origins, *directions;
    double step, transmittance_min;
    float forward[3], background[3];
};

// image (H, W, 3), alpha (H, W), depth (H, W), infinite where nothing is.
struct VideorfPicture {
    float *image, *alpha, *depth;
};

// One step of Adam on `rows` rows of `channels` values (1 to 16), with the gradients of the losses between each row and its
// `neighbors` (at most 16), and between it and `previous` (rows, channels; may be null). `near` (rows, neighbors) is not checked;
// a row stands for itself where there is no neighbor. `kinds` (rows, neighbors; 0 to 3) says which of the weights a pair has.
// step, rates, low, high: per channel.
struct VideorfStep {
    int64_t rows, count;  // `count` steps, with this one
    int32_t channels, neighbors;
    float *values, *mean, *square;
    const float *gradient, *previous;
    const int32_t* near;
    const uint8_t* kinds;
    const float *step, *rates, *low, *high;
    double weights[4], temporal, beta1, beta2, epsilon;
};
