// SPDX-License-Identifier: GPL-3.0-or-later
// From Gaussians to lists per tile: project, sort the visible ones by depth, scatter them in that order.
// Every step gives the same result for any number of threads.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <stdexcept>

#include "frame.hpp"
#include "projection.hpp"
#include "thread_pool.hpp"
#include "vectorize.hpp"

namespace holoreel {

namespace {

constexpr double kLog2E = 1.4426950408889634;

// The bfloat16 at or above `x` (x >= 0), in the upper half of the word.
uint32_t bfloat_up(double x) {
    const float f = static_cast<float>(x < 3e38 ? x : 3e38);
    uint32_t bits;
    std::memcpy(&bits, &f, 4);
    return (bits + 0xffffu) & 0xffff0000u;
}

// The pixels whose centers lie in [low, high], as a half-open range of tiles, within [0, tiles).
void tile_range(double low, double high, int pixels, int& begin, int& end) {
    const double first = std::max(std::ceil(low - 0.5), 0.0), last = std::min(std::floor(high - 0.5), pixels - 1.0);
    if (!(first <= last)) {
        begin = end = 0;
        return;
    }
    begin = static_cast<int>(first) / kTile;
    end = static_cast<int>(last) / kTile + 1;
}

// The ellipse |W d|² <= reach, and how far it extends in a band of rows.
class Ellipse {
public:
    Ellipse(const Splat& splat, double reach)
        : s_(splat),
          reach_(reach),
          width_(1.0 / splat.w11),
          // A hair larger than exact: pixels are chosen by their alpha, never by these bounds.
          radius_x_(std::sqrt(std::max(reach, 0.0) * splat.cov_xx) * (1 + 1e-6) + 1e-3),
          radius_y_(std::sqrt(std::max(reach, 0.0) * splat.cov_yy) * (1 + 1e-6) + 1e-3),
          dy_at_max_x_(radius_x_ * splat.cov_xy / splat.cov_xx) {}

    double radius_x() const { return radius_x_; }
    double radius_y() const { return radius_y_; }

    void extent(double y_low, double y_high, double& x_low, double& x_high) const {
        const double low = std::max(y_low - s_.y, -radius_y_), high = std::min(y_high - s_.y, radius_y_);
        double left_a, right_a, left_b, right_b;
        cut(low, left_a, right_a);
        cut(high, left_b, right_b);
        const double right = low <= dy_at_max_x_ && dy_at_max_x_ <= high ? radius_x_ : std::max(right_a, right_b);
        const double left = low <= -dy_at_max_x_ && -dy_at_max_x_ <= high ? -radius_x_ : std::min(left_a, left_b);
        x_low = s_.x + left - 1e-3;
        x_high = s_.x + right + 1e-3;
    }

private:
    void cut(double dy, double& left, double& right) const {
        const double v = s_.w22 * dy;
        const double half = std::sqrt(std::max(0.0, reach_ - v * v)) * width_, middle = -s_.w12 * width_ * dy;
        left = middle - half;
        right = middle + half;
    }

