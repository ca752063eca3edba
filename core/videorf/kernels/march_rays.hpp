// SPDX-License-Identifier: GPL-3.0-or-later
// The march itself. Included once by each width's translation unit, in a namespace of its own.
//
// A sample is the trilinear mean of the raw rows at its cell's corners; its density passes softplus after that, and absorbs
// 1 - exp(-step softplus(density)). Samples in cells without an occupied corner see nothing. A ray ends once its transmittance
// is not above the least one.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "march.hpp"
#include "rows_simd.hpp"

namespace holoreel {
namespace HOLOREEL_NAMESPACE {

using namespace videorf;

typedef float Lane8 __attribute__((vector_size(32)));
typedef int32_t Mask8 __attribute__((vector_size(32)));
static_assert(sizeof(Lane8) == kBatch * sizeof(float), "a batch fills one vector");

HOLOREEL_INLINE Lane8 broadcast(float value) { return value - Lane8{}; }
// The values moved up by kBy lanes, with `fill` in those that get free.
template <int kBy> HOLOREEL_INLINE Lane8 moved_up(Lane8 values, float fill) {
    constexpr auto from = [](int lane) { return lane < kBy ? kBatch : lane - kBy; };
#if defined(__clang__)
    return __builtin_shufflevector(values, broadcast(fill), from(0), from(1), from(2), from(3), from(4), from(5), from(6), from(7));
#else
    return __builtin_shuffle(values, broadcast(fill),
                             Mask8{from(0), from(1), from(2), from(3), from(4), from(5), from(6), from(7)});
#endif
}
HOLOREEL_INLINE int count_true(Mask8 mask) {
#if HOLOREEL_LANES == 8
    return __builtin_popcount(_mm256_movemask_ps(reinterpret_cast<__m256>(mask)));
#else
    int sum = 0;
    for (int i = 0; i < kBatch; i++) sum -= mask[i];
    return sum;
#endif
}

// Samples in occupied cells that wait for being taken, in order. A batch may be added as long as less than one waits.
struct Queue {
    int count = 0;
    alignas(32) int32_t corner[2 * kBatch];  // of the cell, its lowest, in Volume::rows_of
    alignas(32) float x[2 * kBatch], y[2 * kBatch], z[2 * kBatch];
    alignas(32) float t[2 * kBatch];  // from the entry into the lattice, in spacings

    HOLOREEL_INLINE_MEMBER void drop_batch() {
        const auto move = [](auto* values) { std::memcpy(values, values + kBatch, kBatch * sizeof *values); };
        move(corner), move(x), move(y), move(z), move(t);
        count -= kBatch;
    }
    // Fills a batch up with samples of the empty brick.
    HOLOREEL_INLINE_MEMBER void pad() {
        for (int i = 0; i < kBatch; i++) {
            corner[i] = i < count ? corner[i] : 0;
            x[i] = i < count ? x[i] : 0;
            y[i] = i < count ? y[i] : 0;
            z[i] = i < count ? z[i] : 0;
            t[i] = i < count ? t[i] : 0;
        }
    }
};

struct Batch {
    alignas(32) float density[kBatch], alpha[kBatch], passed[kBatch], slope[kBatch];
};

// One ray in the lattice's own coordinates.
class Walk {
public:
    Walk(const Volume& volume, const VideorfRays& rays, int64_t ray) : volume_(volume) {
        const float* origin = rays.origins + 3 * ray;
        const float* direction = rays.directions + 3 * ray;
        double o[3], near = 0, far = 1e9;
        bool hit = true;
        for (int a = 0; a < 3; a++) {
            hit = hit && std::isfinite(origin[a]) && std::isfinite(direction[a]);
            o[a] = (double(origin[a]) - volume.lowest[a]) / volume.spacing;
            const double d = direction[a];
            if (std::abs(d) < 1e-12) {
                hit = hit && o[a] >= 0 && o[a] <= volume.cells[a];
                continue;
            }
            const double inverse = 1 / d, first = -o[a] * inverse, second = (volume.cells[a] - o[a]) * inverse;
            near = std::max(near, std::min(first, second));
            far = std::min(far, std::max(first, second));
        }
        step_ = static_cast<float>(rays.step);
        per_step_ = 1.0f / step_;
        jitter_ = rays.jitter ? rays.jitter[ray] : 0.5f;
        entry = near;
        const double steps = (far - near) / rays.step - jitter_;
        samples_ = hit && steps > 0 && steps < 1e7 ? static_cast<int>(std::ceil(steps)) : 0;
        for (int a = 0; a < 3; a++) {
            start_[a] = static_cast<float>(o[a] + near * direction[a]);
            direction_[a] = direction[a];
            const bool along = std::abs(direction[a]) < 1e-12f;
            inverse_[a] = along ? 1e30f : 1.0f / direction[a];
            forth_[a] = inverse_[a] > 0 ? 1 : -1;
            limit_[a] = static_cast<float>(volume.cells[a]);
        }
    }

