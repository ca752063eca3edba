// SPDX-License-Identifier: GPL-3.0-or-later
// What the forward and the backward pass over a tile share. Both take every decision (is alpha large enough, is the pixel
// full) from the very same operations, so they always agree.
#pragma once

#include "raster.hpp"
#include "simd.hpp"

namespace holoreel {
namespace HOLOREEL_NAMESPACE {

constexpr int kGroups = kTile / kLanes;  // vectors per row
constexpr int kVectors = kTile * kGroups;
constexpr int kCheckEvery = 16;  // Gaussians between looks at whether the whole tile is full
constexpr int kPrefetch = 6;

struct Tile {
    int x, y, rows, columns;  // origin and size in pixels
    int width;
    int64_t begin, end;  // its entries

    Tile(const TileJob& job, int tile) {
        x = tile % job.tiles_x * kTile;
        y = tile / job.tiles_x * kTile;
        rows = job.height - y < kTile ? job.height - y : kTile;
        columns = job.width - x < kTile ? job.width - x : kTile;
        width = job.width;
        begin = job.tile_begin[tile];
        end = job.tile_begin[tile + 1];
    }
    int lanes_inside(int k) const {
        const int n = columns - k % kGroups * kLanes;
        return n < 0 ? 0 : n > kLanes ? kLanes : n;
    }
    int64_t pixel(int k) const { return static_cast<int64_t>(y + k / kGroups) * width + x + k % kGroups * kLanes; }
    // `value` on the lanes of vector k that lie in the picture, 0 on the others.
    F inside(int k, F value) const {
        float values[kLanes];
        store(values, value);
        for (int lane = lanes_inside(k); lane < kLanes; lane++) values[lane] = 0.0f;
        return load(values);
    }
};

template <int C>
HOLOREEL_INLINE const Record& record_at(const TileJob& job, int64_t e) {
    return *reinterpret_cast<const Record*>(job.records + static_cast<int64_t>(job.entries[e].gaussian) * record_stride(C));
}

template <int C>
HOLOREEL_INLINE void prefetch_record(const TileJob& job, int64_t e) {
    const Record& record = record_at<C>(job, e);
    __builtin_prefetch(&record);
    if (record_stride(C) > 16) __builtin_prefetch(reinterpret_cast<const float*>(&record) + record_stride(C) - 1);
}

HOLOREEL_INLINE float float_of_bits(uint32_t bits) {
    float value;
    __builtin_memcpy(&value, &bits, 4);
    return value;
}

HOLOREEL_INLINE int clamp_int(float x, int low, int high) {
    return x <= static_cast<float>(low) ? low : x >= static_cast<float>(high) ? high : static_cast<int>(x);
}

// The rows and the groups of columns of a tile that a Gaussian may touch (half-open ranges).
struct Touched {
    int row_begin, row_end, group_begin, group_end;

    HOLOREEL_INLINE_MEMBER Touched(const Record& record, const Tile& t) {
        const float x = static_cast<float>(record.x - t.x), y = static_cast<float>(record.y - t.y);
        const float radius_x = float_of_bits(record.radii & 0xffff0000u), radius_y = float_of_bits(record.radii << 16);
        // Pixel r has its center at r + 0.5, so the first touched row is ceil(y - radius - 0.5).
        row_begin = clamp_int(y - radius_y + 0.5f, 0, t.rows);
        row_end = clamp_int(y + radius_y + 0.5f, 0, t.rows);
        group_begin = clamp_int((x - radius_x + 0.5f) * (1.0f / kLanes), 0, kGroups);
        group_end = clamp_int((x + radius_x + 0.5f + (kLanes - 1)) * (1.0f / kLanes), 0, kGroups);
    }
};

// log2(alpha) along one group of columns, row after row. The offset of the group's center is followed in double.
struct Falloff {
    double u, v, u_step, v_step;
    F slope;
    float log2_opacity;
    F u_now;
    float v_now;

    HOLOREEL_INLINE_MEMBER Falloff(const Record& record, const Tile& t, int group, int row) {
        const double dx = t.x + (group * kLanes + kLanes / 2) - record.x, dy = t.y + (row + 0.5) - record.y;
        u = record.w11 * dx + record.w12 * dy;
        v = record.w22 * dy;
        u_step = record.w12;
        v_step = record.w22;
        slope = mul(set1(static_cast<float>(record.w11)), centers());
        log2_opacity = record.log2_opacity;
    }
    HOLOREEL_INLINE_MEMBER void next_row() {
        u += u_step;
        v += v_step;
    }
    HOLOREEL_INLINE_MEMBER F log2_alpha() {
        u_now = add(set1(static_cast<float>(u)), slope);
        v_now = static_cast<float>(v);
        return fnma(u_now, u_now, set1(log2_opacity - v_now * v_now));
    }
};

HOLOREEL_INLINE bool any_live(const F* transmittance, int count) {
    F most = transmittance[0];
    for (int k = 1; k < count; k++) most = max(most, transmittance[k]);
    return any(gt(most, set1(0.0f)));
}

}  // namespace HOLOREEL_NAMESPACE
}  // namespace holoreel