    const Splat& s_;
    double reach_, width_, radius_x_, radius_y_, dy_at_max_x_;
};

// Fills the footprint; its rows beyond the inline ones go to `overflow`.
void lay_out(const Splat& splat, const Ellipse& ellipse, const Frame& frame, Footprint& f,
             std::vector<uint32_t>& overflow) {
    f.tiles = 0;
    int row_begin, row_end, column_begin, column_end;
    tile_range(splat.y - ellipse.radius_y(), splat.y + ellipse.radius_y(), frame.height, row_begin, row_end);
    tile_range(splat.x - ellipse.radius_x(), splat.x + ellipse.radius_x(), frame.width, column_begin, column_end);
    if (row_begin == row_end || column_begin == column_end) return;
    f.row = static_cast<uint16_t>(row_begin);
    f.rows = static_cast<uint16_t>(row_end - row_begin);
    uint32_t* columns = f.columns;
    if (f.rows > Footprint::kInline) {
        f.overflow = static_cast<uint32_t>(overflow.size());
        overflow.resize(overflow.size() + f.rows);
        columns = overflow.data() + f.overflow;
    }
    const bool small = row_end - row_begin < 2 || column_end - column_begin < 2;
    for (int row = row_begin; row < row_end; row++) {
        int begin = column_begin, end = column_end;
        if (!small) {
            double x_low, x_high;
            ellipse.extent(row * kTile + 0.5, row * kTile + kTile - 0.5, x_low, x_high);
            tile_range(x_low, x_high, frame.width, begin, end);
        }
        columns[row - row_begin] = static_cast<uint32_t>(begin) | static_cast<uint32_t>(end) << 16;
        f.tiles += static_cast<uint32_t>(end - begin);
    }
}

void write_record(const HoloreelGaussians& g, int64_t row, double log_opacity, const Splat& splat,
                  const Ellipse& ellipse, const Frame& frame, float* target) {
    Record& record = *reinterpret_cast<Record*>(target);
    constexpr double scale = 0.84932180028801907;  // sqrt(log2(e) / 2): exp(-|w|²/2) = 2^-(|scale w|²)
    record.x = splat.x;
    record.y = splat.y;
    record.w11 = splat.w11 * scale;
    record.w12 = splat.w12 * scale;
    record.w22 = splat.w22 * scale;
    record.log2_opacity = static_cast<float>(log_opacity * kLog2E);
    record.radii = bfloat_up(ellipse.radius_x()) | bfloat_up(ellipse.radius_y()) >> 16;
    float* channels = record.channels();
    for (int c = 0; c < frame.channels; c++) channels[c] = g.features[row * frame.channels + c];
    for (int c = frame.channels; c < frame.padded_channels; c++) channels[c] = 0.0f;
    channels[frame.padded_channels] = static_cast<float>(splat.depth);
}

uint64_t depth_key(double depth, int64_t i) {
    const float f = static_cast<float>(depth);  // positive, so its bits sort as it does
    uint32_t bits;
    std::memcpy(&bits, &f, 4);
    return static_cast<uint64_t>(bits) << 32 | static_cast<uint64_t>(i);
}

// Evaluates and projects one chunk; writes its keys from its first index on. Returns how many are seen, and their tiles.
HOLOREEL_HEAVY_CLONES void project_chunk(const HoloreelGaussians& g, const View& view, const HoloreelRules& rules,
                                         int64_t chunk, Frame& frame, uint64_t* keys, int64_t& visible, int64_t& slots) {
    const int stride = record_stride(frame.padded_channels);
    const double log_alpha_min = std::log(rules.alpha_min);
    auto& overflow = frame.overflow[chunk];
    overflow.clear();
    const int64_t begin = chunk * kChunk, end = std::min(begin + kChunk, frame.count);
    visible = slots = 0;
    if (g.rows && std::any_of(g.rows + begin, g.rows + end, [&](uint32_t row) { return row >= g.count; }))
        throw std::out_of_range("a listed row is not there");
    uint32_t places[kChunk], alive[kChunk];  // in the frame, and in the arrays
    int64_t count = 0;
    const bool cull = g.spacetime && rules.cull_faded;
    const double fade_limit = -log_alpha_min + 1e-6;
    for (int64_t first = begin; first < end; first += kRows) {
        const RowSet rows = g.rows ? RowSet(g.rows + first, end - first) : RowSet(first, end);
        const Mask seen = cull ? may_be_seen(g, rows, fade_limit) : ~Mask{};
        for (int lane = 0; lane < rows.count; lane++) {
            frame.footprints[first + lane].tiles = 0;
            places[count] = static_cast<uint32_t>(first + lane);
            alive[count] = static_cast<uint32_t>(rows.rows[lane]);
            count += seen[lane] & 1;
        }
    }
    for (int64_t k = 0; k < count; k += kRows) {
        const RowSet rows(alive + k, count - k);
        Instant instant;
        Splats splats;
        Mask seen = evaluate(g, rows, rules, instant);
        if (!any(seen)) continue;
        seen &= project(instant, view, rules, splats);
        for (int lane = 0; lane < rows.count; lane++) {
            if (!seen[lane]) continue;
            const int64_t i = places[k + lane];
            Footprint& footprint = frame.footprints[i];
            const Splat splat = splat_at(splats, lane);
            const double log_opacity = std::log(instant.opacity[lane]);
            // What no pixel can show is here only where it was asked for, and then within three sigma.
            const double reach = log_opacity < log_alpha_min ? 9.0 : 2.0 * (log_opacity - log_alpha_min);
            const Ellipse ellipse(splat, reach);
            lay_out(splat, ellipse, frame, footprint, overflow);
            if (footprint.tiles == 0) continue;
            write_record(g, rows.rows[lane], log_opacity, splat, ellipse, frame, frame.records.data() + i * stride);
            keys[begin + visible++] = depth_key(splat.depth, i);
            slots += footprint.tiles;
        }
    }
}

}  // namespace

void project_all(const HoloreelGaussians& g, const HoloreelCamera& camera, const HoloreelRules& rules, Frame& frame,
                 Scratch& scratch) {
    const View view(camera, rules);
    const int64_t chunks = frame.chunks();
    frame.records.reserve(static_cast<size_t>(frame.count) * record_stride(frame.padded_channels));
    frame.footprints.reserve(frame.count);
    frame.overflow.resize(chunks);
    scratch.keys.reserve(frame.count);
    scratch.keys_swap.reserve(frame.count);
    scratch.chunk_visible.assign(chunks + 1, 0);
    scratch.chunk_slots.assign(chunks + 1, 0);
    pool().run(chunks, [&](int64_t chunk) {
        project_chunk(g, view, rules, chunk, frame, scratch.keys_swap.data(), scratch.chunk_visible[chunk + 1],
                      scratch.chunk_slots[chunk + 1]);
    });
    for (int64_t c = 0; c < chunks; c++) {
        scratch.chunk_visible[c + 1] += scratch.chunk_visible[c];
        scratch.chunk_slots[c + 1] += scratch.chunk_slots[c];
    }
    frame.visible = scratch.chunk_visible[chunks];
    frame.intersections = scratch.chunk_slots[chunks];
    if (frame.intersections > INT32_MAX)
        throw std::length_error("more than 2^31 pairs of a Gaussian and a tile; lower the resolution or prune large Gaussians");
    pool().run(chunks, [&](int64_t chunk) {
        const int64_t base = chunk * kChunk, to = scratch.chunk_visible[chunk];
        uint32_t slot = static_cast<uint32_t>(scratch.chunk_slots[chunk]);
        for (int64_t k = 0, n = scratch.chunk_visible[chunk + 1] - to; k < n; k++) {
            const uint64_t key = scratch.keys_swap[base + k];
            Footprint& footprint = frame.footprints[key & 0xffffffffu];
            footprint.slot = slot;
            slot += footprint.tiles;
            scratch.keys[to + k] = key;
        }
    });
}

void sort_by_depth(Frame& frame, Scratch& scratch) {
    // Stable radix sort of the depth's 32 bits, 11 at a time; equal depths stay in the order of their indices.
    constexpr int kBits = 11, kBins = 1 << kBits;
    const int64_t count = frame.visible, blocks = std::clamp<int64_t>(count / 8192, 1, pool().threads());
    scratch.histogram.reserve(static_cast<size_t>(blocks) * kBins);
    for (int pass = 0; pass < 3; pass++) {
        const int shift = 32 + kBits * pass;
        const uint64_t* from = (pass & 1 ? scratch.keys_swap : scratch.keys).data();
        uint64_t* to = (pass & 1 ? scratch.keys : scratch.keys_swap).data();
        uint32_t* histogram = scratch.histogram.data();
        pool().run(blocks, [&](int64_t block) {
            uint32_t* bins = histogram + block * kBins;
            std::memset(bins, 0, kBins * sizeof(uint32_t));
            for (int64_t k = count * block / blocks, end = count * (block + 1) / blocks; k < end; k++)
                bins[from[k] >> shift & (kBins - 1)]++;
        });
        uint32_t sum = 0;
        for (int bin = 0; bin < kBins; bin++)
            for (int64_t block = 0; block < blocks; block++) {
                uint32_t& cell = histogram[block * kBins + bin];
                const uint32_t n = cell;
                cell = sum;
                sum += n;
            }
        pool().run(blocks, [&](int64_t block) {
            uint32_t* bins = histogram + block * kBins;
            for (int64_t k = count * block / blocks, end = count * (block + 1) / blocks; k < end; k++)
                to[bins[from[k] >> shift & (kBins - 1)]++] = from[k];
        });
    }
    // Three passes: the result lies in keys_swap.
}

void bin_to_tiles(Frame& frame, Scratch& scratch) {
    const int64_t count = frame.visible, tiles = frame.tiles();
    const int64_t blocks = std::clamp<int64_t>(count / 4096, 1, pool().threads());
    const uint64_t* keys = scratch.keys_swap.data();
    scratch.tile_histogram.assign(static_cast<size_t>(blocks) * tiles, 0);
    frame.tile_begin.reserve(tiles + 1);
    frame.entries.reserve(std::max<int64_t>(frame.intersections, 1));

    // Calls visit(tile, place among the Gaussian's tiles, index) for each pair, block by block in order of depth.
    const auto each_pair = [&](int64_t block, auto&& visit) {
        const int64_t end = count * (block + 1) / blocks;
        for (int64_t k = count * block / blocks; k < end; k++) {
            __builtin_prefetch(&frame.footprints[keys[std::min(k + 12, end - 1)] & 0xffffffffu]);
            const uint32_t i = keys[k] & 0xffffffffu;
            const Footprint& footprint = frame.footprints[i];
            const uint32_t* columns = frame.columns(i);
            uint32_t slot = footprint.slot;
            for (int row = 0; row < footprint.rows; row++) {
                const int64_t tile = static_cast<int64_t>(footprint.row + row) * frame.tiles_x;
                for (uint32_t x = columns[row] & 0xffff, x_end = columns[row] >> 16; x < x_end; x++)
                    visit(tile + x, slot++, i);
            }
        }
    };
    pool().run(blocks, [&](int64_t block) {
        uint32_t* histogram = scratch.tile_histogram.data() + block * tiles;
        each_pair(block, [&](int64_t tile, uint32_t, uint32_t) { histogram[tile]++; });
    });
    uint32_t sum = 0;
    for (int64_t tile = 0; tile < tiles; tile++) {
        frame.tile_begin[tile] = sum;
        for (int64_t block = 0; block < blocks; block++) {
            uint32_t& cell = scratch.tile_histogram[block * tiles + tile];
            const uint32_t n = cell;
            cell = sum;
            sum += n;
        }
    }
    frame.tile_begin[tiles] = sum;
    pool().run(blocks, [&](int64_t block) {
        uint32_t* next = scratch.tile_histogram.data() + block * tiles;
        each_pair(block, [&](int64_t tile, uint32_t slot, uint32_t i) { frame.entries[next[tile]++] = {i, slot}; });
    });
}

}  // namespace holoreel
