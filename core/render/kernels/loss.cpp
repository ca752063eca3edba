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

constexpr int kReach = 5, kTaps = 2 * kReach + 1, kBand = 32;  // rows per task
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
HOLOREEL_CLONES void blur_line(const float* in, int step, int count, const float* taps, float* __restrict out) {
    const float t0 = taps[0], t1 = taps[1], t2 = taps[2], t3 = taps[3], t4 = taps[4], t5 = taps[5];
    const float *l1 = in - step, *l2 = l1 - step, *l3 = l2 - step, *l4 = l3 - step, *l5 = l4 - step;
    const float *r1 = in + step, *r2 = r1 + step, *r3 = r2 + step, *r4 = r3 + step, *r5 = r4 + step;
    for (int i = 0; i < count; i++)
        out[i] = t0 * in[i] + t1 * (l1[i] + r1[i]) + t2 * (l2[i] + r2[i]) + t3 * (l3[i] + r3[i]) +
                 t4 * (l4[i] + r4[i]) + t5 * (l5[i] + r5[i]);
}

// out[i] = sum over k of taps[|k|] rows[kReach + k][i].
HOLOREEL_CLONES void blur_column(const float* const* rows, int count, const float* taps, float* __restrict out) {
    const float *r0 = rows[0], *r1 = rows[1], *r2 = rows[2], *r3 = rows[3], *r4 = rows[4], *r5 = rows[5];
    const float *r6 = rows[6], *r7 = rows[7], *r8 = rows[8], *r9 = rows[9], *r10 = rows[10];
    const float t0 = taps[0], t1 = taps[1], t2 = taps[2], t3 = taps[3], t4 = taps[4], t5 = taps[5];
    for (int i = 0; i < count; i++)
        out[i] = t0 * r5[i] + t1 * (r4[i] + r6[i]) + t2 * (r3[i] + r7[i]) + t3 * (r2[i] + r8[i]) +
                 t4 * (r1[i] + r9[i]) + t5 * (r0[i] + r10[i]);
}

HOLOREEL_CLONES void multiply(const float* a, const float* b, int count, float* __restrict out) {
    for (int i = 0; i < count; i++) out[i] = a[i] * b[i];
}

// SSIM of one row from its blurred x, y, x², y², x y; and dSSIM/d(blurred x), /d(blurred x²), /d(blurred x y).
HOLOREEL_CLONES void ssim_row(const float* const* m, int count, float* __restrict ssim, float* __restrict d_x,
                              float* __restrict d_xx, float* __restrict d_xy) {
    const float *mx = m[0], *my = m[1], *mxx = m[2], *myy = m[3], *mxy = m[4];
    for (int i = 0; i < count; i++) {
        const float x = mx[i], y = my[i];
        const float a1 = 2 * x * y + kC1, a2 = 2 * (mxy[i] - x * y) + kC2;
        const float b1 = x * x + y * y + kC1, b2 = (mxx[i] - x * x) + (myy[i] - y * y) + kC2;
        const float inverse = 1.0f / (b1 * b2), s = a1 * a2 * inverse;
        ssim[i] = s;
        d_x[i] = 2 * (y * (a2 - a1) * inverse + x * s * (b1 - b2) * inverse);
        d_xx[i] = -s * b1 * inverse;
        d_xy[i] = 2 * a1 * inverse;
    }
}

HOLOREEL_CLONES void gradient_row(const float* x, const float* y, const float* const* d, int count, float l1_share,
                                  float ssim_share, float* __restrict out) {
    const float *d_x = d[0], *d_xx = d[1], *d_xy = d[2];
    for (int i = 0; i < count; i++) {
        const float difference = x[i] - y[i];
        const float sign = static_cast<float>(difference > 0.0f) - static_cast<float>(difference < 0.0f);
        out[i] = l1_share * sign - ssim_share * (d_x[i] + 2 * x[i] * d_xx[i] + y[i] * d_xy[i]);
    }
}

double sum_of(const float* values, int count) {
    double parts[4] = {};
    int i = 0;
    for (; i + 4 <= count; i += 4)
        for (int k = 0; k < 4; k++) parts[k] += values[i + k];
    for (; i < count; i++) parts[0] += values[i];
    return (parts[0] + parts[1]) + (parts[2] + parts[3]);
}

double absolute_difference(const float* x, const float* y, int count) {
    double parts[4] = {};
    int i = 0;
    for (; i + 4 <= count; i += 4)
        for (int k = 0; k < 4; k++) parts[k] += std::fabs(static_cast<double>(x[i + k]) - y[i + k]);
    for (; i < count; i++) parts[0] += std::fabs(static_cast<double>(x[i]) - y[i]);
    return (parts[0] + parts[1]) + (parts[2] + parts[3]);
}

