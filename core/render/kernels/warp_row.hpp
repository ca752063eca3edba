// SPDX-License-Identifier: GPL-3.0-or-later
// Bicubic samples of an interleaved picture: a block of pixels' taps at once, then one sample after the other, with the
// channels side by side in vectors. Included by the translation units of both widths.
#pragma once

#include "raster.hpp"
#include "simd.hpp"

namespace holoreel {
namespace HOLOREEL_NAMESPACE {

constexpr int kMaxTaps = kWarpBlock * kMaxWarpSamples * kMaxWarpSamples;

// Of each sample of a block: the first of its 4 x 4 pixels, and the weights of its columns and rows.
struct Taps {
    int32_t x[kMaxTaps], y[kMaxTaps];
    float wx[4][kMaxTaps], wy[4][kMaxTaps];
};

HOLOREEL_INLINE int32_t floor_of(float t) {
    const int32_t n = static_cast<int32_t>(t);
    return n - (t < static_cast<float>(n));
}

// Keys' kernel with a = -3/4, as torch has it, at a position `t` in [0, 1) between the second and the third tap.
HOLOREEL_INLINE void cubic_weights(float t, float (*out)[kMaxTaps], int k) {
    constexpr float a = -0.75f;
    const float s = 1.0f - t;
    out[0][k] = a * t * s * s;
    out[1][k] = ((a + 2.0f) * t - (a + 3.0f)) * t * t + 1.0f;
    out[2][k] = ((a + 2.0f) * s - (a + 3.0f)) * s * s + 1.0f;
    out[3][k] = a * s * t * t;
}

// One coordinate of a sample, interpolated between the pixels' own. Distances to a whole number near by are taken first:
// those are small and exact, where positions of a large picture would lose digits.
HOLOREEL_INLINE void find_tap(float middle, float aside, float above, float across, float dx, float dy, int32_t* first,
                              float (*weights)[kMaxTaps], int k) {
    const int32_t whole = floor_of(middle);
    const float base = static_cast<float>(whole);
    const float near = (middle - base) * (1.0f - dx) + (aside - base) * dx;
    const float far = (above - base) * (1.0f - dx) + (across - base) * dx;
    const float t = near * (1.0f - dy) + far * dy - 0.5f;
    const int32_t n = floor_of(t);
    first[k] = whole + n - 1;
    cubic_weights(t - static_cast<float>(n), weights, k);
}

// The taps of `count` pixels of a row, from `begin` on: those of sample s of pixel p at
// [s * kWarpBlock + p]. The compiler turns the inner loop into vectors.
static void find_taps(const WarpJob& job, int row, int begin, int count, Taps& __restrict taps) {
    const int n = job.samples;
    const int64_t pitch = 2 * (static_cast<int64_t>(job.width) + 2);
    const float* places = job.places + (row + 1) * pitch + 2 * (begin + 1);
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++) {
            const float down = (i + 0.5f) / n - 0.5f, right = (j + 0.5f) / n - 0.5f;
            const int64_t to_row = down < 0 ? -pitch : pitch, to_column = right < 0 ? -2 : 2;
            const float dy = down < 0 ? -down : down, dx = right < 0 ? -right : right;
            for (int p = 0; p < count; p++) {
                const float* m = places + 2 * p;
                const int k = (i * n + j) * kWarpBlock + p;
                find_tap(m[0], m[to_column], m[to_row], m[to_row + to_column], dx, dy, taps.x, taps.wx, k);
                find_tap(m[1], m[to_column + 1], m[to_row + 1], m[to_row + to_column + 1], dx, dy, taps.y, taps.wy, k);
            }
        }
    }
}

HOLOREEL_INLINE int block_pixels(const WarpJob& job, int begin) {
    return job.width - begin < kWarpBlock ? job.width - begin : kWarpBlock;
}

HOLOREEL_INLINE bool any_valid(const uint8_t* valid, int count) {
    for (int p = 0; p < count; p++)
        if (valid[p]) return true;
    return false;
}

