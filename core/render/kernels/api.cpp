// SPDX-License-Identifier: GPL-3.0-or-later
#include "api.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <mutex>
#include <stdexcept>
#include <vector>

#include "adam.hpp"
#include "decode.hpp"
#include "frame.hpp"
#include "loss.hpp"
#include "thread_pool.hpp"
#include "warp.hpp"

namespace holoreel {

namespace {

std::mutex call_mutex;  // the scratch buffers and the pool serve one call at a time
Scratch scratch;
std::vector<std::unique_ptr<Frame>> spare_frames;  // their buffers are warm
constexpr size_t kSpareFrames = 4;
int wanted_lanes = 0;  // 0: the widest this machine has

thread_local char error_text[256] = "";

void set_error(const char* text) { std::snprintf(error_text, sizeof error_text, "%s", text); }

const RasterKernels* kernels_of(int lanes) {
    if (lanes == 4) return narrow_kernels();
#if defined(__x86_64__) || defined(_M_X64)
    if (lanes == 8 && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return wide_kernels();
#endif
    return nullptr;
}

const RasterKernels& active_kernels() {
    const RasterKernels* wide = wanted_lanes == 4 ? nullptr : kernels_of(8);
    return wide ? *wide : *narrow_kernels();
}

class Stopwatch {
public:
    double lap() {
        const auto now = Clock::now();
        const double seconds = std::chrono::duration<double>(now - last_).count();
        last_ = now;
        return seconds;
    }

private:
    using Clock = std::chrono::steady_clock;
    Clock::time_point last_ = Clock::now();
};

void check(const HoloreelCamera& camera) {
    if (camera.width < 1 || camera.height < 1 || camera.width > 65536 || camera.height > 65536)
        throw std::invalid_argument("width and height must lie in 1 ... 65536");
}

void check(const HoloreelGaussians& g, const HoloreelCamera& camera, const HoloreelRules& rules) {
    if (g.count < 0 || g.count > INT32_MAX) throw std::invalid_argument("the number of Gaussians must be under 2^31");
    if (g.rows && (g.listed < 0 || g.listed > INT32_MAX)) throw std::invalid_argument("the list of rows is too long");
    if (g.channels < 1 || g.channels > kMaxChannels) throw std::invalid_argument("features must have 1 to 16 channels");
    check(camera);
    if (!(rules.alpha_min >= 1e-6 && rules.alpha_min < rules.alpha_max && rules.alpha_max < 1.0))
        throw std::invalid_argument("alpha_min and alpha_max must obey 1e-6 <= alpha_min < alpha_max < 1");
}

TileJob job_of(const Frame& frame, const HoloreelRules& rules, const HoloreelImages& images) {
    TileJob job{};
    job.records = frame.records.data();
    job.record_stride = record_stride(frame.padded_channels);
    job.entries = frame.entries.data();
    job.tile_begin = frame.tile_begin.data();
    job.tiles_x = frame.tiles_x;
    job.width = frame.width;
    job.height = frame.height;
    job.channels = frame.channels;
    job.log2_alpha_min = static_cast<float>(std::log2(rules.alpha_min));
    job.alpha_max = static_cast<float>(rules.alpha_max);
    job.transmittance_min = static_cast<float>(rules.transmittance_min);
    job.background = images.background;
    job.features = images.features;
    job.alpha = images.alpha;
    job.depth = images.depth;
    job.transmittance = images.transmittance;
    return job;
}

void run_tiles(const Frame& frame, TileKernel kernel, const TileJob& job) {
    constexpr int kTilesPerTask = 4;
    const int tiles = frame.tiles();
    pool().run((tiles + kTilesPerTask - 1) / kTilesPerTask, [&](int64_t task) {
        const int end = std::min<int>((task + 1) * kTilesPerTask, tiles);
        for (int tile = static_cast<int>(task) * kTilesPerTask; tile < end; tile++) kernel(job, tile);
    });
}

void forward(const HoloreelGaussians& g, const HoloreelCamera& camera, const HoloreelRules& rules,
             const HoloreelImages& images, Frame& frame) {
    check(g, camera, rules);
    frame.count = g.rows ? g.listed : g.count;
    frame.width = camera.width;
    frame.height = camera.height;
    frame.channels = g.channels;
    frame.padded_channels = padded_channels(g.channels);
    frame.tiles_x = (camera.width + kTile - 1) / kTile;
    frame.tiles_y = (camera.height + kTile - 1) / kTile;
    frame.timings = {};
    Stopwatch watch;
    project_all(g, camera, rules, frame, scratch);
    frame.timings.project = watch.lap();
    sort_by_depth(frame, scratch);
    frame.timings.sort = watch.lap();
    bin_to_tiles(frame, scratch);
    frame.timings.bin = watch.lap();
    const TileKernel kernel = active_kernels().forward(frame.padded_channels, images.depth != nullptr);
    run_tiles(frame, kernel, job_of(frame, rules, images));
    frame.timings.blend = watch.lap();
}

void backward(const HoloreelGaussians& g, const HoloreelCamera& camera, const HoloreelRules& rules,
              const HoloreelImages& images, const HoloreelImageGradients& image_gradients,
              const HoloreelGradients& gradients, Frame& frame) {
    check(g, camera, rules);
    if (g.rows) throw std::invalid_argument("there is no backward pass for a list of rows");
    if (g.count != frame.count || g.channels != frame.channels || camera.width != frame.width ||
        camera.height != frame.height)
        throw std::invalid_argument("the backward pass got other arrays than the forward pass");
    if (image_gradients.alpha && !images.transmittance)
        throw std::invalid_argument("the gradient of alpha needs the transmittance");
    Stopwatch watch;
    const bool with_depth = image_gradients.depth && images.depth;
    TileJob job = job_of(frame, rules, images);
    job.grad_features = image_gradients.features;
    job.grad_alpha = image_gradients.alpha;
    job.grad_depth = image_gradients.depth;
    const int64_t width = kMoments + frame.padded_channels + (with_depth ? 1 : 0);
    scratch.sums.reserve(static_cast<size_t>(frame.intersections * width));
    job.sums = scratch.sums.data();
    run_tiles(frame, active_kernels().backward(frame.padded_channels, with_depth), job);
    frame.timings.backward_blend = watch.lap();
    gather_gradients(g, camera, rules, frame, job.sums, with_depth, gradients);
    frame.timings.backward_gather = watch.lap();
}

// Runs `body` under the lock; turns an exception into an error text and false.
template <class Body>
bool guarded(const Body& body) {
    std::lock_guard<std::mutex> lock(call_mutex);
    try {
        body();
        return true;
    } catch (const std::bad_alloc&) {
        set_error("out of memory");
    } catch (const std::exception& error) {
        set_error(error.what());
    }
    return false;
}

}  // namespace

}  // namespace holoreel

using namespace holoreel;

HOLOREEL_API int holoreel_kernels_abi() { return HOLOREEL_ABI; }
HOLOREEL_API const char* holoreel_last_error() { return error_text; }
HOLOREEL_API void holoreel_set_threads(int threads) { set_threads(threads); }
HOLOREEL_API int holoreel_get_threads() { return get_threads(); }

// Chooses the kernels: 8 lanes, 4 lanes, or 0 for the best. Returns the lanes in use from now on, or 0 where this machine
// or build does not have the ones asked for (nothing changes then).
HOLOREEL_API int holoreel_set_lanes(int lanes) {
    std::lock_guard<std::mutex> lock(call_mutex);
    if (lanes != 0 && !kernels_of(lanes)) return 0;
    wanted_lanes = lanes;
    return active_kernels().lanes;
}

// Renders; returns what the backward pass needs (give it back with holoreel_frame_free), or null with an error text.
HOLOREEL_API void* holoreel_forward(const HoloreelGaussians* gaussians, const HoloreelCamera* camera,
                                    const HoloreelRules* rules, const HoloreelImages* images) {
    std::unique_ptr<Frame> frame;
    const bool good = guarded([&] {
        if (spare_frames.empty()) {
            frame = std::make_unique<Frame>();
        } else {
            frame = std::move(spare_frames.back());
            spare_frames.pop_back();
        }
        forward(*gaussians, *camera, *rules, *images, *frame);
    });
    return good ? frame.release() : nullptr;
}

// Returns 0, or -1 with an error text. `images` are those the forward pass wrote.
HOLOREEL_API int holoreel_backward(void* frame, const HoloreelGaussians* gaussians, const HoloreelCamera* camera,
                                   const HoloreelRules* rules, const HoloreelImages* images,
                                   const HoloreelImageGradients* image_gradients, const HoloreelGradients* gradients) {
    const bool good = guarded([&] {
        backward(*gaussians, *camera, *rules, *images, *image_gradients, *gradients, *static_cast<Frame*>(frame));
    });
    return good ? 0 : -1;
}

HOLOREEL_API void holoreel_frame_free(void* frame) {
    std::unique_ptr<Frame> owned(static_cast<Frame*>(frame));
    std::lock_guard<std::mutex> lock(call_mutex);
    if (owned && spare_frames.size() < kSpareFrames) spare_frames.push_back(std::move(owned));
}

HOLOREEL_API int64_t holoreel_frame_intersections(const void* frame) {
    return static_cast<const Frame*>(frame)->intersections;
}

HOLOREEL_API int64_t holoreel_frame_visible(const void* frame) { return static_cast<const Frame*>(frame)->visible; }

HOLOREEL_API void holoreel_frame_timings(const void* frame, HoloreelTimings* out) {
    *out = static_cast<const Frame*>(frame)->timings;
}

// Returns 0, or -1 with an error text. The target is values, or bytes that stand for 255ths; the other is null. Writes the
// loss, the mean squared error, and the gradient of the loss with respect to `image` where that is not null.
HOLOREEL_API int holoreel_l1_dssim(const float* image, const float* target, const uint8_t* target_bytes, int height,
                                   int width, int channels, double weight, double* loss, double* squared_error,
                                   float* gradient) {
    const bool good = guarded([&] {
        if (height < 1 || width < 1 || channels < 1 || static_cast<int64_t>(width) * channels > INT32_MAX / 2)
            throw std::invalid_argument("the image is empty or too wide");
        const Loss result = l1_dssim(image, {target, target_bytes}, height, width, channels, weight, gradient);
        *loss = result.value;
        *squared_error = result.squared_error;
    });
    return good ? 0 : -1;
}

HOLOREEL_API int holoreel_adam_step(const HoloreelAdamGroup* groups, int64_t count, double beta1, double beta2,
                                    double epsilon, int64_t step) {
    const bool good = guarded([&] { adam_step(groups, count, beta1, beta2, epsilon, step); });
    return good ? 0 : -1;
}

// Returns 0, or -1 with an error text; `features` (H, W, 9) become `image` (H, W, 3).
HOLOREEL_API int holoreel_decode(const HoloreelCamera* camera, const HoloreelDecoder* decoder, const float* features,
                                 float* image) {
    const bool good = guarded([&] {
        check(*camera);
        decode(*camera, *decoder, active_kernels().decode, features, image);
    });
    return good ? 0 : -1;
}

// Returns 0, or -1 with an error text. Overwrites the gradients; that of the features may be null.
HOLOREEL_API int holoreel_decode_backward(const HoloreelCamera* camera, const HoloreelDecoder* decoder,
                                          const float* features, const float* image_gradient, float* features_gradient,
                                          float* hidden_gradient, float* output_gradient) {
    const bool good = guarded([&] {
        check(*camera);
        decode_backward(*camera, *decoder, active_kernels().decode, features, image_gradient, features_gradient,
                        hidden_gradient, output_gradient);
    });
    return good ? 0 : -1;
}

// Fills the spans; returns 0, or -1 with an error text. Those in `map` may be null here and in the forward pass.
HOLOREEL_API int holoreel_warp_spans(const HoloreelWarp* map, int32_t* spans) {
    return guarded([&] { warp_spans(*map, active_kernels().warp, spans); }) ? 0 : -1;
}

// Returns 0, or -1 with an error text; `source` (H', W', C) becomes `image` (H, W, C).
HOLOREEL_API int holoreel_warp(const HoloreelWarp* map, const float* source, float* image) {
    return guarded([&] { warp(*map, active_kernels().warp, source, image); }) ? 0 : -1;
}

// Returns 0, or -1 with an error text. Overwrites the gradient of the source.
HOLOREEL_API int holoreel_warp_backward(const HoloreelWarp* map, const float* image_gradient, float* source_gradient) {
    return guarded([&] { warp_backward(*map, active_kernels().warp, image_gradient, source_gradient); }) ? 0 : -1;
}
