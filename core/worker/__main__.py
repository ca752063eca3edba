# SPDX-License-Identifier: GPL-3.0-or-later
"""`python -m holoreel.core.worker` is the worker; see `protocol`."""

import os

from .server import serve

serve()
os._exit(0)  # the thread that listens would keep the process
