// SPDX-License-Identifier: GPL-3.0-or-later
// What the tile kernels need, as plain data: their translation units are compiled for a newer instruction set than the rest,
// so nothing here may bring inline library code with it that the linker could pick for everyone.
#pragma once

#include <stdint.h>

namespace holoreel {

constexpr int kTile = 16;
constexpr int kMaxChannels = 16;

// One Gaussian as the tile kernels read it, followed by its padded channels and its depth. W is scaled so that
// log2(alpha) = log2_opacity - |W d|². The mean and W stay in double: the offset to a tile's own origin is taken in double
// once per tile, after which everything per pixel is small and single precision is enough.
struct Record {
    double x, y, w11, w12, w22;
    float log2_opacity;
    uint32_t radii;  // half extents in x (upper 16 bits) and y (lower), as bfloat16 rounded up

    const float* channels() const { return reinterpret_cast<const float*>(this + 1); }
    float* channels() { return reinterpret_cast<float*>(this + 1); }
};
static_assert(sizeof(Record) == 48, "three channels and depth fill one cache line");

// A Gaussian in a tile's list, and where its sums of this tile go in the backward pass.
struct Entry {
    uint32_t gaussian, slot;
};

struct TileJob {
    const float* records;
    int record_stride;  // floats
    const Entry* entries;
    const int64_t* tile_begin;
    int tiles_x, width, height, channels;
    float log2_alpha_min, alpha_max, transmittance_min;
    const float* background;               // or null
    float *features, *alpha, *depth, *transmittance;       // pictures; the last two may be null
    const float *grad_features, *grad_alpha, *grad_depth;  // may be null
    float* sums;                           // backward: (slots, sums_width)
};

// Sums per Gaussian and tile, with g = dL/d(ln alpha) and (u, v) = the scaled W d:
// g, g u, g v, g u², g u v, g v², then dL/d(channel) of each padded channel, then dL/d(depth) if asked for.
constexpr int kMoments = 6;

using TileKernel = void (*)(const TileJob&, int tile);

// The decoder's sizes: features beside the base color, hidden units, and what a hidden unit looks at (with the ray).
constexpr int kDecoded = 6, kHidden = 6, kDecoderInputs = kDecoded + 6;
constexpr int kMaxLanes = 8;

enum class Activation : int32_t { kNone = 0, kClamp = 1, kSigmoid = 2 };

struct DecodeJob {
    float feature_weights[kHidden][kDecoded], ray_weights[kHidden][3], bias[kHidden], output_weights[3][kHidden];
    const float* plane_x;  // x / z of each column's rays, with room for a whole vector behind the last
    double fy, cy;
    int width;
    Activation activation;
    const float *features, *image_gradient;
    float *image, *features_gradient;  // the second may be null
};

// Per hidden unit, with d = dL/d(its sum): d times each feature, d times the ray, d, then its output times each channel's
// gradient.
struct DecodeSums {
    static constexpr int kPerHidden = kDecoded + 3 + 1 + 3, kCount = kHidden * kPerHidden;
    double values[kCount];
};

struct DecodeKernels {
    void (*forward)(const DecodeJob&, int row);
    void (*backward)(const DecodeJob&, int row, DecodeSums&);
};

// A block is as many pixels of a row; the places of a lens's pixels in a pinhole's picture, the source.
constexpr int kWarpBlock = 64, kMaxWarpSamples = 4;
constexpr int warp_blocks(int width) { return (width + kWarpBlock - 1) / kWarpBlock; }

struct WarpJob {
    const float* places;   // (H + 2, W + 2, 2)
    const uint8_t* valid;  // (H, W)
    const int32_t* spans;  // (H, blocks, 2), for the backward pass
    int width, height, source_width, source_height, channels, samples;
    const float *source, *image_gradient;
    float *image, *source_gradient;
};

struct WarpKernels {
    void (*spans)(const WarpJob&, int row, int32_t* spans);
    void (*forward)(const WarpJob&, int row);
    void (*backward)(const WarpJob&, int first, int rows, float* sums);  // room for whole vectors per source pixel
};

struct RasterKernels {
    int lanes;
    TileKernel (*forward)(int padded_channels, bool with_depth);
    TileKernel (*backward)(int padded_channels, bool with_depth);
    DecodeKernels decode;
    WarpKernels warp;
};

// The channel counts the kernels are compiled for; others are padded up.
constexpr int kPaddedChannels[] = {1, 3, 4, 9, 16};

constexpr int padded_channels(int channels) {
    for (int padded : kPaddedChannels)
        if (channels <= padded) return padded;
    return 0;
}

// Floats per record: whole 32-byte pieces.
constexpr int record_stride(int padded) { return (static_cast<int>(sizeof(Record)) / 4 + padded + 1 + 7) / 8 * 8; }

const RasterKernels* narrow_kernels();  // 4 lanes: SSE4.1, NEON, or whatever the compiler makes of vectors
const RasterKernels* wide_kernels();    // 8 lanes: AVX2 and FMA; null where not compiled

}  // namespace holoreel