    // Adds the next samples until there is a whole batch or the ray ends.
    HOLOREEL_INLINE_MEMBER void fill(Queue& queue) {
        while (queue.count < kBatch && next_ < samples_)
            if (!leap()) collect(queue);
    }

    double entry;  // where the ray enters, in spacings from its origin

private:
    HOLOREEL_INLINE_MEMBER int brick_at(int axis, float t) const {
        const float p = std::min(std::max(start_[axis] + t * direction_[axis], 0.0f), limit_[axis]);
        return std::min(static_cast<int>(p), volume_.cells[axis] - 1) / kBrick;
    }

    // Moves on to the first sample beyond the empty bricks around, if it is among such. A sample so near to their border that
    // rounding decides is looked at again.
    HOLOREEL_INLINE_MEMBER bool leap() {
        const float t = (static_cast<float>(next_) + jitter_) * step_;
        const int at[3] = {brick_at(0, t), brick_at(1, t), brick_at(2, t)};
        const int away = -volume_.brick_of[(size_t(at[0]) * volume_.bricks[1] + at[1]) * volume_.bricks[2] + at[2]];
        if (away <= 0) return false;
        float leave = std::numeric_limits<float>::max();
        for (int a = 0; a < 3; a++) {
            const int wall = 2 * at[a] + 1 + forth_[a] * (2 * away - 1);  // in halves of bricks
            leave = std::min(leave, (static_cast<float>(wall * (kBrick / 2)) - start_[a]) * inverse_[a]);
        }
        const float to = std::min(leave * per_step_ - jitter_ - 0.01f, static_cast<float>(samples_));
        next_ = std::max(next_, static_cast<int>(std::max(to, -1.0f))) + 1;
        return true;
    }

    HOLOREEL_INLINE_MEMBER void collect(Queue& queue) {
        alignas(32) float x[kBatch], y[kBatch], z[kBatch], t[kBatch];
        alignas(32) int32_t corner[kBatch], inside[kBatch], brick[kBatch];
        const int32_t* bricks = volume_.brick_of.data();
        const uint64_t* occupied = volume_.occupied.data();
        const int limit_x = volume_.cells[0] - 1, limit_y = volume_.cells[1] - 1, limit_z = volume_.cells[2] - 1;
        const int stride_x = volume_.bricks[1] * volume_.bricks[2], stride_y = volume_.bricks[2];
        for (int i = 0; i < kBatch; i++) {
            t[i] = (static_cast<float>(next_ + i) + jitter_) * step_;
            const float px = std::min(std::max(start_[0] + t[i] * direction_[0], 0.0f), limit_[0]);
            const float py = std::min(std::max(start_[1] + t[i] * direction_[1], 0.0f), limit_[1]);
            const float pz = std::min(std::max(start_[2] + t[i] * direction_[2], 0.0f), limit_[2]);
            const int ix = std::min(static_cast<int>(px), limit_x);
            const int iy = std::min(static_cast<int>(py), limit_y);
            const int iz = std::min(static_cast<int>(pz), limit_z);
            x[i] = px - static_cast<float>(ix);
            y[i] = py - static_cast<float>(iy);
            z[i] = pz - static_cast<float>(iz);
            const int dx = ix & 3, dy = iy & 3, dz = iz & 3;
            brick[i] = std::max(bricks[(ix >> 2) * stride_x + (iy >> 2) * stride_y + (iz >> 2)], 0);
            inside[i] = dx << 4 | dy << 2 | dz;
            corner[i] = brick[i] * kBrickVertices + dx * kStrideX + dy * kStrideY + dz;
        }
        const int left = std::min(samples_ - next_, kBatch);
        int n = queue.count;
        for (int i = 0; i < left; i++) {
            queue.corner[n] = corner[i];
            queue.x[n] = x[i];
            queue.y[n] = y[i];
            queue.z[n] = z[i];
            queue.t[n] = t[i];
            n += occupied[brick[i]] >> inside[i] & 1;
        }
        queue.count = n;
        next_ += kBatch;
    }

