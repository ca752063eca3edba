// SPDX-License-Identifier: GPL-3.0-or-later
#include "api.hpp"

#include <algorithm>
#include <atomic>
#include <cstdio>
#include <cstring>
#include <memory>
#include <mutex>
#include <stdexcept>

#include "draw.hpp"
#include "march.hpp"
#include "tables.hpp"
#include "thread_pool.hpp"

namespace holoreel {
namespace videorf {

namespace {

constexpr int64_t kRun = 64;  // rays a task marches
constexpr size_t kSpareTapes = 2;
std::mutex call_mutex;  // the pool and the spare tapes serve one call at a time
int wanted_lanes = 0;   // 0: the widest this machine has

thread_local char error_text[256] = "";

bool has_wide() {
#if defined(__x86_64__) || defined(_M_X64)
    return wide_shade() && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#else
    return false;
#endif
}

bool use_wide() { return wanted_lanes != 4 && has_wide(); }

const MarchKernels& kernels(int channels) {
    const MarchKernels* found = use_wide() ? wide_march(channels) : narrow_march(channels);
    if (!found) throw std::invalid_argument("a table has 4, 8 or 16 channels");
    return *found;
}

const TableKernels& table_kernels(int channels) {
    if (channels < 1 || channels > 16) throw std::invalid_argument("a table has 1 to 16 channels");
    return *(use_wide() ? wide_tables(channels) : narrow_tables(channels));
}

void check(const VideorfStep& step) {
    if (step.rows < 0 || step.rows > INT32_MAX || step.neighbors < 0 || step.neighbors > 16 || step.count < 1)
        throw std::invalid_argument("the rows, the neighbors or the count of an optimizer's step are out of range");
}

// Calls work(first, last) for runs of rows.
template <class Work> void each_run(int64_t rows, Work work) {
    constexpr int64_t kRows = 2048;
    pool().run((rows + kRows - 1) / kRows, [&](int64_t run) { work(run * kRows, std::min(rows, (run + 1) * kRows)); });
}

void check(const VideorfRays& rays) {
    if (rays.count < 0 || rays.count > INT32_MAX) throw std::invalid_argument("the number of rays must be under 2^31");
    if (!(rays.step >= 1.0 / 64 && rays.step <= 64))
        throw std::invalid_argument("the step must lie in 1/64 ... 64 spacings");
    if (!(rays.transmittance_min >= 0 && rays.transmittance_min < 1))
        throw std::invalid_argument("the least transmittance must lie in 0 ... 1");
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

// What a forward pass wrote down: all its samples, 64 bytes each for tables of 8 channels.
struct Tape {
    const Volume* volume;
    int channels;
    int64_t count;  // chunks in use
    std::vector<Chunk> chunks;
    std::vector<Scattered> sorted;
    std::vector<uint32_t> next, begins;
};

namespace {

std::vector<std::unique_ptr<Tape>> spare_tapes;  // their memory is warm

std::unique_ptr<Tape> take_tape(const Volume* volume, int channels, int64_t count) {
    std::unique_ptr<Tape> tape;
    if (spare_tapes.empty()) {
        tape = std::make_unique<Tape>();
    } else {
        tape = std::move(spare_tapes.back());
        spare_tapes.pop_back();
    }
    tape->volume = volume;
    tape->channels = channels;
    tape->count = count;
    if (tape->chunks.size() < size_t(count)) tape->chunks.resize(count);
    return tape;
}

// Makes room for the samples in the order of their bricks: `begins` says where those of each brick begin. Returns per part of
// the chunks where it puts its own.
std::vector<uint32_t*> count_bricks(Tape& tape, int64_t parts) {
    const size_t bricks = tape.volume->occupied.size();
    tape.next.assign(parts * bricks, 0);
    std::vector<uint32_t*> next(parts);
    for (int64_t part = 0; part < parts; part++) next[part] = tape.next.data() + part * bricks;
    pool().run(parts, [&](int64_t part) {
        for (int64_t run = part * tape.count / parts; run < (part + 1) * tape.count / parts; run++) {
            const Chunk& chunk = tape.chunks[run];
            for (size_t i = 0; i < chunk.used; i++) next[part][chunk.corner[i] / kBrickVertices]++;
        }
    });
    tape.begins.resize(bricks + 1);
    uint64_t sum = 0;
    for (size_t brick = 0; brick < bricks; brick++) {
        tape.begins[brick] = static_cast<uint32_t>(sum);
        for (int64_t part = 0; part < parts; part++) {
            const uint32_t count = next[part][brick];
            next[part][brick] = static_cast<uint32_t>(sum);
            sum += count;
        }
    }
    if (sum > UINT32_MAX) throw std::invalid_argument("the rays take more than 2^32 samples");
    tape.begins[bricks] = static_cast<uint32_t>(sum);
    if (tape.sorted.size() < sum) tape.sorted.resize(sum);
    return next;
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
    if (lanes != 0 && lanes != 4 && !(lanes == 8 && has_wide())) return 0;
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

// `samples` takes how many samples were taken. With `tape` there will be a way back: `*tape` is what videorf_backward needs, to
// be given to videorf_tape_free, and not to outlive the volume.
VIDEORF_API int videorf_forward(const Volume* volume, const float* table, int32_t channels, const VideorfRays* rays,
                                const VideorfImages* images, int64_t* samples, Tape** tape) {
    return guarded([&] {
        check(*rays);
        const MarchKernels& kernel = kernels(channels);
        const March march{volume, table, *rays, *images};
        const int64_t runs = (rays->count + kRun - 1) / kRun;
        std::unique_ptr<Tape> taken = tape ? take_tape(volume, channels, runs) : nullptr;
        std::atomic<int64_t> sum{0};
        pool().run(runs, [&](int64_t run) {
            Chunk* chunk = taken ? &taken->chunks[run] : nullptr;
            sum += kernel.forward(march, run * kRun, std::min(rays->count, (run + 1) * kRun), chunk);
        });
        *samples = sum;
        if (tape) *tape = taken.release();
    });
}

// `table_gradient` (rows, C) is overwritten; its last row, which empty vertices share, is 0. Its bits do not depend on the
// number of threads: samples are sorted by brick, and in a brick by ray; bricks are added one after the other, those that share
// vertices never at once. A tape serves once.
VIDEORF_API int videorf_backward(Tape* tape, const VideorfImageGradients* gradients, float* table_gradient) {
    return guarded([&] {
        const Volume& volume = *tape->volume;
        const MarchKernels& kernel = kernels(tape->channels);
        const int64_t parts = std::min<int64_t>(tape->count, 4 * get_threads());
        std::vector<uint32_t*> next = count_bricks(*tape, parts);
        std::memset(table_gradient, 0, sizeof(float) * volume.rows * tape->channels);
        pool().run(parts, [&](int64_t part) {
            for (int64_t run = part * tape->count / parts; run < (part + 1) * tape->count / parts; run++)
                kernel.backward(*gradients, volume.spacing, run * kRun, tape->chunks[run], next[part], tape->sorted.data());
        });
        for (const std::vector<Column>& columns : volume.columns)
            pool().run(static_cast<int64_t>(columns.size()), [&](int64_t i) {
                kernel.scatter(volume, *gradients, columns[i], tape->sorted.data(), tape->begins.data(), table_gradient);
            });
    });
}

VIDEORF_API void videorf_tape_free(Tape* tape) {
    std::lock_guard<std::mutex> lock(call_mutex);
    std::unique_ptr<Tape> given(tape);
    if (given && spare_tapes.size() < kSpareTapes) spare_tapes.push_back(std::move(given));
}

VIDEORF_API int videorf_draw(const Volume* volume, const float* table, int32_t channels, const VideorfNetwork* network,
                             const VideorfView* view, const VideorfPicture* picture) {
    return guarded([&] {
        check(*network, channels);
        check(*view);
        check(VideorfRays{0, nullptr, nullptr, nullptr, view->step, view->transmittance_min});
        const Shade shade = use_wide() ? wide_shade() : narrow_shade();
        draw(*volume, table, channels, *network, *view, kernels(channels), shade, *picture);
    });
}

// Moves `values`, and brings `mean` and `square` up to date. The bits do not depend on the number of threads.
VIDEORF_API int videorf_optimize(const VideorfStep* step) {
    return guarded([&] {
        check(*step);
        const TableKernels& kernel = table_kernels(step->channels);
        each_run(step->rows, [&](int64_t first, int64_t last) { kernel.moments(*step, first, last); });
        each_run(step->rows, [&](int64_t first, int64_t last) { kernel.move(*step, first, last); });
    });
}

// out = rows + uniform noise of -step / 2 ... step / 2, which hangs on `key` and the place in the table alone.
VIDEORF_API int videorf_add_noise(const float* rows, int64_t count, int32_t channels, const float* step, uint32_t key,
                                  float* out) {
    return guarded([&] {
        const TableKernels& kernel = table_kernels(channels);
        each_run(count, [&](int64_t first, int64_t last) { kernel.noise(rows, step, channels, key, first, last, out); });
    });
}
