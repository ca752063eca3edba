// SPDX-License-Identifier: GPL-3.0-or-later
// The training loss (1 - w) L1 + w (1 - SSIM) and its gradient in one go. SSIM as in Wang et al. 2004 with an 11 x 11
// Gaussian window of sigma 1.5 and zeros beyond the border, per channel. Images are (H, W, C), so a row is W C values and
// the neighbors of a value in its row lie C apart.
#include "loss.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "buffer.hpp"
#include "thread_pool.hpp"
#include "vectorize.hpp"

namespace holoreel {

namespace {

constexpr int kReach = 5, kTaps = 2 * kReach + 1, kBand = 90;  // rows per task
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;

struct Window {
    float taps[kReach + 1];  // from the center outwards

    Window() {
        double sum = 0.0, values[kReach + 1];
        for (int k = 0; k <= kReach; k++) {
            values[k] = std::exp(-k * k / (2 * 1.5 * 1.5));
            sum += k ? 2 * values[k] : values[k];
        }
        for (int k = 0; k <= kReach; k++) taps[k] = static_cast<float>(values[k] / sum);
    }
};

// out[i] = sum over k of taps[|k|] in[i + k step]; `in` may be read kReach steps beyond both ends.
HOLOREEL_HEAVY_CLONES void blur_line(const float* in, int step, int count, const float* taps, float* __restrict out) {
    const float t0 = taps[0], t1 = taps[1], t2 = taps[2], t3 = taps[3], t4 = taps[4], t5 = taps[5];
    const float *l1 = in - step, *l2 = l1 - step, *l3 = l2 - step, *l4 = l3 - step, *l5 = l4 - step;
    const float *r1 = in + step, *r2 = r1 + step, *r3 = r2 + step, *r4 = r3 + step, *r5 = r4 + step;
    for (int i = 0; i < count; i++)
        out[i] = t0 * in[i] + t1 * (l1[i] + r1[i]) + t2 * (l2[i] + r2[i]) + t3 * (l3[i] + r3[i]) +
                 t4 * (l4[i] + r4[i]) + t5 * (l5[i] + r5[i]);
}

// out[i] = sum over k of taps[|k|] rows[kReach + k][i].
HOLOREEL_HEAVY_CLONES void blur_column(const float* const* rows, int count, const float* taps, float* __restrict out) {
    const float *r0 = rows[0], *r1 = rows[1], *r2 = rows[2], *r3 = rows[3], *r4 = rows[4], *r5 = rows[5];
    const float *r6 = rows[6], *r7 = rows[7], *r8 = rows[8], *r9 = rows[9], *r10 = rows[10];
    const float t0 = taps[0], t1 = taps[1], t2 = taps[2], t3 = taps[3], t4 = taps[4], t5 = taps[5];
    for (int i = 0; i < count; i++)
        out[i] = t0 * r5[i] + t1 * (r4[i] + r6[i]) + t2 * (r3[i] + r7[i]) + t3 * (r2[i] + r8[i]) +
                 t4 * (r1[i] + r9[i]) + t5 * (r0[i] + r10[i]);
}

// squares = x² + y², and y becomes x y.
HOLOREEL_HEAVY_CLONES void combine(const float* __restrict x, int count, float* __restrict y, float* __restrict squares) {
    for (int i = 0; i < count; i++) {
        squares[i] = x[i] * x[i] + y[i] * y[i];
        y[i] *= x[i];
    }
}

HOLOREEL_HEAVY_CLONES void from_bytes(const uint8_t* bytes, int count, float* __restrict out) {
    for (int i = 0; i < count; i++) out[i] = static_cast<float>(bytes[i]) * (1.0f / 255.0f);
}

// SSIM of one row from its blurred x, y, x² + y², x y; and dSSIM/d(blurred x), /d(blurred x²), /d(blurred x y).
HOLOREEL_HEAVY_CLONES void ssim_row(const float* const* m, int count, float* __restrict ssim, float* __restrict d_x,
                                    float* __restrict d_xx, float* __restrict d_xy) {
    const float *mx = m[0], *my = m[1], *msquares = m[2], *mxy = m[3];
    for (int i = 0; i < count; i++) {
        const float x = mx[i], y = my[i];
        const float xy = x * y, squares = x * x + y * y;
        const float a1 = 2 * xy + kC1, a2 = 2 * (mxy[i] - xy) + kC2;
        const float b1 = squares + kC1, b2 = (msquares[i] - squares) + kC2;
        const float inverse = 1.0f / (b1 * b2), s = a1 * a2 * inverse;
        ssim[i] = s;
        d_x[i] = 2 * (y * (a2 - a1) * inverse + x * s * (b1 - b2) * inverse);
        d_xx[i] = -s * b1 * inverse;
        d_xy[i] = 2 * a1 * inverse;
    }
}

HOLOREEL_HEAVY_CLONES void gradient_row(const float* x, const float* y, const float* const* d, int count, float l1_share,
                                  float ssim_share, float* __restrict out) {
    const float *d_x = d[0], *d_xx = d[1], *d_xy = d[2];
    for (int i = 0; i < count; i++) {
        const float difference = x[i] - y[i];
        const float sign = static_cast<float>(difference > 0.0f) - static_cast<float>(difference < 0.0f);
        out[i] = l1_share * sign - ssim_share * (d_x[i] + 2 * x[i] * d_xx[i] + y[i] * d_xy[i]);
    }
}

struct Sums {
    double ssim = 0.0, absolute = 0.0, squared = 0.0;
};

HOLOREEL_HEAVY_CLONES void add_row(const float* ssim, const float* x, const float* y, int count, Sums& sums) {
    constexpr int kParts = 8;
    double parts[3][kParts] = {};
    int i = 0;
    for (; i + kParts <= count; i += kParts)
        for (int k = 0; k < kParts; k++) {
            const float difference = x[i + k] - y[i + k];
            parts[0][k] += ssim[i + k];
            parts[1][k] += std::fabs(difference);
            parts[2][k] += difference * difference;
        }
    for (; i < count; i++) {
        const float difference = x[i] - y[i];
        parts[0][0] += ssim[i];
        parts[1][0] += std::fabs(difference);
        parts[2][0] += difference * difference;
    }
    for (int k = 0; k < kParts; k++) {
        sums.ssim += parts[0][k];
        sums.absolute += parts[1][k];
        sums.squared += parts[2][k];
    }
}

// Maps being blurred while their rows go by: the latest rows, already blurred along the row.
class Blur {
public:
    Blur(int maps, int64_t row_values, int channels)
        : maps_(maps),
          values_(row_values),
          channels_(channels),
          margin_(kReach * channels),
          lines_(static_cast<size_t>(maps) * kTaps * row_values),
          padded_(row_values + 2 * margin_, 0.0f),
          result_(static_cast<size_t>(maps) * row_values) {}

