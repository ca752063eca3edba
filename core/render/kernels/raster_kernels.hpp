// SPDX-License-Identifier: GPL-3.0-or-later
// The table of one width's kernels. Included once by each width's translation unit.
#pragma once

#include "decode_row.hpp"
#include "raster_backward.hpp"
#include "raster_forward.hpp"
#include "warp_row.hpp"

namespace holoreel {
namespace HOLOREEL_NAMESPACE {

#define HOLOREEL_EACH_WIDTH(KERNEL)                          \
    switch (padded_channels) {                               \
        case 1: return with_depth ? KERNEL<1, true> : KERNEL<1, false>;    \
        case 3: return with_depth ? KERNEL<3, true> : KERNEL<3, false>;    \
        case 4: return with_depth ? KERNEL<4, true> : KERNEL<4, false>;    \
        case 9: return with_depth ? KERNEL<9, true> : KERNEL<9, false>;    \
        case 16: return with_depth ? KERNEL<16, true> : KERNEL<16, false>; \
        default: return nullptr;                             \
    }

static TileKernel choose_forward(int padded_channels, bool with_depth) { HOLOREEL_EACH_WIDTH(forward_tile) }
static TileKernel choose_backward(int padded_channels, bool with_depth) { HOLOREEL_EACH_WIDTH(backward_tile) }

#undef HOLOREEL_EACH_WIDTH

static const RasterKernels kernels = {
    kLanes, choose_forward, choose_backward, {decode_row, decode_row_backward}, {warp_spans, warp_forward, warp_backward}};

}  // namespace HOLOREEL_NAMESPACE
}  // namespace holoreel
