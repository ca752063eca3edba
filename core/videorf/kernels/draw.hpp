// SPDX-License-Identifier: GPL-3.0-or-later
// Pictures: march, deferred shading and compositing, a tile of pixels at a time.
#pragma once

#include "march.hpp"

namespace holoreel {
namespace videorf {

constexpr int kGroup = 8;         // rays that are shaded at once
constexpr int kMaxUnits = 256;  // inputs or outputs of a layer
constexpr int kTile = 8;         // pixels: rays of a tile meet the same bricks

using Shade = void (*)(const VideorfNetwork&, const float* accumulated, int channels, const float* directions, float* colors);

Shade wide_shade();  // null where the processor family has no wider vectors
Shade narrow_shade();

// Throws std::invalid_argument for a network or view that cannot be.
void check(const VideorfNetwork& network, int channels);
void check(const VideorfView& view);
void draw(const Volume& volume, const float* table, int channels, const VideorfNetwork& network, const VideorfView& view,
          const MarchKernels& kernels, Shade shade, const VideorfPicture& picture);

}  // namespace videorf
}  // namespace holoreel
