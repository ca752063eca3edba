// SPDX-License-Identifier: GPL-3.0-or-later
// What a width's translation unit offers: the march of a run of rays, for tables of 4, 8 or 16 channels.
#pragma once

#include <cstdint>
#include <vector>

#include "volume.hpp"

namespace holoreel {
namespace videorf {

constexpr int kBatch = 8;  // samples that are taken at once

// What the forward pass writes down of a sample, so that the backward pass need not march again.
struct Record {
    int32_t corner;      // the cell's lowest in Volume::rows_of
    float x, y, z;       // place in the cell
    float weight;        // times the gradient of the ray's features gives that of the sample's features
    float distance;      // from the ray's origin, in spacings
    float after;         // the transmittance behind the sample
    float slope;         // of -log(1 - alpha) over the density; the backward pass puts the density's gradient here
};

// The records of a run of rays, and which of them touch each shard, in the order of the rays.
struct Chunk {
    std::vector<Record> records;
    std::vector<float> rows;      // the table's row at each record, C channels
    std::vector<uint32_t> ends;   // per ray where its records end
    std::vector<float> left;      // per ray its transmittance at the end
    std::vector<int32_t> rays;    // per record its ray
    std::vector<uint32_t> order;
    uint32_t begin[kShards + 1];
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
    // Puts the gradient of every record's density in its place. `first` is the chunk's first ray.
    void (*backward)(const VideorfImageGradients&, double spacing, int64_t first, Chunk& chunk);
    // Adds one shard of the chunks' records to the table's gradient, chunk by chunk.
    void (*scatter)(const Volume&, const VideorfImageGradients&, int shard, const Chunk* chunks, int64_t count,
                    float* gradient);
};

const MarchKernels* wide_march(int channels);    // null where the processor family has no wider vectors
const MarchKernels* narrow_march(int channels);  // null for another number of channels than 4, 8 or 16

}  // namespace videorf
}  // namespace holoreel
