// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include <cstdint>

namespace holoreel {

// One step of Adam (Kingma and Ba 2015, with bias correction) on flat arrays, in place. `step` counts from 1.
void adam_step(float* values, const float* gradient, float* mean, float* mean_square, int64_t count, double rate,
               double beta1, double beta2, double epsilon, int64_t step);

}  // namespace holoreel
