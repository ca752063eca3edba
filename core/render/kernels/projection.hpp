// SPDX-License-Identifier: GPL-3.0-or-later
// EWA projection of 3D Gaussians to one pinhole camera, forward and backward, in double precision.
#pragma once

#include <cmath>

#include "spacetime.hpp"

namespace holoreel {

struct View {
    double fx, fy, cx, cy;
    double rotation[9], translation[3];
    double min_x, max_x, min_y, max_y;  // of x/z and y/z in the Jacobian
    double width, height;

    View(const HoloreelCamera& camera, const HoloreelRules& rules);
};

// Gaussians on the image. With d = pixel - mean and w = W d, the falloff is exp(-|w|² / 2); W = [w11 w12; 0 w22] whitens
// the 2D covariance. Distances are measured in whitened coordinates because those stay of order one even where the
// covariance is nearly singular, so single precision is enough per pixel.
template <class T>
struct SplatOf {
    T x, y, depth;
    T cov_xx, cov_xy, cov_yy;  // low pass included
    T w11, w12, w22;
};
using Splats = SplatOf<D>;
using Splat = SplatOf<double>;

inline Splat splat_at(const Splats& s, int lane) {
    return {s.x[lane],      s.y[lane],   s.depth[lane], s.cov_xx[lane], s.cov_xy[lane],
            s.cov_yy[lane], s.w11[lane], s.w12[lane],   s.w22[lane]};
}

struct SplatGradient {
    D x, y, depth;
    D cov_xx, cov_xy, cov_yy;  // of the symmetric matrix: an off-diagonal entry counts twice in the loss
};

constexpr double kMinQuatNorm = 1e-12;  // under this a quaternion means no rotation

struct Rotation {
    D w, x, y, z, norm;  // normalized
    D m[9];
    Mask defined;
};

inline Rotation rotation_of(const D* q) {
    Rotation r;
    r.norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    r.defined = ~(r.norm < all(kMinQuatNorm));  // so that NaN stays NaN
    const D s = r.defined ? 1.0 / r.norm : all(0.0);
    const D w = r.defined ? q[0] * s : all(1.0), x = q[1] * s, y = q[2] * s, z = q[3] * s;
    r.w = w, r.x = x, r.y = y, r.z = z;
    const D m[9] = {1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z),       2.0 * (x * z + w * y),
                    2.0 * (x * y + w * z),       1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
                    2.0 * (x * z - w * y),       2.0 * (y * z + w * x),       1.0 - 2.0 * (x * x + y * y)};
    for (int k = 0; k < 9; k++) r.m[k] = m[k];
    return r;
}

// dL/dquat from dL/d(rotation matrix).
inline void rotation_backward(const Rotation& r, const D* d, D* d_quat) {
    const D w = r.w, x = r.x, y = r.y, z = r.z;
    const D g[4] = {
        2.0 * (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1])),
        2.0 * (w * (d[7] - d[5]) + y * (d[1] + d[3]) + z * (d[2] + d[6]) - 2.0 * x * (d[4] + d[8])),
        2.0 * (w * (d[2] - d[6]) + x * (d[1] + d[3]) + z * (d[5] + d[7]) - 2.0 * y * (d[0] + d[8])),
        2.0 * (w * (d[3] - d[1]) + x * (d[2] + d[6]) + y * (d[5] + d[7]) - 2.0 * z * (d[0] + d[4])),
    };
    const D unit[4] = {w, x, y, z};
    const D along = g[0] * w + g[1] * x + g[2] * y + g[3] * z;
    const D inverse = 1.0 / r.norm;
    for (int k = 0; k < 4; k++) d_quat[k] = r.defined ? (g[k] - along * unit[k]) * inverse : all(0.0);
}

// What forward and backward share: cov2d = B Bᵀ + low_pass I, B = T M, T = J V, M = R S.
struct Chain {
    D cam[3];               // mean in camera space
    D iz;                   // 1 / z
    Mask inside_x, inside_y;  // x/z and y/z are not clamped
    D j00, j02, j11, j12;
    D T[6], M[9], B[6];
    Rotation rotation;
};

inline void to_camera(const Instant& g, const View& view, D* cam) {
    const double* V = view.rotation;
    for (int r = 0; r < 3; r++)
        cam[r] = V[3 * r] * g.mean[0] + V[3 * r + 1] * g.mean[1] + V[3 * r + 2] * g.mean[2] + view.translation[r];
}

inline void build(const Instant& g, const View& view, Chain& c) {
    const double* V = view.rotation;
    c.iz = 1.0 / c.cam[2];
    const D tx = c.cam[0] * c.iz, ty = c.cam[1] * c.iz;
    const D tan_x = clamp(tx, view.min_x, view.max_x), tan_y = clamp(ty, view.min_y, view.max_y);
    c.inside_x = tan_x == tx;
    c.inside_y = tan_y == ty;
    c.j00 = view.fx * c.iz;
    c.j02 = -view.fx * tan_x * c.iz;
    c.j11 = view.fy * c.iz;
    c.j12 = -view.fy * tan_y * c.iz;
    for (int k = 0; k < 3; k++) {
        c.T[k] = c.j00 * V[k] + c.j02 * V[6 + k];
        c.T[3 + k] = c.j11 * V[3 + k] + c.j12 * V[6 + k];
    }
    c.rotation = rotation_of(g.quat);
    for (int r = 0; r < 3; r++)
        for (int k = 0; k < 3; k++) c.M[3 * r + k] = c.rotation.m[3 * r + k] * g.scale[k];
    for (int r = 0; r < 2; r++)
        for (int k = 0; k < 3; k++)
            c.B[3 * r + k] = c.T[3 * r] * c.M[k] + c.T[3 * r + 1] * c.M[3 + k] + c.T[3 * r + 2] * c.M[6 + k];
}

