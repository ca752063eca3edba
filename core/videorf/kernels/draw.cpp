// SPDX-License-Identifier: GPL-3.0-or-later
#include "draw.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "thread_pool.hpp"

namespace holoreel {
namespace videorf {

namespace {

constexpr int kTilePixels = kTile * kTile;
constexpr int kMaxChannels = 16;

// The rays of a tile and what came of them.
struct Tile {
    int64_t pixels[kTilePixels];
    float origins[3 * kTilePixels], directions[3 * kTilePixels] = {};
    alignas(64) float accumulated[kMaxChannels * kTilePixels] = {};
    float depth[kTilePixels];
    int count = 0;
};

void take_rays(const VideorfView& view, int64_t tile, Tile& out) {
    const int64_t across = (view.width + kTile - 1) / kTile;
    const int x0 = static_cast<int>(tile % across) * kTile, y0 = static_cast<int>(tile / across) * kTile;
    for (int y = y0; y < std::min(y0 + kTile, view.height); y++)
        for (int x = x0; x < std::min(x0 + kTile, view.width); x++, out.count++) {
            const int64_t pixel = int64_t(y) * view.width + x;
            out.pixels[out.count] = pixel;
            for (int a = 0; a < 3; a++) {
                out.origins[3 * out.count + a] = view.origins[3 * pixel + a];
                out.directions[3 * out.count + a] = view.directions[3 * pixel + a];
            }
        }
}

void write_pixel(const VideorfView& view, const Tile& tile, int i, int channels, const float* color,
                 const VideorfPicture& picture) {
    const int64_t pixel = tile.pixels[i];
    const float left = tile.accumulated[i * channels], alpha = 1 - left;
    picture.alpha[pixel] = alpha;
    if (alpha == 0) {
        for (int c = 0; c < 3; c++) picture.image[3 * pixel + c] = view.background[c];
        picture.depth[pixel] = std::numeric_limits<float>::infinity();
        return;
    }
    for (int c = 0; c < 3; c++) picture.image[3 * pixel + c] = alpha * color[c] + left * view.background[c];
    const float* d = tile.directions + 3 * i;
    const float along = d[0] * view.forward[0] + d[1] * view.forward[1] + d[2] * view.forward[2];
    picture.depth[pixel] = tile.depth[i] / alpha * along;
}

}  // namespace

void check(const VideorfNetwork& network, int channels) {
    const int inputs = network.features + (network.frequencies < 0 ? 0 : 3 + 6 * network.frequencies);
    if (network.features < 1 || network.features >= channels)
        throw std::invalid_argument("the shading network takes other features than the table has");
    if (network.hidden < 1 || network.hidden > kMaxUnits || network.frequencies > 8 || inputs > kMaxUnits)
        throw std::invalid_argument("the shading network is too large");
}

void check(const VideorfView& view) {
    if (view.width < 1 || view.height < 1 || view.width > 1 << 16 || view.height > 1 << 16)
        throw std::invalid_argument("a picture has 1 to 65536 pixels along each side");
}

void draw(const Volume& volume, const float* table, int channels, const VideorfNetwork& network, const VideorfView& view,
          const MarchKernels& kernels, Shade shade, const VideorfPicture& picture) {
    const int64_t across = (view.width + kTile - 1) / kTile, down = (view.height + kTile - 1) / kTile;
    pool().run(across * down, [&](int64_t index) {
        Tile tile;
        take_rays(view, index, tile);
        const VideorfRays rays{tile.count, tile.origins, tile.directions, nullptr, view.step, view.transmittance_min};
        kernels.forward({&volume, table, rays, {tile.accumulated, tile.depth}}, 0, tile.count, nullptr);
        for (int first = 0; first < tile.count; first += kGroup) {
            const int count = std::min(kGroup, tile.count - first);
            float colors[3 * kGroup];
            bool hit = false;
            for (int i = first; i < first + count; i++) hit = hit || tile.accumulated[i * channels] < 1;
            if (hit) shade(network, tile.accumulated + first * channels, channels, tile.directions + 3 * first, colors);
            for (int i = 0; i < count; i++) write_pixel(view, tile, first + i, channels, colors + 3 * i, picture);
        }
    });
}

}  // namespace videorf
}  // namespace holoreel
