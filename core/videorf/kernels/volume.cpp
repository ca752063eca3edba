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
    spacing = lattice.spacing;
    for (int a = 0; a < 3; a++) {
        lowest[a] = lattice.lowest[a];
        cells[a] = lattice.shape[a] - 1;
        bricks[a] = (cells[a] + kBrick - 1) / kBrick;
    }
    brick_of.assign(size_t(bricks[0]) * bricks[1] * bricks[2], 0);
    occupied.assign(1, 0);
    rows_of.assign(kBrickVertices, rows - 1);
    size_t brick = 0;
    for (int bx = 0; bx < bricks[0]; bx++)
        for (int by = 0; by < bricks[1]; by++) {
            const int32_t first = static_cast<int32_t>(occupied.size());
            for (int bz = 0; bz < bricks[2]; bz++, brick++)
                if (add_brick(lattice, bx * kBrick, by * kBrick, bz * kBrick))
                    brick_of[brick] = static_cast<int32_t>(occupied.size()) - 1;
            const int32_t end = static_cast<int32_t>(occupied.size());
            if (end > first) columns[2 * (bx & 1) + (by & 1)].push_back({first, end});
        }
    measure_distances();
}

// Chessboard distances by the two sweeps of Rosenfeld and Pfaltz (1968): each looks at the neighbors that came before.
void Volume::measure_distances() {
    const int far = std::max({bricks[0], bricks[1], bricks[2]});
    for (int32_t& brick : brick_of)
        if (brick == 0) brick = -far;
    const auto visit = [&](int x, int y, int z, int side) {
        const int64_t step_x = int64_t(bricks[1]) * bricks[2], step_y = bricks[2];
        int32_t& brick = brick_of[x * step_x + y * step_y + z];
        for (int i = 0; i < 13 && brick < -1; i++) {
            const int nx = x + side * (i / 9 - 1), ny = y + side * (i / 3 % 3 - 1), nz = z + side * (i % 3 - 1);
            if (nx < 0 || ny < 0 || nz < 0 || nx >= bricks[0] || ny >= bricks[1] || nz >= bricks[2]) continue;
            brick = std::max(brick, std::min(brick_of[nx * step_x + ny * step_y + nz], 0) - 1);
        }
    };
    for (int x = 0; x < bricks[0]; x++)
        for (int y = 0; y < bricks[1]; y++)
            for (int z = 0; z < bricks[2]; z++) visit(x, y, z, 1);
    for (int x = bricks[0]; x-- > 0;)
        for (int y = bricks[1]; y-- > 0;)
            for (int z = bricks[2]; z-- > 0;) visit(x, y, z, -1);
}

bool Volume::add_brick(const VideorfLattice& lattice, int x0, int y0, int z0) {
    const int64_t step_y = lattice.shape[2], step_x = step_y * lattice.shape[1];
    int32_t found[kBrickVertices];
    uint64_t full = 0;
    for (int i = 0; i < kBrickVertices; i++) {
        const int dx = i / kStrideX, dy = i / kStrideY % kStrideY, dz = i % kStrideY;
        const int x = x0 + dx, y = y0 + dy, z = z0 + dz;
        found[i] = rows - 1;
        if (x >= lattice.shape[0] || y >= lattice.shape[1] || z >= lattice.shape[2]) continue;
        const int32_t row = lattice.lookup[x * step_x + y * step_y + z];
        if (row < 0) continue;
        found[i] = row;
        for (int corner = 0; corner < 8; corner++) {  // the cells it is a corner of
            const int cx = dx - (corner >> 2), cy = dy - (corner >> 1 & 1), cz = dz - (corner & 1);
            if (cx < 0 || cy < 0 || cz < 0 || cx >= kBrick || cy >= kBrick || cz >= kBrick) continue;
            if (x0 + cx >= cells[0] || y0 + cy >= cells[1] || z0 + cz >= cells[2]) continue;
            full |= uint64_t(1) << (16 * cx + 4 * cy + cz);
        }
    }
    if (!full) return false;
    occupied.push_back(full);
    rows_of.insert(rows_of.end(), found, found + kBrickVertices);
    return true;
}

int64_t Volume::occupied_cells() const {
    int64_t sum = 0;
    for (uint64_t mask : occupied) sum += __builtin_popcountll(mask);
    return sum;
}

}  // namespace videorf
}  // namespace holoreel
