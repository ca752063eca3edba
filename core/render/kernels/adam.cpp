// SPDX-License-Identifier: GPL-3.0-or-later
#include "adam.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "thread_pool.hpp"
#include "vectorize.hpp"

namespace holoreel {

namespace {

constexpr int64_t kBlock = 1 << 13;  // values per task, about

struct Factors {
    float beta1, rest1, beta2, rest2, unbias2, epsilon;
};

HOLOREEL_CLONES void step_flat(const HoloreelAdamGroup& g, int64_t begin, int64_t end, const Factors& f, float rate) {
    float *values = g.values, *mean = g.mean, *mean_square = g.mean_square;
    const float *gradient = g.gradient, low = static_cast<float>(g.low), high = static_cast<float>(g.high);
    const float beta1 = f.beta1, rest1 = f.rest1, beta2 = f.beta2, rest2 = f.rest2, unbias2 = f.unbias2, epsilon = f.epsilon;
    for (int64_t i = begin; i < end; i++) {
        const float d = gradient[i];
        const float m = beta1 * mean[i] + rest1 * d;
        const float v = beta2 * mean_square[i] + rest2 * (d * d);
        mean[i] = m;
        mean_square[i] = v;
        const float moved = values[i] - rate * m / (std::sqrt(v) * unbias2 + epsilon);
        values[i] = moved < low ? low : moved > high ? high : moved;
    }
}

// As above, with a rate for each value.
HOLOREEL_CLONES void step_rated(const HoloreelAdamGroup& g, int64_t begin, int64_t end, const Factors& f,
                                const float* rates) {
    float *values = g.values, *mean = g.mean, *mean_square = g.mean_square;
    const float *gradient = g.gradient, low = static_cast<float>(g.low), high = static_cast<float>(g.high);
    const float beta1 = f.beta1, rest1 = f.rest1, beta2 = f.beta2, rest2 = f.rest2, unbias2 = f.unbias2, epsilon = f.epsilon;
    for (int64_t i = begin; i < end; i++) {
        const float d = gradient[i];
        const float m = beta1 * mean[i] + rest1 * d;
        const float v = beta2 * mean_square[i] + rest2 * (d * d);
        mean[i] = m;
        mean_square[i] = v;
        const float moved = values[i] - rates[i - begin] * m / (std::sqrt(v) * unbias2 + epsilon);
        values[i] = moved < low ? low : moved > high ? high : moved;
    }
}

int64_t rows_per_task(const HoloreelAdamGroup& g) { return std::max<int64_t>(1, kBlock / g.columns); }

void step_rows(const HoloreelAdamGroup& g, int64_t task, const Factors& f, float rate) {
    const int64_t first = task * rows_per_task(g), last = std::min(first + rows_per_task(g), g.rows);
    if (!g.row_rates && !g.column_rates) {
        step_flat(g, first * g.columns, last * g.columns, f, rate);
        return;
    }
    std::vector<float> rates((last - first) * g.columns);
    float* out = rates.data();
    for (int64_t row = first; row < last; row++) {
        const float row_rate = g.row_rates ? rate * g.row_rates[row] : rate;
        for (int64_t column = 0; column < g.columns; column++)
            *out++ = g.column_rates ? row_rate * g.column_rates[column] : row_rate;
    }
    step_rated(g, first * g.columns, last * g.columns, f, rates.data());
}

}  // namespace

void adam_step(const HoloreelAdamGroup* groups, int64_t count, double beta1, double beta2, double epsilon, int64_t step) {
    const double n = static_cast<double>(step);
    Factors f;
    f.beta1 = static_cast<float>(beta1);
    f.rest1 = static_cast<float>(1.0 - beta1);
    f.beta2 = static_cast<float>(beta2);
    f.rest2 = static_cast<float>(1.0 - beta2);
    f.unbias2 = static_cast<float>(1.0 / std::sqrt(1.0 - std::pow(beta2, n)));
    f.epsilon = static_cast<float>(epsilon);
    const double unbias1 = 1.0 / (1.0 - std::pow(beta1, n));
    std::vector<int64_t> first_task(count + 1, 0);
    for (int64_t k = 0; k < count; k++) {
        const int64_t rows = rows_per_task(groups[k]);
        first_task[k + 1] = first_task[k] + (groups[k].rows + rows - 1) / rows;
    }
    pool().run(first_task[count], [&](int64_t task) {
        const int64_t k = std::upper_bound(first_task.begin(), first_task.end(), task) - first_task.begin() - 1;
        step_rows(groups[k], task - first_task[k], f, static_cast<float>(groups[k].rate * unbias1));
    });
}

}  // namespace holoreel
