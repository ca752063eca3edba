// SPDX-License-Identifier: GPL-3.0-or-later
// What a width's translation unit offers for tables: Adam with the losses between neighbors, and noise.
#pragma once

#include "api.hpp"

namespace holoreel {
namespace videorf {

struct TableKernels {
    // Brings the moments of rows first ... last - 1 up to date. It reads the rows' neighbors: no row may move before all are
    // done.
    void (*moments)(const VideorfStep&, int64_t first, int64_t last);
    // Moves rows first ... last - 1.
    void (*move)(const VideorfStep&, int64_t first, int64_t last);
    void (*noise)(const float* rows, const float* step, int32_t channels, uint32_t key, int64_t first, int64_t last,
                  float* out);
};

const TableKernels* wide_tables(int channels);  // null where the processor family has no wider vectors
const TableKernels* narrow_tables(int channels);

}  // namespace videorf
}  // namespace holoreel
