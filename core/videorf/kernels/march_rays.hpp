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
#include "simd.hpp"

namespace holoreel {
namespace HOLOREEL_NAMESPACE {

using namespace videorf;

template <int C> struct RowOf;
template <> struct RowOf<4> { typedef float type __attribute__((vector_size(16))); };
template <> struct RowOf<8> { typedef float type __attribute__((vector_size(32))); };
template <> struct RowOf<16> { typedef float type __attribute__((vector_size(64))); };

template <int C> HOLOREEL_INLINE typename RowOf<C>::type load_row(const float* p) {
    typename RowOf<C>::type row;
    std::memcpy(&row, p, sizeof row);
    return row;
}
template <int C> HOLOREEL_INLINE void store_row(float* p, typename RowOf<C>::type row) { std::memcpy(p, &row, sizeof row); }
template <int C> HOLOREEL_INLINE float sum_row(typename RowOf<C>::type row) {
    float sum = 0;
    for (int c = 0; c < C; c++) sum += row[c];
    return sum;
}

// Up to kBatch samples, those in occupied cells only.
struct Batch {
    int count;
    alignas(32) int32_t corner[kBatch];  // of the cell, its lowest, in Volume::rows_of
    alignas(32) float x[kBatch], y[kBatch], z[kBatch], t[kBatch];  // t: from the entry into the lattice, in spacings
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
            const double first = (0 - o[a]) / d, second = (volume.cells[a] - o[a]) / d;
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
            inverse_[a] = std::abs(direction[a]) < 1e-12f ? 0.0f : 1.0f / direction[a];
            limit_[a] = static_cast<float>(volume.cells[a]);
        }
    }

    // Fills `batch` with the next samples; false at the end of the ray. Samples come in order.
    HOLOREEL_INLINE_MEMBER bool next(Batch& batch) {
        while (next_ < samples_) {
            if (skip()) continue;
            collect(batch);
            if (batch.count) return true;
        }
        return false;
    }

    double entry;  // where the ray enters, in spacings from its origin

private:
    HOLOREEL_INLINE_MEMBER int cell_at(int axis, float t) const {
        const float p = std::min(std::max(start_[axis] + t * direction_[axis], 0.0f), limit_[axis]);
        return std::min(static_cast<int>(p), volume_.cells[axis] - 1);
    }

    // Moves on to the end of an empty brick or block. Never past a sample beyond it: where in doubt, one step at a time.
    HOLOREEL_INLINE_MEMBER bool skip() {
        const float t = (static_cast<float>(next_) + jitter_) * step_;
        const int x = cell_at(0, t), y = cell_at(1, t), z = cell_at(2, t);
        const Volume& v = volume_;
        const bool far = !v.block_full[(size_t(x / kBlock) * v.blocks[1] + y / kBlock) * v.blocks[2] + z / kBlock];
        if (!far && v.brick_of[(size_t(x / kBrick) * v.bricks[1] + y / kBrick) * v.bricks[2] + z / kBrick]) return false;
        const int edge = far ? kBlock : kBrick;
        const int at[3] = {x & -edge, y & -edge, z & -edge};
        float leave = std::numeric_limits<float>::max();
        for (int a = 0; a < 3; a++) {
            if (inverse_[a] == 0) continue;
            const float wall = static_cast<float>(inverse_[a] > 0 ? at[a] + edge : at[a]);
            leave = std::min(leave, (wall - start_[a]) * inverse_[a]);
        }
        const float to = std::min(leave * per_step_ - jitter_, static_cast<float>(samples_));
        next_ = std::max(next_ + 1, static_cast<int>(to));
        return true;
    }

    HOLOREEL_INLINE_MEMBER void collect(Batch& batch) {
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
            brick[i] = bricks[(ix >> 2) * stride_x + (iy >> 2) * stride_y + (iz >> 2)];
            inside[i] = dx << 4 | dy << 2 | dz;
            corner[i] = brick[i] * kBrickVertices + dx * kStrideX + dy * kStrideY + dz;
        }
        const int left = std::min(samples_ - next_, kBatch);
        int n = 0;
        for (int i = 0; i < left; i++) {
            batch.corner[n] = corner[i];
            batch.x[n] = x[i];
            batch.y[n] = y[i];
            batch.z[n] = z[i];
            batch.t[n] = t[i];
            n += occupied[brick[i]] >> inside[i] & 1;
        }
        batch.count = n;
        next_ += kBatch;
    }

    const Volume& volume_;
    float start_[3], direction_[3], inverse_[3], limit_[3];
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

// Asks for the rows of a batch that will be sampled soon: they lie all over the table.
template <int C> HOLOREEL_INLINE void fetch(const March& march, const Batch& batch) {
    const int32_t* corners = march.volume->rows_of.data();
    for (int i = 0; i < batch.count; i++)
        for (int along : {0, kStrideX})
            for (int offset : {0, 1, kStrideY, kStrideY + 1})
                __builtin_prefetch(march.table + size_t(corners[batch.corner[i] + along + offset]) * C);
}

template <int C, bool kSlope, class Rows>
HOLOREEL_INLINE void sample(const March& march, Batch& batch, Rows& rows) {
    const int32_t* corners = march.volume->rows_of.data();
    for (int i = 0; i < batch.count; i++)
        rows[i] = interpolate<C>(march.table, corners + batch.corner[i], batch.x[i], batch.y[i], batch.z[i]);
    for (int i = 0; i < kBatch; i++) batch.density[i] = i < batch.count ? rows[i][0] : 0.0f;
    activate<kSlope>(batch, static_cast<float>(march.rays.step));
}

