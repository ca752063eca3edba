// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cstdint>

namespace holoreel {

// The second picture of a loss: values, or bytes that stand for 255ths. One of the two is null.
struct Target {
    const float* values;
    const uint8_t* bytes;
};

struct Loss {
    double value;           // (1 - weight) mean|image - target| + weight (1 - mean SSIM)
    double squared_error;   // mean (image - target)²
};

// The loss of two (H, W, C) images; its gradient with respect to `image` where `gradient` is not null. The same for any
// number of threads.
Loss l1_dssim(const float* image, const Target& target, int height, int width, int channels, double weight,
              float* gradient);

}  // namespace holoreel
