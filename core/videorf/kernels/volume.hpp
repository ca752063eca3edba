// SPDX-License-Identifier: GPL-3.0-or-later
// A lattice as the march walks it. Cells (between eight vertices) lie in bricks of 4³. An empty brick knows how far it is to
// the next one that is not, so that rays leap over all that lies between. A brick keeps the table's rows of its 5³ vertices side
// by side, so that the samples of a ray find their corners in few lines of memory.
#pragma once

#include <cstdint>
#include <vector>

#include "api.hpp"

namespace holoreel {
namespace videorf {

constexpr int kBrick = 4;  // cells
constexpr int kStrideY = kBrick + 1;  // in a brick's vertices
constexpr int kStrideX = kStrideY * kStrideY;
constexpr int kBrickVertices = kStrideX * (kBrick + 1);
constexpr int kColors = 4;

// Bricks first ... end - 1, all that are not empty at one place along the first two axes.
struct Column {
    int32_t first, end;
};

struct Volume {
    explicit Volume(const VideorfLattice& lattice);
    int64_t occupied_cells() const;

    int cells[3];   // along each axis
    int bricks[3];
    int rows;
    double lowest[3], spacing;
    std::vector<int32_t> brick_of;   // per brick its number; of an empty one minus the distance to the nearest other, in bricks
    std::vector<uint64_t> occupied;  // per number a bit for each cell, 16 x + 4 y + z; number 0 stands for all empty bricks
    std::vector<int32_t> rows_of;    // per number the rows of its vertices, 25 x + 5 y + z
    std::vector<Column> columns[kColors];  // columns of one color share no vertex

private:
    bool add_brick(const VideorfLattice& lattice, int x, int y, int z);
    void measure_distances();
};

}  // namespace videorf
}  // namespace holoreel
