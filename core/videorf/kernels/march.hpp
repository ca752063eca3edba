// SPDX-License-Identifier: GPL-3.0-or-later
// What a width's translation unit offers: the march of a run of rays, for tables of 4, 8 or 16 channels.
#pragma once

#include <cstdint>
#include <vector>

#include "volume.hpp"

namespace holoreel {
namespace videorf {

constexpr int kBatch = 8;  // samples that are taken at once

// What the backward pass leaves of a sample until the table's gradient is filled.
struct Record {
    int32_t corner;      // the cell's lowest in Volume::rows_of
    float x, y, z;       // place in the cell
    float weight;        // times the gradient of the ray's features gives that of the sample's features
    float density;       // the gradient of the sample's density
    int32_t ray;
};

// The records of a run of rays, and which of them touch each shard, in the order of the rays.
struct Chunk {
    std::vector<Record> records;
    std::vector<uint32_t> order;
    uint32_t begin[kShards + 1];
    int64_t samples;
};

struct March {
    const Volume* volume;
    const float* table;
    VideorfRays rays;
    VideorfImages images;               // forward
    VideorfImageGradients gradients;    // backward
};

struct MarchKernels {
    int lanes;
    // Marches rays first ... last - 1; returns the number of samples taken.
    int64_t (*forward)(const March&, int64_t first, int64_t last);
    // The same march again, its gradients put down in `chunk`.
    void (*backward)(const March&, int64_t first, int64_t last, Chunk& chunk);
    // Adds one shard of the chunks' records to the table's gradient, chunk by chunk.
    void (*scatter)(const March&, int shard, const Chunk* chunks, int64_t count, float* gradient);
};

const MarchKernels* wide_march(int channels);    // null where the processor family has no wider vectors
const MarchKernels* narrow_march(int channels);  // null for another number of channels than 4, 8 or 16

}  // namespace videorf
}  // namespace holoreel
