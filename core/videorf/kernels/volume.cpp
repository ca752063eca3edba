// SPDX-License-Identifier: GPL-3.0-or-later
#include "volume.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

namespace holoreel {
namespace videorf {

namespace {

void check(const VideorfLattice& lattice) {
    for (int edge : lattice.shape)
        if (edge < 2 || edge > 1024) throw std::invalid_argument("a lattice has 2 to 1024 vertices along each axis");
    if (lattice.rows < 1) throw std::invalid_argument("the table has no row for empty vertices");
    if (!(lattice.spacing > 0) || !std::isfinite(lattice.spacing))
        throw std::invalid_argument("the spacing of a lattice must be finite and above 0");
    const int64_t vertices = int64_t(lattice.shape[0]) * lattice.shape[1] * lattice.shape[2];
    for (int64_t i = 0; i < vertices; i++)
        if (lattice.lookup[i] < -1 || lattice.lookup[i] >= lattice.rows - 1)
            throw std::invalid_argument("the lookup names a row that the table does not have");
}

}  // namespace

Volume::Volume(const VideorfLattice& lattice) {
    check(lattice);
    rows = lattice.rows;
    shard_rows = std::max(1, (rows - 1 + kShards - 1) / kShards);
    spacing = lattice.spacing;
    for (int a = 0; a < 3; a++) {
        lowest[a] = lattice.lowest[a];
        cells[a] = lattice.shape[a] - 1;
        bricks[a] = (cells[a] + kBrick - 1) / kBrick;
        blocks[a] = (cells[a] + kBlock - 1) / kBlock;
    }
    brick_of.assign(size_t(bricks[0]) * bricks[1] * bricks[2], 0);
    block_full.assign(size_t(blocks[0]) * blocks[1] * blocks[2], 0);
    constexpr int kCells = kBrick * kBrick * kBrick;
    cell_of.assign(kCells, -1);  // the empty brick
    const int64_t step_y = lattice.shape[2], step_x = step_y * lattice.shape[1];
    size_t brick = 0;
    for (int bx = 0; bx < bricks[0]; bx++)
    for (int by = 0; by < bricks[1]; by++)
    for (int bz = 0; bz < bricks[2]; bz++, brick++) {
        int32_t found[kCells];
        bool full = false;
        for (int inside = 0; inside < kCells; inside++) {
            const int x = bx * kBrick + inside / 16, y = by * kBrick + inside / 4 % 4, z = bz * kBrick + inside % 4;
            found[inside] = -1;
            if (x >= cells[0] || y >= cells[1] || z >= cells[2]) continue;
            const int32_t* vertex = lattice.lookup + x * step_x + y * step_y + z;
            int32_t row[8];
            bool occupied = false;
            for (int corner = 0; corner < 8; corner++) {
                row[corner] = vertex[(corner >> 2) * step_x + (corner >> 1 & 1) * step_y + (corner & 1)];
                occupied |= row[corner] >= 0;
            }
            if (!occupied) continue;
            uint32_t mask = 0;
            for (int32_t& r : row) {
                if (r >= 0) mask |= 1u << (r / shard_rows);
                else r = rows - 1;
            }
            found[inside] = static_cast<int32_t>(shards.size());
            corners.insert(corners.end(), row, row + 8);
            shards.push_back(mask);
            full = true;
        }
        if (!full) continue;
        brick_of[brick] = static_cast<int32_t>(cell_of.size());
        cell_of.insert(cell_of.end(), found, found + kCells);
        constexpr int kRatio = kBlock / kBrick;
        block_full[(size_t(bx / kRatio) * blocks[1] + by / kRatio) * blocks[2] + bz / kRatio] = 1;
    }
}

}  // namespace videorf
}  // namespace holoreel