static void warp_spans(const WarpJob& job, int row, int32_t* spans) {
    Taps taps;
    const int n = job.samples * job.samples, blocks = warp_blocks(job.width);
    const uint8_t* valid = job.valid + static_cast<int64_t>(row) * job.width;
    for (int block = 0; block < blocks; block++) {
        const int begin = block * kWarpBlock, count = block_pixels(job, begin);
        int32_t first = INT32_MAX, last = INT32_MIN;
        find_taps(job, row, begin, count, taps);
        for (int p = 0; p < count; p++) {
            if (!valid[begin + p]) continue;
            for (int s = 0; s < n; s++) {
                const int32_t y = taps.y[s * kWarpBlock + p];
                first = y < first ? y : first;
                last = y + 3 > last ? y + 3 : last;
            }
        }
        int32_t* span = spans + 2 * (static_cast<int64_t>(row) * blocks + block);
        span[0] = first;
        span[1] = last;
    }
}

// Adds one sample to `sum`, vectors of the channels.
template <int V>
HOLOREEL_INLINE void add_sample(const WarpJob& job, const Taps& taps, int k, F* sum) {
    const int x = taps.x[k], y = taps.y[k], channels = job.channels;
    const int64_t pitch = static_cast<int64_t>(job.source_width) * channels;
    const int64_t at = y * pitch + static_cast<int64_t>(x) * channels;
    // Whole vectors are read, also behind a pixel; not behind the picture.
    if (x >= 0 && y >= 0 && x + 3 < job.source_width && y + 3 < job.source_height &&
        at + 3 * pitch + 3 * channels + V * kLanes <= job.source_height * pitch) {
        const F w0 = set1(taps.wx[0][k]), w1 = set1(taps.wx[1][k]), w2 = set1(taps.wx[2][k]), w3 = set1(taps.wx[3][k]);
        for (int r = 0; r < 4; r++) {
            const float* line = job.source + at + r * pitch;
            const F weight = set1(taps.wy[r][k]);
            for (int v = 0; v < V; v++) {
                F value = mul(load(line + v * kLanes), w0);
                value = fma(load(line + channels + v * kLanes), w1, value);
                value = fma(load(line + 2 * channels + v * kLanes), w2, value);
                value = fma(load(line + 3 * channels + v * kLanes), w3, value);
                sum[v] = fma(value, weight, sum[v]);
            }
        }
        return;
    }
    float values[V * kLanes];
    for (int v = 0; v < V; v++) store(values + v * kLanes, sum[v]);
    for (int r = 0; r < 4; r++) {
        if (y + r < 0 || y + r >= job.source_height) continue;
        for (int c = 0; c < 4; c++) {
            if (x + c < 0 || x + c >= job.source_width) continue;
            const float* pixel = job.source + at + r * pitch + static_cast<int64_t>(c) * channels;
            for (int i = 0; i < channels; i++) values[i] += taps.wy[r][k] * taps.wx[c][k] * pixel[i];
        }
    }
    for (int v = 0; v < V; v++) sum[v] = load(values + v * kLanes);
}

template <int V>
static void warp_row(const WarpJob& job, int row) {
    Taps taps;
    const int n = job.samples * job.samples, channels = job.channels;
    const F share = set1(1.0f / n);
    for (int begin = 0; begin < job.width; begin += kWarpBlock) {
        const int count = block_pixels(job, begin);
        const int64_t pixel = static_cast<int64_t>(row) * job.width + begin;
        float* image = job.image + pixel * channels;
        const uint8_t* valid = job.valid + pixel;
        if (any_valid(valid, count)) find_taps(job, row, begin, count, taps);
        for (int p = 0; p < count; p++, image += channels) {
            F sum[V];
            for (int v = 0; v < V; v++) sum[v] = set1(0.0f);
            if (valid[p])
                for (int s = 0; s < n; s++) add_sample<V>(job, taps, s * kWarpBlock + p, sum);
            float values[V * kLanes];
            for (int v = 0; v < V; v++) store(values + v * kLanes, mul(sum[v], share));
            for (int c = 0; c < channels; c++) image[c] = values[c];
        }
    }
}

