// SPDX-License-Identifier: GPL-3.0-or-later
// The plain C interface; core/videorf/native.py declares the same structures to ctypes. Raise VIDEORF_ABI with every change.
#pragma once

#include <cstdint>

#define VIDEORF_ABI 2
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