    // Room to write a row; zeros lie on both sides.
    float* padded_row() { return padded_.data() + margin_; }

    // Takes the padded row, or another that has kReach zero pixels on both sides.
    void put_row(int map, int row) { put_row(map, row, padded_row()); }
    void put_row(int map, int row, const float* values) {
        blur_line(values, channels_, static_cast<int>(values_), window().taps, line(map, row));
    }
    void put_zeros(int row) {
        for (int map = 0; map < maps_; map++) std::fill_n(line(map, row), values_, 0.0f);
    }

    // The maps blurred both ways at `row`, once the kReach rows after it were put.
    const float* const* at(int row) {
        for (int map = 0; map < maps_; map++) {
            const float* rows[kTaps];
            for (int k = 0; k < kTaps; k++) rows[k] = line(map, row + k - kReach);
            float* out = result_.data() + map * values_;
            blur_column(rows, static_cast<int>(values_), window().taps, out);
            pointers_[map] = out;
        }
        return pointers_;
    }

private:
    static const Window& window() {
        static const Window window;
        return window;
    }
    float* line(int map, int row) { return lines_.data() + (static_cast<int64_t>(map) * kTaps + (row + kTaps) % kTaps) * values_; }

    int maps_;
    int64_t values_;
    int channels_;
    int64_t margin_;
    std::vector<float> lines_, padded_, result_;
    const float* pointers_[4] = {};
};

// The rows of the target as values.
class TargetRows {
public:
    TargetRows(const Target& target, int64_t row_values)
        : target_(target), values_(row_values), row_(target.bytes ? row_values : 0) {}

