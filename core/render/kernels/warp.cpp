// SPDX-License-Identifier: GPL-3.0-or-later
// Forward, each pixel of the lens gathers. Backward, each band of the pinhole's rows walks through the pixels whose samples
// touch it, in their order: no two threads write to one place, and sums are the same for any number of threads.
#include "warp.hpp"

#include <algorithm>
#include <stdexcept>

#include "buffer.hpp"
#include "thread_pool.hpp"

namespace holoreel {

namespace {

constexpr int kRowsPerTask = 4;
constexpr int kBandRows = 16;  // of the pinhole's picture: their sums stay in the cache

WarpJob job_of(const HoloreelWarp& warp) {
    if (warp.width < 1 || warp.height < 1 || warp.source_width < 1 || warp.source_height < 1)
        throw std::invalid_argument("the picture is empty");
    if (std::max({warp.width, warp.height, warp.source_width, warp.source_height}) > 65536)
        throw std::invalid_argument("width and height must lie in 1 ... 65536");
    if (warp.channels < 1 || warp.channels > kMaxChannels) throw std::invalid_argument("the picture must have 1 to 16 channels");
    if (warp.samples < 1 || warp.samples > kMaxWarpSamples) throw std::invalid_argument("a pixel must have 1 to 4 x 4 samples");
    WarpJob job{};
    job.places = warp.places;
    job.valid = warp.valid;
    job.spans = warp.spans;
    job.width = warp.width;
    job.height = warp.height;
    job.source_width = warp.source_width;
    job.source_height = warp.source_height;
    job.channels = warp.channels;
    job.samples = warp.samples;
    return job;
}

template <class Row>
void run_rows(const WarpJob& job, const Row& row) {
    pool().run((job.height + kRowsPerTask - 1) / kRowsPerTask, [&](int64_t task) {
        const int end = std::min<int>((task + 1) * kRowsPerTask, job.height);
        for (int v = static_cast<int>(task) * kRowsPerTask; v < end; v++) row(v);
    });
}

}  // namespace

void warp_spans(const HoloreelWarp& warp, const WarpKernels& kernels, int32_t* spans) {
    const WarpJob job = job_of(warp);
    run_rows(job, [&](int row) { kernels.spans(job, row, spans); });
}

void warp(const HoloreelWarp& warp, const WarpKernels& kernels, const float* source, float* image) {
    WarpJob job = job_of(warp);
    job.source = source;
    job.image = image;
    run_rows(job, [&](int row) { kernels.forward(job, row); });
}

void warp_backward(const HoloreelWarp& warp, const WarpKernels& kernels, const float* image_gradient,
                   float* source_gradient) {
    WarpJob job = job_of(warp);
    if (!job.spans) throw std::invalid_argument("the gradient needs the spans");
    job.image_gradient = image_gradient;
    job.source_gradient = source_gradient;
    const int padded = (job.channels + kMaxLanes - 1) / kMaxLanes * kMaxLanes;
    pool().run((job.source_height + kBandRows - 1) / kBandRows, [&](int64_t task) {
        thread_local Buffer<float> sums;
        sums.reserve(static_cast<size_t>(kBandRows) * job.source_width * padded);
        const int first = static_cast<int>(task) * kBandRows;
        kernels.backward(job, first, std::min(kBandRows, job.source_height - first), sums.data());
    });
}

}  // namespace holoreel
