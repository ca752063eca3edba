// SPDX-License-Identifier: GPL-3.0-or-later
// The decoder of full models: a small network per pixel, forward and backward. `api.hpp` says what it computes.
#pragma once

#include "api.hpp"
#include "raster.hpp"

namespace holoreel {

void decode(const HoloreelCamera& camera, const HoloreelDecoder& decoder, const DecodeKernels& kernels,
            const float* features, float* image);

// The gradients of the weights are written always, that of the features where it is not null.
void decode_backward(const HoloreelCamera& camera, const HoloreelDecoder& decoder, const DecodeKernels& kernels,
                     const float* features, const float* image_gradient, float* features_gradient,
                     float* hidden_gradient, float* output_gradient);

}  // namespace holoreel
