# SPDX-License-Identifier: GPL-3.0-or-later
"""The one error that people see."""


class HoloreelError(Exception):
    """Something the user can mend: one sentence that names the file, the field and the remedy.

    The command line prints it and exits with status 2; an operator reports it and returns `{'CANCELLED'}`.
    """