    const float* at(int row) {
        if (!target_.bytes) return target_.values + row * values_;
        copy(row, row_.data());
        return row_.data();
    }
    void copy(int row, float* out) const {
        if (target_.bytes)
            from_bytes(target_.bytes + row * values_, static_cast<int>(values_), out);
        else
            std::memcpy(out, target_.values + row * values_, sizeof(float) * values_);
    }

private:
    const Target& target_;
    int64_t values_;
    std::vector<float> row_;
};

}  // namespace

Loss l1_dssim(const float* image, const Target& target, int height, int width, int channels, double weight,
              float* gradient) {
    static Buffer<float> derivative_buffer;  // calls are serialized
    const int64_t row_values = static_cast<int64_t>(width) * channels, total = row_values * height;
    const int values = static_cast<int>(row_values);
    const int64_t bands = (height + kBand - 1) / kBand;
    const int64_t margin = kReach * channels, stride = row_values + 2 * margin;  // of the derivatives
    derivative_buffer.reserve(static_cast<size_t>(3 * stride * height));
    const auto derivative = [&](int map, int row) {
        return derivative_buffer.data() + (static_cast<int64_t>(map) * height + row) * stride + margin;
    };
    std::vector<Sums> parts(bands);

    pool().run(bands, [&](int64_t index) {
        const int begin = static_cast<int>(index) * kBand, end = std::min(begin + kBand, height);
        Blur blur(4, row_values, channels);
        TargetRows target_rows(target, row_values);
        std::vector<float> ssim(row_values), squares(stride, 0.0f);
        for (int next = begin - kReach; next < end + kReach; next++) {
            if (next < 0 || next >= height) {
                blur.put_zeros(next);
            } else {
                const float* x = image + next * row_values;
                float* padded = blur.padded_row();
                target_rows.copy(next, padded);
                blur.put_row(1, next);
                combine(x, values, padded, squares.data() + margin);
                blur.put_row(2, next, squares.data() + margin);
                blur.put_row(3, next);
                std::memcpy(padded, x, sizeof(float) * row_values);
                blur.put_row(0, next);
            }
            const int row = next - kReach;
            if (row < begin) continue;
            float* derivatives[3];
            for (int map = 0; map < 3; map++) {
                derivatives[map] = derivative(map, row);
                std::fill_n(derivatives[map] - margin, margin, 0.0f);
                std::fill_n(derivatives[map] + row_values, margin, 0.0f);
            }
            ssim_row(blur.at(row), values, ssim.data(), derivatives[0], derivatives[1], derivatives[2]);
            add_row(ssim.data(), image + row * row_values, target_rows.at(row), values, parts[index]);
        }
    });
    Sums sums;
    for (const Sums& part : parts) {
        sums.ssim += part.ssim;
        sums.absolute += part.absolute;
        sums.squared += part.squared;
    }

    if (gradient) {
        pool().run(bands, [&](int64_t index) {
            const int begin = static_cast<int>(index) * kBand, end = std::min(begin + kBand, height);
            Blur blur(3, row_values, channels);
            TargetRows target_rows(target, row_values);
            for (int next = begin - kReach; next < end + kReach; next++) {
                if (next < 0 || next >= height) {
                    blur.put_zeros(next);
                } else {
                    for (int map = 0; map < 3; map++) blur.put_row(map, next, derivative(map, next));
                }
                const int row = next - kReach;
                if (row < begin) continue;
                const int64_t at = row * row_values;
                gradient_row(image + at, target_rows.at(row), blur.at(row), values,
                             static_cast<float>((1.0 - weight) / total), static_cast<float>(weight / total), gradient + at);
            }
        });
    }
    return {(1.0 - weight) * sums.absolute / total + weight * (1.0 - sums.ssim / total), sums.squared / total};
}

}  // namespace holoreel
