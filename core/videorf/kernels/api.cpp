// SPDX-License-Identifier: GPL-3.0-or-later
#include "api.hpp"

#include <algorithm>
#include <atomic>
#include <cstdio>
#include <cstring>
#include <memory>
#include <mutex>
#include <stdexcept>

#include "march.hpp"
#include "thread_pool.hpp"

namespace holoreel {
namespace videorf {

namespace {

constexpr int64_t kRun = 64;            // rays a task marches
constexpr int64_t kSlabRuns = 256;      // runs whose records are kept at once: about 25 MB
std::mutex call_mutex;                  // the records and the pool serve one call at a time
std::vector<Chunk> chunks(kSlabRuns);   // warm memory
int wanted_lanes = 0;                   // 0: the widest this machine has

thread_local char error_text[256] = "";

const MarchKernels* wide_here(int channels) {
#if defined(__x86_64__) || defined(_M_X64)
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return wide_march(channels);
#else
    (void)channels;
#endif
    return nullptr;
}

const MarchKernels& kernels(int channels) {
    const MarchKernels* wide = wanted_lanes == 4 ? nullptr : wide_here(channels);
    const MarchKernels* found = wide ? wide : narrow_march(channels);
    if (!found) throw std::invalid_argument("a table has 4, 8 or 16 channels");
    return *found;
}

void check(const VideorfRays& rays) {
    if (rays.count < 0 || rays.count > INT32_MAX) throw std::invalid_argument("the number of rays must be under 2^31");
    if (!(rays.step >= 1.0 / 64 && rays.step <= 64))
        throw std::invalid_argument("the step must lie in 1/64 ... 64 spacings");
    if (!(rays.transmittance_min >= 0 && rays.transmittance_min < 1))
        throw std::invalid_argument("the least transmittance must lie in 0 ... 1");
}

// Sorts a chunk's records by shard, stably; those that touch several are named several times.
void sort_by_shard(const Volume& volume, Chunk& chunk) {
    uint32_t next[kShards + 1] = {};
    const auto each = [&](auto&& visit) {
        for (uint32_t i = 0; i < chunk.records.size(); i++)
            for (uint32_t mask = volume.shards[chunk.records[i].corner / kBrickVertices]; mask; mask &= mask - 1)
                visit(__builtin_ctz(mask), i);
    };
    each([&](int shard, uint32_t) { next[shard + 1]++; });
    for (int shard = 0; shard < kShards; shard++) next[shard + 1] += next[shard];
    std::memcpy(chunk.begin, next, sizeof next);
    chunk.order.resize(next[kShards]);
    each([&](int shard, uint32_t i) { chunk.order[next[shard]++] = i; });
}

template <class Work> int guarded(Work work) {
    try {
        std::lock_guard<std::mutex> lock(call_mutex);
        work();
        return 0;
    } catch (const std::exception& error) {
        std::snprintf(error_text, sizeof error_text, "%s", error.what());
        return 1;
    }
}

}  // namespace

}  // namespace videorf
}  // namespace holoreel

using namespace holoreel;
using namespace holoreel::videorf;

VIDEORF_API int videorf_abi() { return VIDEORF_ABI; }
VIDEORF_API const char* videorf_last_error() { return error_text; }
VIDEORF_API void videorf_set_threads(int threads) { set_threads(threads); }
VIDEORF_API int videorf_get_threads() { return get_threads(); }

// 8, 4, or 0 for the widest; returns the width in use, 0 where this machine or build does not have the one asked for.
VIDEORF_API int videorf_set_lanes(int lanes) {
    if (lanes != 0 && lanes != 4 && !(lanes == 8 && wide_here(4))) return 0;
    wanted_lanes = lanes;
    return kernels(4).lanes;
}

VIDEORF_API Volume* videorf_volume_new(const VideorfLattice* lattice) {
    Volume* volume = nullptr;
    guarded([&] { volume = new Volume(*lattice); });
    return volume;
}

VIDEORF_API void videorf_volume_free(Volume* volume) { delete volume; }
VIDEORF_API int64_t videorf_volume_cells(const Volume* volume) { return volume->occupied_cells(); }

// `samples` takes how many samples were taken.
VIDEORF_API int videorf_forward(const Volume* volume, const float* table, int32_t channels, const VideorfRays* rays,
                                const VideorfImages* images, int64_t* samples) {
    return guarded([&] {
        check(*rays);
        const MarchKernels& kernel = kernels(channels);
        const March march{volume, table, *rays, *images, {}};
        std::atomic<int64_t> sum{0};
        pool().run((rays->count + kRun - 1) / kRun, [&](int64_t run) {
            sum += kernel.forward(march, run * kRun, std::min(rays->count, (run + 1) * kRun));
        });
        *samples = sum;
    });
}

// `table_gradient` (rows, C) is overwritten; its last row, which empty vertices share, is 0. Its bits do not depend on the
// number of threads: runs of rays are of a fixed length, and each run of rows is filled by one thread in the order of the rays.
VIDEORF_API int videorf_backward(const Volume* volume, const float* table, int32_t channels, const VideorfRays* rays,
                                 const VideorfImageGradients* gradients, float* table_gradient) {
    return guarded([&] {
        check(*rays);
        const MarchKernels& kernel = kernels(channels);
        const March march{volume, table, *rays, {}, *gradients};
        std::memset(table_gradient, 0, sizeof(float) * volume->rows * channels);
        const int64_t runs = (rays->count + kRun - 1) / kRun;
        for (int64_t slab = 0; slab < runs; slab += kSlabRuns) {
            const int64_t count = std::min(runs - slab, kSlabRuns);
            pool().run(count, [&](int64_t i) {
                const int64_t run = slab + i;
                kernel.backward(march, run * kRun, std::min(rays->count, (run + 1) * kRun), chunks[i]);
                sort_by_shard(*volume, chunks[i]);
            });
            pool().run(kShards, [&](int64_t shard) {
                kernel.scatter(march, static_cast<int>(shard), chunks.data(), count, table_gradient);
            });
        }
    });
}
