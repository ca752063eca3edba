// SPDX-License-Identifier: GPL-3.0-or-later
#include "adam.hpp"

#include <algorithm>
#include <cmath>

#include "thread_pool.hpp"
#include "vectorize.hpp"

namespace holoreel {

namespace {

struct Factors {
    float beta1, rest1, beta2, rest2, rate, unbias2, epsilon;
};

HOLOREEL_CLONES void step_range(float* values, const float* gradient, float* mean, float* mean_square, int64_t count,
                                Factors f) {
    for (int64_t i = 0; i < count; i++) {
        const float g = gradient[i];
        const float m = f.beta1 * mean[i] + f.rest1 * g;
        const float v = f.beta2 * mean_square[i] + f.rest2 * (g * g);
        mean[i] = m;
        mean_square[i] = v;
        values[i] -= f.rate * m / (std::sqrt(v) * f.unbias2 + f.epsilon);
    }
}

}  // namespace

void adam_step(float* values, const float* gradient, float* mean, float* mean_square, int64_t count, double rate,
               double beta1, double beta2, double epsilon, int64_t step) {
    const double n = static_cast<double>(step);
    Factors f;
    f.beta1 = static_cast<float>(beta1);
    f.rest1 = static_cast<float>(1.0 - beta1);
    f.beta2 = static_cast<float>(beta2);
    f.rest2 = static_cast<float>(1.0 - beta2);
    f.rate = static_cast<float>(rate / (1.0 - std::pow(beta1, n)));
    f.unbias2 = static_cast<float>(1.0 / std::sqrt(1.0 - std::pow(beta2, n)));
    f.epsilon = static_cast<float>(epsilon);
    constexpr int64_t kBlock = 1 << 15;
    pool().run((count + kBlock - 1) / kBlock, [&](int64_t block) {
        const int64_t at = block * kBlock;
        step_range(values + at, gradient + at, mean + at, mean_square + at, std::min(kBlock, count - at), f);
    });
}

}  // namespace holoreel
