// SPDX-License-Identifier: GPL-3.0-or-later
// One Gaussian at one time: Eqs. 6-9 of Spacetime Gaussians, forward and backward, in double precision.
#pragma once

#include <cmath>

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

constexpr double kMinLogWidth = -40.0;  // narrower than any time step; keeps 1 / width² finite

inline double sigmoid(double x) { return 1.0 / (1.0 + std::exp(-x)); }

struct TemporalBasis {
    double dt, inverse_width, u, value;  // value = exp(-u²), u = dt / width (Eq. 7)
};

inline TemporalBasis temporal_basis(const HoloreelGaussians& g, int64_t i) {
    TemporalBasis basis;
    basis.dt = g.time - g.trbf_centers[i];
    const double log_width = g.trbf_log_scales[i];
    basis.inverse_width = std::exp(-(log_width < kMinLogWidth ? kMinLogWidth : log_width));
    basis.u = basis.dt * basis.inverse_width;
    basis.value = std::exp(-basis.u * basis.u);
    return basis;
}

// NaN where any of the values is not finite, else 0.
template <int K>
inline float poison(const float* values) {
    float sum = 0.0f;
    for (int k = 0; k < K; k++) sum += values[k] * 0.0f;
    return sum;
}

inline float row_poison(const HoloreelGaussians& g, int64_t i) {
    float sum = poison<3>(g.means + 3 * i) + poison<4>(g.quats + 4 * i) + poison<3>(g.scales + 3 * i);
    for (int c = 0; c < g.channels; c++) sum += g.features[i * g.channels + c] * 0.0f;
    if (g.spacetime) sum += poison<9>(g.motions + 9 * i) + poison<4>(g.omegas + 4 * i);
    return sum + g.opacities[i] * 0.0f;
}

inline void store(float* target, int64_t i, int width, const double* values) {
    if (!target) return;
    for (int k = 0; k < width; k++) target[i * width + k] = static_cast<float>(values[k]);
}

// Reads row `i`. False where the row is skipped: opacity under `alpha_min`, or a parameter that is not finite.
// An infinite `trbf_log_scale` is allowed: such a Gaussian is always on.
inline bool evaluate(const HoloreelGaussians& g, int64_t i, const HoloreelRules& rules, Instant& out) {
    TemporalBasis basis{};
    if (g.spacetime) {
        basis = temporal_basis(g, i);
        out.opacity = sigmoid(g.opacities[i]) * basis.value;
    } else {
        out.opacity = g.opacities[i];
    }
    // Written so that a NaN is skipped too. What the time has faded out costs nothing beyond this line.
    if (!(out.opacity >= rules.alpha_min)) return false;
    if (row_poison(g, i) != 0.0f) return false;

    for (int k = 0; k < 3; k++) out.mean[k] = g.means[3 * i + k];
    for (int k = 0; k < 4; k++) out.quat[k] = g.quats[4 * i + k];
    if (!g.spacetime) {
        for (int k = 0; k < 3; k++) out.scale[k] = g.scales[3 * i + k];
        return true;
    }
    const double dt = basis.dt;
    const float* b = g.motions + 9 * i;
    for (int k = 0; k < 3; k++) out.mean[k] += dt * (b[k] + dt * (b[3 + k] + dt * b[6 + k]));  // Eq. 8
    for (int k = 0; k < 4; k++) out.quat[k] += dt * g.omegas[4 * i + k];                       // Eq. 9
    for (int k = 0; k < 3; k++) out.scale[k] = std::exp(static_cast<double>(g.scales[3 * i + k]));
    return true;
}

// Writes row `i` of every parameter gradient except `features`.
inline void evaluate_backward(const HoloreelGaussians& g, int64_t i, const HoloreelRules& rules, const Instant& instant,
                       const InstantGradient& d, const HoloreelGradients& out) {
    store(out.means, i, 3, d.mean);
    store(out.quats, i, 4, d.quat);
    if (!g.spacetime) {
        store(out.scales, i, 3, d.scale);
        store(out.opacities, i, 1, &d.opacity);
        return;
    }
    const TemporalBasis basis = temporal_basis(g, i);
    const double dt = basis.dt;
    const float* b = g.motions + 9 * i;
    double d_motion[9], d_omega[4], d_log_scale[3], d_dt = 0.0;
    for (int k = 0; k < 3; k++) {
        d_motion[k] = d.mean[k] * dt;
        d_motion[3 + k] = d.mean[k] * dt * dt;
        d_motion[6 + k] = d.mean[k] * dt * dt * dt;
        d_dt += d.mean[k] * (b[k] + dt * (2.0 * b[3 + k] + dt * 3.0 * b[6 + k]));
        d_log_scale[k] = d.scale[k] * instant.scale[k];
    }
    for (int k = 0; k < 4; k++) {
        d_omega[k] = d.quat[k] * dt;
        d_dt += d.quat[k] * g.omegas[4 * i + k];
    }
    if (rules.detach_motion_time) d_dt = 0.0;

    const double occupancy = sigmoid(g.opacities[i]);
    const double d_logit = d.opacity * basis.value * occupancy * (1.0 - occupancy);
    const double d_basis = d.opacity * occupancy * basis.value;  // times the derivative of -u²
    d_dt += d_basis * -2.0 * basis.u * basis.inverse_width;
    const double d_center = -d_dt;
    const double d_log_width = g.trbf_log_scales[i] < kMinLogWidth ? 0.0 : d_basis * 2.0 * basis.u * basis.u;

    store(out.motions, i, 9, d_motion);
    store(out.omegas, i, 4, d_omega);
    store(out.scales, i, 3, d_log_scale);
    store(out.opacities, i, 1, &d_logit);
    store(out.trbf_centers, i, 1, &d_center);
    store(out.trbf_log_scales, i, 1, &d_log_width);
}

}  // namespace holoreel
