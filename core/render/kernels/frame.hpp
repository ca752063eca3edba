// SPDX-License-Identifier: GPL-3.0-or-later
// What one forward pass leaves behind for the backward pass of the same picture.
#pragma once

#include <memory>
#include <vector>

#include "api.hpp"
#include "buffer.hpp"
#include "raster.hpp"

namespace holoreel {

constexpr int64_t kChunk = 2048;  // Gaussians per task

// Where one Gaussian falls: tile rows [row, row + rows), and per row a half-open range of tile columns. Up to four rows lie
// in `columns` itself, the others in the overflow of the chunk, from `overflow` on.
struct Footprint {
    static constexpr int kInline = 4;
    uint16_t row, rows;
    uint32_t slot;      // the first of this Gaussian's places in the backward pass's per-tile sums
    uint32_t overflow;
    uint32_t tiles;     // how many tiles it touches; 0 where it is not seen
    uint32_t columns[kInline];  // begin | end << 16
};

// Where rows are listed, a Gaussian's index here is its place in the list.
struct Frame {
    int64_t count = 0;
    int width = 0, height = 0, channels = 0, padded_channels = 0, tiles_x = 0, tiles_y = 0;
    bool with_depth = false;
    int64_t visible = 0, intersections = 0;
    Buffer<float> records;
    Buffer<Footprint> footprints;
    std::vector<std::vector<uint32_t>> overflow;  // per chunk
    Buffer<int64_t> tile_begin;                   // tiles + 1
    Buffer<Entry> entries;
    HoloreelTimings timings{};

    int64_t chunks() const { return (count + kChunk - 1) / kChunk; }
    int tiles() const { return tiles_x * tiles_y; }
    const uint32_t* columns(int64_t i) const {
        const Footprint& f = footprints[i];
        return f.rows <= Footprint::kInline ? f.columns : overflow[i / kChunk].data() + f.overflow;
    }
};

// Sort and sum buffers that live only within a call; calls are serialized, so there is one of each.
struct Scratch {
    Buffer<uint64_t> keys, keys_swap;
    Buffer<uint32_t> histogram;
    Buffer<float> sums;
    std::vector<int64_t> chunk_visible, chunk_slots;
    std::vector<uint32_t> tile_histogram;
};

// Evaluates and projects every Gaussian; fills records, footprints and keys (depth << 32 | index, unsorted, dense).
void project_all(const HoloreelGaussians& gaussians, const HoloreelCamera& camera, const HoloreelRules& rules,
                 Frame& frame, Scratch& scratch);

// Sorts the keys of the visible Gaussians front to back.
void sort_by_depth(Frame& frame, Scratch& scratch);

// Fills tile_begin and entries: per tile its Gaussians, front to back.
void bin_to_tiles(Frame& frame, Scratch& scratch);

// Sums what the tiles left and carries it back through projection and evaluation.
void gather_gradients(const HoloreelGaussians& gaussians, const HoloreelCamera& camera, const HoloreelRules& rules,
                      const Frame& frame, const float* sums, bool with_depth, const HoloreelGradients& gradients);

}  // namespace holoreel
