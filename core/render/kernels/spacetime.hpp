// SPDX-License-Identifier: GPL-3.0-or-later
// Gaussians at one time: Eqs. 6-9 of Spacetime Gaussians, forward and backward, in double precision.
#pragma once

#include "api.hpp"
#include "rows.hpp"

namespace holoreel {

// 3D Gaussians in the world. `quat` is as given (w x y z, not normalized).
struct Instant {
    D mean[3], quat[4], scale[3], opacity;
    D dt, inverse_width, u, temporal;  // temporal = exp(-u²), u = dt / width (Eq. 7)
    D occupancy;                       // the opacity without its temporal part
};

// Gradient of the loss with respect to an Instant.
struct InstantGradient {
    D mean[3], quat[4], scale[3], opacity;
};

constexpr double kMinLogWidth = -40.0;  // narrower than any time step; keeps 1 / width² finite

// NaN where any of the values is not finite, else 0.
template <int K>
inline D poison(const D* values) {
    D sum = all(0.0);
    for (int k = 0; k < K; k++) sum += values[k] * 0.0;
    return sum;
}

inline D feature_poison(const HoloreelGaussians& g, const RowSet& rows) {
    D sum = all(0.0);
    for (int lane = 0; lane < kRows; lane++) {
        const float* features = g.features + rows.rows[lane] * g.channels;
        float total = 0.0f;
        for (int c = 0; c < g.channels; c++) total += features[c] * 0.0f;
        sum[lane] = total;
    }
    return sum;
}

// Fills u and what it is made of (Eq. 7).
inline void time_basis(const HoloreelGaussians& g, const RowSet& rows, Instant& out) {
    D center, log_width;
    rows.load<1>(g.trbf_centers, &center);
    rows.load<1>(g.trbf_log_scales, &log_width);
    out.dt = g.time - center;
    out.inverse_width = exp(-(log_width < all(kMinLogWidth) ? all(kMinLogWidth) : log_width));
    out.u = out.dt * out.inverse_width;
}

// The lanes that may be seen at this time: where even a wholly opaque Gaussian has not faded under `alpha_min`. All that
// `evaluate` lets through is among them; what is not costs nothing beyond this.
inline Mask may_be_seen(const HoloreelGaussians& g, const RowSet& rows, double fade_limit) {
    Instant instant;
    time_basis(g, rows, instant);
    return instant.u * instant.u <= all(fade_limit);
}

// Fills the opacity and what it is made of; returns the lanes that can be seen. The others are under `alpha_min`, or
// without `cull_faded` zero; a NaN is never seen.
inline Mask fade(const HoloreelGaussians& g, const RowSet& rows, const HoloreelRules& rules, Instant& out) {
    rows.load<1>(g.opacities, &out.opacity);
    if (g.spacetime) {
        time_basis(g, rows, out);
        out.temporal = exp(-out.u * out.u);
        out.occupancy = 1.0 / (1.0 + exp(-out.opacity));
        out.opacity = out.occupancy * out.temporal;
    }
    return rules.cull_faded ? out.opacity >= all(rules.alpha_min) : out.opacity > all(0.0);
}

// Reads rows; returns the lanes that can be seen and have no parameter that is not finite; but an infinite
// `trbf_log_scale` is allowed: such a Gaussian is always on. Where no lane can be seen, `out` is not whole.
inline Mask evaluate(const HoloreelGaussians& g, const RowSet& rows, const HoloreelRules& rules, Instant& out) {
    const Mask alive = fade(g, rows, rules, out);
    if (!any(alive)) return alive;

    D opacity;
    rows.load<1>(g.opacities, &opacity);
    rows.load<3>(g.means, out.mean);
    rows.load<4>(g.quats, out.quat);
    rows.load<3>(g.scales, out.scale);
    D bad = poison<3>(out.mean) + poison<4>(out.quat) + poison<3>(out.scale) + poison<1>(&opacity) + feature_poison(g, rows);
    if (g.spacetime) {
        D b[9], omega[4];
        rows.load<9>(g.motions, b);
        rows.load<4>(g.omegas, omega);
        bad += poison<9>(b) + poison<4>(omega);
        const D dt = out.dt;
        for (int k = 0; k < 3; k++) out.mean[k] += dt * (b[k] + dt * (b[3 + k] + dt * b[6 + k]));  // Eq. 8
        for (int k = 0; k < 4; k++) out.quat[k] += dt * omega[k];                                  // Eq. 9
        for (int k = 0; k < 3; k++) out.scale[k] = exp(out.scale[k]);
    }
    return alive & (bad == all(0.0));
}

// Writes every parameter gradient except `features`, on the lanes in `wanted`.
inline void evaluate_backward(const HoloreelGaussians& g, const RowSet& rows, const HoloreelRules& rules,
                              const Instant& instant, const InstantGradient& d, Mask wanted,
                              const HoloreelGradients& out) {
    rows.store<3>(out.means, d.mean, wanted);
    rows.store<4>(out.quats, d.quat, wanted);
    if (!g.spacetime) {
        rows.store<3>(out.scales, d.scale, wanted);
        rows.store<1>(out.opacities, &d.opacity, wanted);
        return;
    }
    const D dt = instant.dt;
    D b[9], omega[4], log_width;
    rows.load<9>(g.motions, b);
    rows.load<4>(g.omegas, omega);
    rows.load<1>(g.trbf_log_scales, &log_width);
    D d_motion[9], d_omega[4], d_log_scale[3], d_dt = all(0.0);
    for (int k = 0; k < 3; k++) {
        d_motion[k] = d.mean[k] * dt;
        d_motion[3 + k] = d_motion[k] * dt;
        d_motion[6 + k] = d_motion[3 + k] * dt;
        d_dt += d.mean[k] * (b[k] + dt * (2.0 * b[3 + k] + dt * 3.0 * b[6 + k]));
        d_log_scale[k] = d.scale[k] * instant.scale[k];
    }
    for (int k = 0; k < 4; k++) {
        d_omega[k] = d.quat[k] * dt;
        d_dt += d.quat[k] * omega[k];
    }
    if (rules.detach_motion_time) d_dt = all(0.0);

    const D d_logit = d.opacity * instant.opacity * (1.0 - instant.occupancy);
    const D d_basis = d.opacity * instant.opacity;  // times the derivative of -u²
    d_dt -= 2.0 * d_basis * instant.u * instant.inverse_width;
    const D d_center = -d_dt;
    const D d_log_width = log_width < all(kMinLogWidth) ? all(0.0) : 2.0 * d_basis * instant.u * instant.u;

    rows.store<9>(out.motions, d_motion, wanted);
    rows.store<4>(out.omegas, d_omega, wanted);
    rows.store<3>(out.scales, d_log_scale, wanted);
    rows.store<1>(out.opacities, &d_logit, wanted);
    rows.store<1>(out.trbf_centers, &d_center, wanted);
    rows.store<1>(out.trbf_log_scales, &d_log_width, wanted);
}

}  // namespace holoreel
