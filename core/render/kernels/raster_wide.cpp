// SPDX-License-Identifier: GPL-3.0-or-later
// Eight lanes. This file alone is compiled with AVX2 and FMA; elsewhere than on x86 it is empty.
#include "raster.hpp"

#if defined(__AVX2__) && defined(__FMA__)

#define HOLOREEL_LANES 8
#define HOLOREEL_NAMESPACE wide
#include "raster_kernels.hpp"

namespace holoreel {

const RasterKernels* wide_kernels() { return &wide::kernels; }

}  // namespace holoreel

#else

namespace holoreel {

const RasterKernels* wide_kernels() { return nullptr; }

}  // namespace holoreel

#endif