// Adds a sample's gradient to those of its pixels that lie in the rows from `first` on, V vectors per pixel.
template <int V>
HOLOREEL_INLINE void spread_sample(const WarpJob& job, const Taps& taps, int k, const F* gradient, int first, int rows,
                                   float* sums) {
    const int x = taps.x[k], y = taps.y[k];
    const int row_begin = y < first ? first - y : 0, row_end = first + rows - y < 4 ? first + rows - y : 4;
    const bool inside = x >= 0 && x + 3 < job.source_width;
    const F weights[4] = {set1(taps.wx[0][k]), set1(taps.wx[1][k]), set1(taps.wx[2][k]), set1(taps.wx[3][k])};
    for (int r = row_begin; r < row_end; r++) {
        float* line = sums + (static_cast<int64_t>(y + r - first) * job.source_width + x) * (V * kLanes);
        F part[V];
        for (int v = 0; v < V; v++) part[v] = mul(gradient[v], set1(taps.wy[r][k]));
        for (int c = 0; c < 4; c++) {
            if (!inside && (x + c < 0 || x + c >= job.source_width)) continue;
            for (int v = 0; v < V; v++) {
                float* place = line + (c * V + v) * kLanes;
                store(place, fma(part[v], weights[c], load(place)));
            }
        }
    }
}

template <int V>
static void warp_band(const WarpJob& job, int first, int rows, float* sums) {
    Taps taps;
    const int n = job.samples * job.samples, channels = job.channels, blocks = warp_blocks(job.width);
    const int64_t pixels = static_cast<int64_t>(rows) * job.source_width;
    for (int64_t k = 0; k < pixels * V; k++) store(sums + k * kLanes, set1(0.0f));
    const int32_t* span = job.spans;
    for (int row = 0; row < job.height; row++) {
        for (int block = 0; block < blocks; block++, span += 2) {
            if (span[0] >= first + rows || span[1] < first) continue;
            const int begin = block * kWarpBlock, count = block_pixels(job, begin);
            const int64_t pixel = static_cast<int64_t>(row) * job.width + begin;
            find_taps(job, row, begin, count, taps);
            for (int p = 0; p < count; p++) {
                if (!job.valid[pixel + p]) continue;
                float values[V * kLanes] = {};
                for (int c = 0; c < channels; c++) values[c] = job.image_gradient[(pixel + p) * channels + c];
                F gradient[V];
                for (int v = 0; v < V; v++) gradient[v] = mul(load(values + v * kLanes), set1(1.0f / n));
                for (int s = 0; s < n; s++) spread_sample<V>(job, taps, s * kWarpBlock + p, gradient, first, rows, sums);
            }
        }
    }
    float* out = job.source_gradient + static_cast<int64_t>(first) * job.source_width * channels;
    for (int64_t k = 0; k < pixels; k++)
        for (int c = 0; c < channels; c++) out[k * channels + c] = sums[k * V * kLanes + c];
}

// CALL with the number of vectors that hold the channels, as a constant.
#define HOLOREEL_EACH_VECTORS(CALL)                     \
    switch ((job.channels + kLanes - 1) / kLanes) {     \
        case 1: CALL(1); break;                         \
        case 2: CALL(2); break;                         \
        case 3: CALL(3); break;                         \
        default: CALL(4);                               \
    }

static void warp_forward(const WarpJob& job, int row) {
#define HOLOREEL_CALL(V) warp_row<V>(job, row)
    HOLOREEL_EACH_VECTORS(HOLOREEL_CALL)
#undef HOLOREEL_CALL
}

static void warp_backward(const WarpJob& job, int first, int rows, float* sums) {
#define HOLOREEL_CALL(V) warp_band<V>(job, first, rows, sums)
    HOLOREEL_EACH_VECTORS(HOLOREEL_CALL)
#undef HOLOREEL_CALL
}

#undef HOLOREEL_EACH_VECTORS

}  // namespace HOLOREEL_NAMESPACE
}  // namespace holoreel
