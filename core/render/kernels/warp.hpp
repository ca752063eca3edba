// SPDX-License-Identifier: GPL-3.0-or-later
// A pinhole's picture seen through a lens: bicubic samples at given places, forward and backward. `api.hpp` says what it
// computes.
#pragma once

#include "api.hpp"
#include "raster.hpp"

namespace holoreel {

void warp_spans(const HoloreelWarp& warp, const WarpKernels& kernels, int32_t* spans);
void warp(const HoloreelWarp& warp, const WarpKernels& kernels, const float* source, float* image);
void warp_backward(const HoloreelWarp& warp, const WarpKernels& kernels, const float* image_gradient,
                   float* source_gradient);

}  // namespace holoreel
