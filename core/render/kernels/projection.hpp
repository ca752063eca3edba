// SPDX-License-Identifier: GPL-3.0-or-later
// EWA projection of one 3D Gaussian to one pinhole camera, forward and backward, in double precision.
#pragma once

#include "spacetime.hpp"

namespace holoreel {

struct View {
    double fx, fy, cx, cy;
    double rotation[9], translation[3];
    double limit_x, limit_y;  // of x/z and y/z in the Jacobian
    double width, height;

    View(const HoloreelCamera& camera, const HoloreelRules& rules);
};

// A Gaussian on the image. With d = pixel - mean and w = W d, the falloff is exp(-|w|² / 2); W = [w11 w12; 0 w22] whitens
// the 2D covariance. Distances are measured in whitened coordinates because those stay of order one even where the
// covariance is nearly singular, so single precision is enough per pixel.
struct Splat {
    double x, y, depth;
    double cov_xx, cov_xy, cov_yy;  // low pass included
    double w11, w12, w22;
};

struct SplatGradient {
    double x, y, depth;
    double cov_xx, cov_xy, cov_yy;  // of the symmetric matrix: an off-diagonal entry counts twice in the loss
};

// False where the Gaussian is nearer than `near`, or its covariance cannot be inverted or is not finite.
bool project(const Instant& instant, const View& view, const HoloreelRules& rules, Splat& out);

// Fills all of `out` but the opacity.
void project_backward(const Instant& instant, const View& view, const SplatGradient& gradient, InstantGradient& out);

}  // namespace holoreel
