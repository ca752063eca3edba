// SPDX-License-Identifier: GPL-3.0-or-later
// All rays of a pinhole start at one point and are turned by one rotation. So the part of the hidden layer that looks at
// origins is one constant per picture, and the part that looks at directions is turned into camera axes beforehand; its
// gradient is turned back afterwards.
#include "decode.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "thread_pool.hpp"

namespace holoreel {

namespace {

constexpr int kRowsPerTask = 4;

// What a pass needs; `plane_x` is owned here.
struct Prepared {
    std::vector<float> plane_x;
    double origin[3];
    DecodeJob job{};

    Prepared(const HoloreelCamera& camera, const HoloreelDecoder& decoder, const float* features) {
        const double* V = camera.world_to_camera;
        for (int k = 0; k < 3; k++) origin[k] = -(V[k] * V[3] + V[4 + k] * V[7] + V[8 + k] * V[11]);
        // Whole vectors are read, also at the end of a row.
        plane_x.assign(camera.width + kMaxLanes, 0.0f);
        for (int x = 0; x < camera.width; x++) plane_x[x] = static_cast<float>((x + 0.5 - camera.cx) / camera.fx);
        for (int j = 0; j < kHidden; j++) {
            const float* row = decoder.hidden + j * kDecoderInputs;
            for (int k = 0; k < kDecoded; k++) job.feature_weights[j][k] = row[k];
            double bias = 0.0;
            for (int k = 0; k < 3; k++) {
                bias += row[6 + k] * origin[k];
                job.ray_weights[j][k] = static_cast<float>(V[4 * k] * row[9] + V[4 * k + 1] * row[10] + V[4 * k + 2] * row[11]);
            }
            job.bias[j] = static_cast<float>(bias);
            for (int c = 0; c < 3; c++) job.output_weights[c][j] = decoder.output[c * kHidden + j];
        }
        job.plane_x = plane_x.data();
        job.fy = camera.fy;
        job.cy = camera.cy;
        job.width = camera.width;
        job.activation = static_cast<Activation>(decoder.activation);
        job.features = features;
    }
};

}  // namespace

void decode(const HoloreelCamera& camera, const HoloreelDecoder& decoder, const DecodeKernels& kernels,
            const float* features, float* image) {
    Prepared prepared(camera, decoder, features);
    prepared.job.image = image;
    pool().run((camera.height + kRowsPerTask - 1) / kRowsPerTask, [&](int64_t task) {
        const int end = std::min<int>((task + 1) * kRowsPerTask, camera.height);
        for (int row = static_cast<int>(task) * kRowsPerTask; row < end; row++) kernels.forward(prepared.job, row);
    });
}

void decode_backward(const HoloreelCamera& camera, const HoloreelDecoder& decoder, const DecodeKernels& kernels,
                     const float* features, const float* image_gradient, float* features_gradient,
                     float* hidden_gradient, float* output_gradient) {
    Prepared prepared(camera, decoder, features);
    prepared.job.image_gradient = image_gradient;
    prepared.job.features_gradient = features_gradient;
    const int64_t tasks = (camera.height + kRowsPerTask - 1) / kRowsPerTask;
    std::vector<DecodeSums> parts(tasks);  // one per task and added in order: the same for any number of threads
    pool().run(tasks, [&](int64_t task) {
        const int end = std::min<int>((task + 1) * kRowsPerTask, camera.height);
        for (int row = static_cast<int>(task) * kRowsPerTask; row < end; row++)
            kernels.backward(prepared.job, row, parts[task]);
    });
    DecodeSums sum{};
    for (const DecodeSums& part : parts)
        for (int k = 0; k < DecodeSums::kCount; k++) sum.values[k] += part.values[k];
    const double* V = camera.world_to_camera;
    for (int j = 0; j < kHidden; j++) {
        float* row = hidden_gradient + j * kDecoderInputs;
        const double* hidden = sum.values + j * DecodeSums::kPerHidden;
        for (int k = 0; k < kDecoded; k++) row[k] = static_cast<float>(hidden[k]);
        const double* ray = hidden + kDecoded;
        const double total = hidden[kDecoded + 3];
        for (int k = 0; k < 3; k++) {
            row[6 + k] = static_cast<float>(total * prepared.origin[k]);
            row[9 + k] = static_cast<float>(V[k] * ray[0] + V[4 + k] * ray[1] + V[8 + k] * ray[2]);
        }
        for (int c = 0; c < 3; c++)
            output_gradient[c * kHidden + j] = static_cast<float>(hidden[kDecoded + 4 + c]);
    }
}

}  // namespace holoreel
