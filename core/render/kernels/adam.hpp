// SPDX-License-Identifier: GPL-3.0-or-later
#pragma once

#include "api.hpp"

namespace holoreel {

// One step of Adam (Kingma and Ba 2015, with bias correction) on all groups, in place. `step` counts from 1.
void adam_step(const HoloreelAdamGroup* groups, int64_t count, double beta1, double beta2, double epsilon, int64_t step);

}  // namespace holoreel
