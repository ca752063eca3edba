// SPDX-License-Identifier: GPL-3.0-or-later
// A lattice as the march walks it. Cells (between eight vertices) lie in bricks of 4³, bricks in blocks of 4³ bricks; what
// holds no occupied cell is skipped as a whole. Every occupied cell knows the table's rows at its eight corners.
#pragma once

#include <cstdint>
#include <vector>

#include "api.hpp"

namespace holoreel {
namespace videorf {

constexpr int kBrick = 4;    // cells
constexpr int kBlock = 16;   // cells
constexpr int kShards = 32;  // runs of rows that the backward pass fills one by one

struct Volume {
    explicit Volume(const VideorfLattice& lattice);

    int cells[3];   // along each axis
    int bricks[3];
    int blocks[3];
    int rows, shard_rows;
    double lowest[3], spacing;
    std::vector<int32_t> brick_of;   // per brick where its cells start in `cell_of`; 0 for the empty brick
    std::vector<uint8_t> block_full;  // per block of bricks whether anything is in it
    std::vector<int32_t> cell_of;    // per cell of a stored brick its number, -1 where it is empty
    std::vector<int32_t> corners;    // per occupied cell its 8 rows; corner (dx, dy, dz) is number 4 dx + 2 dy + dz
    std::vector<uint32_t> shards;    // per occupied cell a bit for every shard its corners lie in
};

}  // namespace videorf
}  // namespace holoreel