inline View::View(const HoloreelCamera& camera, const HoloreelRules& rules)
    : fx(camera.fx), fy(camera.fy), cx(camera.cx), cy(camera.cy), width(camera.width), height(camera.height) {
    for (int r = 0; r < 3; r++) {
        for (int k = 0; k < 3; k++) rotation[3 * r + k] = camera.world_to_camera[4 * r + k];
        translation[r] = camera.world_to_camera[4 * r + 3];
    }
    const double margin = 0.5 * (rules.jacobian_clamp - 1.0);
    min_x = (-margin * width - cx) / fx;
    max_x = ((1.0 + margin) * width - cx) / fx;
    min_y = (-margin * height - cy) / fy;
    max_y = ((1.0 + margin) * height - cy) / fy;
}

// Returns the lanes that can be drawn: not nearer than `near`, and with a covariance that is finite and can be inverted.
inline Mask project(const Instant& instant, const View& view, const HoloreelRules& rules, Splats& out) {
    Chain c;
    to_camera(instant, view, c.cam);
    const D z = c.cam[2];
    const Mask front = (z >= all(rules.near_plane)) & (z > all(0.0));
    if (!any(front)) return front;
    build(instant, view, c);
    const D* B = c.B;
    out.cov_xx = B[0] * B[0] + B[1] * B[1] + B[2] * B[2] + rules.low_pass;
    out.cov_xy = B[0] * B[3] + B[1] * B[4] + B[2] * B[5];
    out.cov_yy = B[3] * B[3] + B[4] * B[4] + B[5] * B[5] + rules.low_pass;
    const D determinant = out.cov_xx * out.cov_yy - out.cov_xy * out.cov_xy;
    const Mask good = front & (determinant > all(0.0)) & finite(determinant);
    out.w22 = 1.0 / sqrt(out.cov_yy);
    out.w11 = sqrt(out.cov_yy / determinant);
    out.w12 = -out.w11 * out.cov_xy * (out.w22 * out.w22);
    out.x = c.j00 * c.cam[0] + view.cx;
    out.y = c.j11 * c.cam[1] + view.cy;
    out.depth = z;
    return good & finite(out.x + out.y + out.w11 + out.w12 + out.w22);
}

// Fills all of `out` but the opacity.
inline void project_backward(const Instant& instant, const View& view, const SplatGradient& d, InstantGradient& out) {
    Chain c;
    to_camera(instant, view, c.cam);
    build(instant, view, c);
    const double* V = view.rotation;

    D d_B[6], d_T[6], d_M[9];
    for (int k = 0; k < 3; k++) {
        d_B[k] = 2.0 * (d.cov_xx * c.B[k] + d.cov_xy * c.B[3 + k]);
        d_B[3 + k] = 2.0 * (d.cov_xy * c.B[k] + d.cov_yy * c.B[3 + k]);
    }
    for (int r = 0; r < 2; r++)
        for (int k = 0; k < 3; k++)
            d_T[3 * r + k] = d_B[3 * r] * c.M[3 * k] + d_B[3 * r + 1] * c.M[3 * k + 1] + d_B[3 * r + 2] * c.M[3 * k + 2];
    for (int r = 0; r < 3; r++)
        for (int k = 0; k < 3; k++) d_M[3 * r + k] = c.T[r] * d_B[k] + c.T[3 + r] * d_B[3 + k];

    D d_rotation[9];
    for (int k = 0; k < 3; k++) {
        out.scale[k] = all(0.0);
        for (int r = 0; r < 3; r++) {
            out.scale[k] += d_M[3 * r + k] * c.rotation.m[3 * r + k];
            d_rotation[3 * r + k] = d_M[3 * r + k] * instant.scale[k];
        }
    }
    rotation_backward(c.rotation, d_rotation, out.quat);

    D d_j00 = all(0.0), d_j02 = all(0.0), d_j11 = all(0.0), d_j12 = all(0.0);
    for (int k = 0; k < 3; k++) {
        d_j00 += d_T[k] * V[k];
        d_j02 += d_T[k] * V[6 + k];
        d_j11 += d_T[3 + k] * V[3 + k];
        d_j12 += d_T[3 + k] * V[6 + k];
    }
    // The mean itself is projected without the clamp; the Jacobian's tangents are clamped.
    const D zero = all(0.0), iz = c.iz;
    const D d_tan_x = d.x * view.fx - (c.inside_x ? d_j02 * view.fx * iz : zero);
    const D d_tan_y = d.y * view.fy - (c.inside_y ? d_j12 * view.fy * iz : zero);
    D d_cam[3];
    d_cam[0] = d_tan_x * iz;
    d_cam[1] = d_tan_y * iz;
    d_cam[2] = d.depth - iz * (d_tan_x * c.cam[0] * iz + d_tan_y * c.cam[1] * iz) -
               iz * (d_j00 * c.j00 + d_j02 * c.j02 + d_j11 * c.j11 + d_j12 * c.j12);
    for (int k = 0; k < 3; k++) out.mean[k] = V[k] * d_cam[0] + V[3 + k] * d_cam[1] + V[6 + k] * d_cam[2];
}

}  // namespace holoreel
