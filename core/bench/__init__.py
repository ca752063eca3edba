# SPDX-License-Identifier: GPL-3.0-or-later
"""What `holoreel bench` measures: one module per subject. Run on demand, never by the tests."""