// A band of rows being blurred: `maps` maps, each with kReach rows above and below the band, blurred along the rows.
class Band {
public:
    Band(int maps, int64_t row_values, int channels)
        : maps_(maps),
          values_(row_values),
          margin_(kReach * channels),
          lines_(static_cast<size_t>(maps) * (kBand + 2 * kReach) * row_values),
          padded_(row_values + 2 * margin_, 0.0f),
          result_(static_cast<size_t>(maps) * row_values) {}

    // Room to write a row before blurring it; zeros lie on both sides.
    float* padded_row() { return padded_.data() + margin_; }

    void blur_row(int map, int line, int channels, const Window& window) {
        blur_line(padded_row(), channels, static_cast<int>(values_), window.taps, line_at(map, line));
    }
    void clear_row(int map, int line) { std::fill_n(line_at(map, line), values_, 0.0f); }

    // The maps blurred both ways at row `row` of the band.
    const float* const* blurred(int row, const Window& window) {
        for (int map = 0; map < maps_; map++) {
            const float* rows[kTaps];
            for (int k = 0; k < kTaps; k++) rows[k] = line_at(map, row + k);
            float* out = result_.data() + map * values_;
            blur_column(rows, static_cast<int>(values_), window.taps, out);
            pointers_[map] = out;
        }
        return pointers_;
    }

private:
    float* line_at(int map, int line) { return lines_.data() + (static_cast<int64_t>(map) * (kBand + 2 * kReach) + line) * values_; }

    int maps_;
    int64_t values_, margin_;
    std::vector<float> lines_, padded_, result_;
    const float* pointers_[5] = {};
};

}  // namespace

double l1_dssim(const float* image, const float* target, int height, int width, int channels, double weight,
                float* gradient) {
    static const Window window;
    static Buffer<float> derivative_buffer;  // calls are serialized
    const int64_t row_values = static_cast<int64_t>(width) * channels, total = row_values * height;
    const int values = static_cast<int>(row_values);
    const int64_t bands = (height + kBand - 1) / kBand;
    derivative_buffer.reserve(static_cast<size_t>(3 * total));
    float* derivatives[3];
    for (int k = 0; k < 3; k++) derivatives[k] = derivative_buffer.data() + k * total;
    std::vector<double> ssim_sums(bands), l1_sums(bands);

    pool().run(bands, [&](int64_t index) {
        const int begin = static_cast<int>(index) * kBand, end = std::min(begin + kBand, height);
        Band band(5, row_values, channels);
        std::vector<float> ssim(row_values);
        for (int row = begin - kReach; row < end + kReach; row++) {
            const int line = row - begin + kReach;
            const bool inside = row >= 0 && row < height;
            const float *x = image + row * row_values, *y = target + row * row_values;
            const float* factors[5][2] = {{x, nullptr}, {y, nullptr}, {x, x}, {y, y}, {x, y}};
            for (int map = 0; map < 5; map++) {
                if (!inside) {
                    band.clear_row(map, line);
                    continue;
                }
                if (factors[map][1])
                    multiply(factors[map][0], factors[map][1], values, band.padded_row());
                else
                    std::memcpy(band.padded_row(), factors[map][0], sizeof(float) * row_values);
                band.blur_row(map, line, channels, window);
            }
        }
        for (int row = begin; row < end; row++) {
            const int64_t at = row * row_values;
            ssim_row(band.blurred(row - begin, window), values, ssim.data(), derivatives[0] + at, derivatives[1] + at,
                     derivatives[2] + at);
            ssim_sums[index] += sum_of(ssim.data(), values);
            l1_sums[index] += absolute_difference(image + at, target + at, values);
        }
    });
    double ssim_sum = 0.0, l1_sum = 0.0;
    for (int64_t band = 0; band < bands; band++) ssim_sum += ssim_sums[band], l1_sum += l1_sums[band];

    if (gradient) {
        pool().run(bands, [&](int64_t index) {
            const int begin = static_cast<int>(index) * kBand, end = std::min(begin + kBand, height);
            Band band(3, row_values, channels);
            for (int row = begin - kReach; row < end + kReach; row++)
                for (int map = 0; map < 3; map++) {
                    const int line = row - begin + kReach;
                    if (row < 0 || row >= height) {
                        band.clear_row(map, line);
                        continue;
                    }
                    std::memcpy(band.padded_row(), derivatives[map] + row * row_values, sizeof(float) * row_values);
                    band.blur_row(map, line, channels, window);
                }
            for (int row = begin; row < end; row++) {
                const int64_t at = row * row_values;
                gradient_row(image + at, target + at, band.blurred(row - begin, window), values,
                             static_cast<float>((1.0 - weight) / total), static_cast<float>(weight / total), gradient + at);
            }
        });
    }
    return (1.0 - weight) * l1_sum / total + weight * (1.0 - ssim_sum / total);
}

}  // namespace holoreel
