// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

namespace holoreel {

// (1 - weight) mean|image - target| + weight (1 - mean SSIM) of two (H, W, C) images; its gradient with respect to `image`
// where `gradient` is not null. The same for any number of threads.
double l1_dssim(const float* image, const float* target, int height, int width, int channels, double weight,
                float* gradient);

}  // namespace holoreel