template <int C, bool kTape>
HOLOREEL_INLINE int64_t march_run(const March& march, int64_t first, int64_t last, Chunk* chunk) {
    using Row = typename RowOf<C>::type;
    const float least = static_cast<float>(march.rays.transmittance_min);
    int64_t samples = 0;
    Batch batches[2];
    Row rows[kBatch];
    for (int64_t ray = first; ray < last; ray++) {
        Walk walk(*march.volume, march.rays, ray);
        const float entry = static_cast<float>(walk.entry);
        Row sum = {};
        float left = 1, distance = 0;
        int now = 0;
        bool open = true, more = walk.next(batches[0]);
        if (more) fetch<C>(march, batches[0]);
        while (open && more) {
            Batch& batch = batches[now];
            now ^= 1;
            more = walk.next(batches[now]);
            if (more) fetch<C>(march, batches[now]);
            sample<C, kTape>(march, batch, rows);
            int taken = 0;
            for (; taken < batch.count && open; taken++) {
                const float weight = left * batch.alpha[taken];
                sum += rows[taken] * weight;
                distance += weight * batch.t[taken];
                left *= batch.passed[taken];
                open = left > least;
                if (!kTape) continue;
                const int i = taken;
                chunk->records.push_back({batch.corner[i], batch.x[i], batch.y[i], batch.z[i], weight,
                                          entry + batch.t[i], left, batch.slope[i]});
                chunk->rays.push_back(static_cast<int32_t>(ray));
            }
            if (kTape) {
                const float* from = reinterpret_cast<const float*>(rows);
                chunk->rows.insert(chunk->rows.end(), from, from + size_t(taken) * C);
            }
            samples += taken;
        }
        if (kTape) {
            chunk->ends.push_back(static_cast<uint32_t>(chunk->records.size()));
            chunk->left.push_back(left);
        }
        const float weights = 1 - left;
        sum[0] = left;
        store_row<C>(march.images.accumulated + C * ray, sum);
        march.images.depth[ray] = static_cast<float>((distance + weights * walk.entry) * march.volume->spacing);
    }
    return samples;
}

template <int C> int64_t forward_rays(const March& march, int64_t first, int64_t last, Chunk* chunk) {
    if (!chunk) return march_run<C, false>(march, first, last, nullptr);
    chunk->records.clear();
    chunk->rows.clear();
    chunk->ends.clear();
    chunk->left.clear();
    chunk->rays.clear();
    return march_run<C, true>(march, first, last, chunk);
}

template <int C>
void backward_rays(const VideorfImageGradients& gradients, double spacing, int64_t first, Chunk& chunk) {
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
            Record& record = chunk.records[k];
            const Row row = load_row<C>(chunk.rows.data() + size_t(k) * C);
            const float seen = sum_row<C>(row * incoming) + d_distance * record.distance;
            record.slope *= record.after * seen - behind;
            behind += record.weight * seen;
        }
    }
}

template <int C>
void scatter_shard(const Volume& volume, const VideorfImageGradients& gradients, int shard, const Chunk* chunks,
                   int64_t count, float* gradient) {
    using Row = typename RowOf<C>::type;
    const int from = shard * volume.shard_rows, to = std::min(from + volume.shard_rows, volume.rows - 1);
    alignas(64) float elsewhere[C] = {};  // takes what belongs to other shards and to the empty row
    for (const Chunk* chunk = chunks; chunk < chunks + count; chunk++) {
        for (uint32_t i = chunk->begin[shard]; i < chunk->begin[shard + 1]; i++) {
            const uint32_t index = chunk->order[i];
            const Record& record = chunk->records[index];
            Row row = {};
            if (gradients.accumulated)
                row = load_row<C>(gradients.accumulated + size_t(chunk->rays[index]) * C) * record.weight;
            row[0] = record.slope;
            const int32_t* rows = volume.rows_of.data() + record.corner;
            const float wx[2] = {1 - record.x, record.x}, wy[2] = {1 - record.y, record.y};
            const float wz[2] = {1 - record.z, record.z};
            for (int k = 0; k < 8; k++) {
                const int r = rows[(k >> 2) * kStrideX + (k >> 1 & 1) * kStrideY + (k & 1)];
                float* target = r >= from && r < to ? gradient + size_t(r) * C : elsewhere;
                store_row<C>(target, load_row<C>(target) + row * (wx[k >> 2] * wy[k >> 1 & 1] * wz[k & 1]));
            }
        }
    }
}

static const MarchKernels* march_of(int channels) {
    static const MarchKernels four = {kLanes, forward_rays<4>, backward_rays<4>, scatter_shard<4>};
    static const MarchKernels eight = {kLanes, forward_rays<8>, backward_rays<8>, scatter_shard<8>};
    static const MarchKernels sixteen = {kLanes, forward_rays<16>, backward_rays<16>, scatter_shard<16>};
    return channels == 4 ? &four : channels == 8 ? &eight : channels == 16 ? &sixteen : nullptr;
}

}  // namespace HOLOREEL_NAMESPACE
}  // namespace holoreel
