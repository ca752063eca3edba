// SPDX-License-Identifier: GPL-3.0-or-later
// One Gaussian at one time: Eqs. 6-9 of Spacetime Gaussians, forward and backward, in double precision.
#pragma once

#include "api.hpp"

namespace holoreel {

// A 3D Gaussian in the world. `quat` is as given (w x y z, not normalized).
struct Instant {
    double mean[3], quat[4], scale[3], opacity;
};

// Gradient of the loss with respect to an Instant.
struct InstantGradient {
    double mean[3], quat[4], scale[3], opacity;
};

// Reads row `i`. False where the row is skipped: opacity under `alpha_min`, or a parameter that is not finite.
// An infinite `trbf_log_scale` is allowed: such a Gaussian is always on.
bool evaluate(const HoloreelGaussians& gaussians, int64_t i, const HoloreelRules& rules, Instant& out);

// Writes row `i` of every parameter gradient except `features`.
void evaluate_backward(const HoloreelGaussians& gaussians, int64_t i, const HoloreelRules& rules, const Instant& instant,
                       const InstantGradient& gradient, const HoloreelGradients& out);

}  // namespace holoreel
