# SPDX-License-Identifier: GPL-3.0-or-later
"""`python -m holoreel.core` is the `holoreel` command."""

import sys

from .cli import main

sys.exit(main())