    const Volume& volume_;
    float start_[3], direction_[3], inverse_[3], limit_[3];
    int forth_[3];
    float step_, per_step_, jitter_;
    int next_ = 0, samples_;
};

template <int C>
HOLOREEL_INLINE typename RowOf<C>::type interpolate(const float* table, const int32_t* rows, float x, float y, float z) {
    using Row = typename RowOf<C>::type;
    const auto along = [&](int offset) -> Row {
        const Row a = load_row<C>(table + size_t(rows[offset]) * C);
        return a + (load_row<C>(table + size_t(rows[offset + 1]) * C) - a) * z;
    };
    const Row a = along(0), b = along(kStrideX);
    const Row near = a + (along(kStrideY) - a) * y, far = b + (along(kStrideX + kStrideY) - b) * y;
    return near + (far - near) * x;
}

// alpha = 1 - exp(-step softplus(d)), passed = exp(-step softplus(d)) and, for the backward pass, slope = step sigmoid(d).
template <bool kSlope> HOLOREEL_INLINE void activate(Batch& batch, float step) {
    const F log2e = set1(1.44269504f), one = set1(1.0f), zero = set1(0.0f);
    for (int i = 0; i < kBatch; i += kLanes) {
        const F d = load(batch.density + i);
        const F e = exp2(negate(mul(min(abs(d), set1(60.0f)), log2e)));
        const F z = div(e, add(e, set1(2.0f))), zz = mul(z, z);  // log1p(e) = 2 atanh(e / (2 + e))
        F series = fma(zz, set1(2.0f / 13), set1(2.0f / 11));
        series = fma(series, zz, set1(2.0f / 9));
        series = fma(series, zz, set1(2.0f / 7));
        series = fma(series, zz, set1(2.0f / 5));
        series = fma(series, zz, set1(2.0f / 3));
        series = fma(series, zz, set1(2.0f));
        const F tau = mul(fma(series, z, max(d, zero)), set1(step));
        const F passed = exp2(negate(mul(min(tau, set1(60.0f)), log2e)));
        // 1 - passed would lose the digits of a thin sample.
        const F thin = mul(tau, fma(tau, fma(tau, set1(1.0f / 6), set1(-0.5f)), one));
        store(batch.passed + i, passed);
        store(batch.alpha + i, select(gt(set1(0.02f), tau), thin, sub(one, passed)));
        if (kSlope) store(batch.slope + i, mul(set1(step), div(select(ge(d, zero), one, e), add(one, e))));
    }
}

template <int C, bool kSlope>
HOLOREEL_INLINE void sample(const March& march, const Queue& queue, typename RowOf<C>::type* rows, Batch& batch) {
    const int32_t* corners = march.volume->rows_of.data();
    for (int i = 0; i < kBatch; i++) {
        rows[i] = interpolate<C>(march.table, corners + queue.corner[i], queue.x[i], queue.y[i], queue.z[i]);
        batch.density[i] = rows[i][0];
    }
    activate<kSlope>(batch, static_cast<float>(march.rays.step));
}

// Room for another batch.
template <int C> HOLOREEL_INLINE void make_room(Chunk& chunk) {
    const size_t needed = chunk.used + kBatch;
    if (needed <= chunk.corner.size() && needed * C <= chunk.rows.size()) return;  // a tape may have served another table
    const size_t size = 2 * needed + 64 * kBatch;
    chunk.corner.resize(size);
    for (auto* part : {&chunk.x, &chunk.y, &chunk.z, &chunk.weight, &chunk.distance, &chunk.after, &chunk.slope})
        part->resize(size);
    chunk.rows.resize(size * C);
}

template <int C, bool kTape>
HOLOREEL_INLINE int64_t march_run(const March& march, int64_t first, int64_t last, Chunk* chunk) {
    using Row = typename RowOf<C>::type;
    const float least = static_cast<float>(march.rays.transmittance_min);
    const Mask8 lanes = {0, 1, 2, 3, 4, 5, 6, 7};
    int64_t samples = 0;
    Batch batch;
    Queue queue;
    Row rows[kBatch];
    for (int64_t ray = first; ray < last; ray++) {
        Walk walk(*march.volume, march.rays, ray);
        const float entry = static_cast<float>(walk.entry);
        Row sum = {};
        Lane8 distance = {};
        float left = 1;
        queue.count = 0;
        for (;;) {
            walk.fill(queue);
            if (queue.count == 0) break;
            if (queue.count < kBatch) queue.pad();
            sample<C, kTape>(march, queue, rows, batch);
            // Products over the samples before each, in three steps.
            Lane8 after = load_row<8>(batch.passed);
            after *= moved_up<1>(after, 1.0f);
            after *= moved_up<2>(after, 1.0f);
            after *= moved_up<4>(after, 1.0f);
            after *= left;
            const Lane8 before = moved_up<1>(after, left);
            const Mask8 reached = (before > least) & (lanes < queue.count);
            const Lane8 weight = reinterpret_cast<Lane8>(reached & reinterpret_cast<Mask8>(before * load_row<8>(batch.alpha)));
            const int taken = count_true(reached);
            alignas(32) float weights[kBatch], afters[kBatch];
            store_row<8>(weights, weight);
            store_row<8>(afters, after);
            for (int i = 0; i < kBatch; i++) sum += rows[i] * weights[i];
            distance += weight * load_row<8>(queue.t);
            left = afters[taken - 1];
            if (kTape) {
                make_room<C>(*chunk);
                const size_t at = chunk->used;
                std::memcpy(&chunk->corner[at], queue.corner, sizeof(Mask8));
                std::memcpy(&chunk->x[at], queue.x, sizeof(Lane8));
                std::memcpy(&chunk->y[at], queue.y, sizeof(Lane8));
                std::memcpy(&chunk->z[at], queue.z, sizeof(Lane8));
                std::memcpy(&chunk->slope[at], batch.slope, sizeof(Lane8));
                store_row<8>(&chunk->weight[at], weight);
                store_row<8>(&chunk->distance[at], load_row<8>(queue.t) + entry);
                store_row<8>(&chunk->after[at], after);
                std::memcpy(&chunk->rows[at * C], rows, sizeof rows);
                chunk->used += taken;
            }
            samples += taken;
            if (taken < kBatch || !(left > least)) break;
            queue.drop_batch();
        }
        if (kTape) {
            chunk->ends.push_back(static_cast<uint32_t>(chunk->used));
            chunk->left.push_back(left);
        }
        const float weights = 1 - left;
        sum[0] = left;
        store_row<C>(march.images.accumulated + C * ray, sum);
        march.images.depth[ray] =
            static_cast<float>((sum_row<8>(distance) + weights * walk.entry) * march.volume->spacing);
    }
    return samples;
}

template <int C> int64_t forward_rays(const March& march, int64_t first, int64_t last, Chunk* chunk) {
    if (!chunk) return march_run<C, false>(march, first, last, nullptr);
    chunk->used = 0;
    chunk->ends.clear();
    chunk->left.clear();
    return march_run<C, true>(march, first, last, chunk);
}

template <int C>
void backward_rays(const VideorfImageGradients& gradients, double spacing, int64_t first, const Chunk& chunk, uint32_t* next,
                   Scattered* sorted) {
    using Row = typename RowOf<C>::type;
    uint32_t begin = 0;
    for (size_t i = 0; i < chunk.ends.size(); begin = chunk.ends[i++]) {
        const int64_t ray = first + static_cast<int64_t>(i);
        Row incoming = {};
        if (gradients.accumulated) incoming = load_row<C>(gradients.accumulated + C * ray);
        const float d_distance = gradients.depth ? static_cast<float>(gradients.depth[ray] * spacing) : 0.0f;
        // A denser sample takes light from all behind it, and from the background.
        float behind = incoming[0] * chunk.left[i];
        incoming[0] = 0;
        for (uint32_t k = chunk.ends[i]; k-- > begin;) {
            const Row row = load_row<C>(&chunk.rows[size_t(k) * C]);
            const float seen = sum_row<C>(row * incoming) + d_distance * chunk.distance[k];
            const float density = chunk.slope[k] * (chunk.after[k] * seen - behind);
            behind += chunk.weight[k] * seen;
            const int32_t brick = chunk.corner[k] / kBrickVertices;
            const int32_t inside = chunk.corner[k] - brick * kBrickVertices;
            sorted[next[brick]++] = {static_cast<int32_t>(ray), inside,          chunk.x[k], chunk.y[k],
                                     chunk.z[k],                chunk.weight[k], density,    0.0f};
        }
    }
}

template <int C>
void scatter_column(const Volume& volume, const VideorfImageGradients& gradients, Column column, const Scattered* sorted,
                    const uint32_t* begins, float* gradient) {
    using Row = typename RowOf<C>::type;
    Row own[kBrickVertices];
    for (int32_t brick = column.first; brick < column.end; brick++) {
        if (begins[brick] == begins[brick + 1]) continue;
        std::memset(own, 0, sizeof own);
        for (const Scattered* at = sorted + begins[brick]; at < sorted + begins[brick + 1]; at++) {
            Row row = {};
            if (gradients.accumulated) row = load_row<C>(gradients.accumulated + size_t(at->ray) * C) * at->weight;
            row[0] = at->density;
            Row* corner = own + at->corner;
            const Row far = row * at->x, near = row - far;
            const auto add = [&](Row part, Row* edge) {
                const Row behind = part * at->z;
                edge[0] += part - behind;
                edge[1] += behind;
            };
            const Row near_far = near * at->y, far_far = far * at->y;
            add(near - near_far, corner);
            add(near_far, corner + kStrideY);
            add(far - far_far, corner + kStrideX);
            add(far_far, corner + kStrideX + kStrideY);
        }
        const int32_t* rows = volume.rows_of.data() + size_t(brick) * kBrickVertices;
        for (int i = 0; i < kBrickVertices; i++) {
            if (rows[i] == volume.rows - 1) continue;  // what empty vertices hold is not trained
            float* target = gradient + size_t(rows[i]) * C;
            store_row<C>(target, load_row<C>(target) + own[i]);
        }
    }
}

static const MarchKernels* march_of(int channels) {
    static const MarchKernels four = {kLanes, forward_rays<4>, backward_rays<4>, scatter_column<4>};
    static const MarchKernels eight = {kLanes, forward_rays<8>, backward_rays<8>, scatter_column<8>};
    static const MarchKernels sixteen = {kLanes, forward_rays<16>, backward_rays<16>, scatter_column<16>};
    return channels == 4 ? &four : channels == 8 ? &eight : channels == 16 ? &sixteen : nullptr;
}

}  // namespace HOLOREEL_NAMESPACE
}  // namespace holoreel
