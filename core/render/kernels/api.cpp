// SPDX-License-Identifier: GPL-3.0-or-later
// The plain C API of the kernels; Python loads it with ctypes.
extern "C" __attribute__((visibility("default"))) int holoreel_kernels_abi() { return 1; }
