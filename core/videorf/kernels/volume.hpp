// SPDX-License-Identifier: GPL-3.0-or-later
// A lattice as the march walks it. Cells (between eight vertices) lie in bricks of 4³, bricks in blocks of 4³ bricks; what
// holds no occupied cell is skipped as a whole. A brick keeps the table's rows of its 5³ vertices side by side, so that the
// samples of a ray find their corners in few lines of memory.
#pragma once

#include <cstdint>
#include <vector>

#include "api.hpp"

namespace holoreel {
namespace videorf {

constexpr int kBrick = 4;  // cells
constexpr int kBlock = 16;  // cells
constexpr int kStrideY = kBrick + 1;  // in a brick's vertices
constexpr int kStrideX = kStrideY * kStrideY;
constexpr int kBrickVertices = kStrideX * (kBrick + 1);
constexpr int kShards = 32;  // runs of rows that the backward pass fills one by one

struct Volume {
    explicit Volume(const VideorfLattice& lattice);
    int64_t occupied_cells() const;

    int cells[3];   // along each axis
    int bricks[3];
    int blocks[3];
    int rows, shard_rows;
    double lowest[3], spacing;
    std::vector<int32_t> brick_of;    // per brick its number; 0 for the empty one, which all empty bricks share
    std::vector<uint8_t> block_full;  // per block of bricks whether anything is in it
    std::vector<uint64_t> occupied;   // per number a bit for each cell, 16 x + 4 y + z
    std::vector<int32_t> rows_of;     // per number the rows of its vertices, 25 x + 5 y + z
    std::vector<uint32_t> shards;     // per number a bit for every shard its vertices lie in

private:
    bool add_brick(const VideorfLattice& lattice, int x, int y, int z);
};

}  // namespace videorf
}  // namespace holoreel
