// SPDX-License-Identifier: GPL-3.0-or-later
// What a width's translation unit offers: the march of a run of rays, for tables of 4, 8 or 16 channels.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "volume.hpp"

namespace holoreel {
namespace videorf {

constexpr int kBatch = 8;  // samples that are taken at once

// What the forward pass writes down of the samples of a run of rays, so that the backward pass need not march again.
struct Chunk {
    size_t used = 0;                // samples written down
    std::vector<int32_t> corner;    // per sample its cell's lowest in Volume::rows_of
    std::vector<float> x, y, z;     // place in the cell
    std::vector<float> weight;      // times the gradient of the ray's features gives that of the sample's features
    std::vector<float> distance;    // from the ray's origin, in spacings
    std::vector<float> after;       // the transmittance behind the sample
    std::vector<float> slope;       // of -log(1 - alpha) over the density
    std::vector<float> rows;        // the table's row at the sample, C channels
    std::vector<uint32_t> ends;     // per ray where its samples end
    std::vector<float> left;        // per ray its transmittance at the end
};

// A sample with its gradient, sorted by brick.
struct Scattered {
    int32_t ray, corner;  // the latter within its brick
    float x, y, z, weight;
    float density;  // the gradient of the sample's raw density
    float unused;
};

struct March {
    const Volume* volume;
    const float* table;
    VideorfRays rays;
    VideorfImages images;
};

struct MarchKernels {
    int lanes;
    // Marches rays first ... last - 1, writing down in `chunk` if there is one; returns the number of samples taken.
    int64_t (*forward)(const March&, int64_t first, int64_t last, Chunk* chunk);
    // Writes the samples of a chunk, whose first ray is `first`, to the places that `next` gives for their bricks, and moves
    // those on.
    void (*backward)(const VideorfImageGradients&, double spacing, int64_t first, const Chunk& chunk, uint32_t* next,
                     Scattered* sorted);
    // Adds the samples of a column's bricks, which begin where `begins` says, to the table's gradient.
    void (*scatter)(const Volume&, const VideorfImageGradients&, Column, const Scattered* sorted, const uint32_t* begins,
                    float* gradient);
};

const MarchKernels* wide_march(int channels);    // null where the processor family has no wider vectors
const MarchKernels* narrow_march(int channels);  // null for another number of channels than 4, 8 or 16

}  // namespace videorf
}  // namespace holoreel
