# SPDX-License-Identifier: GPL-3.0-or-later
"""How operators say what went wrong, and why they cannot run now."""

import bpy

from ..addon.preferences import core_python
from ..core.errors import HoloreelError


class Reporting:
    """An operator whose deed is `run`: a `HoloreelError` is reported, and then nothing was done."""

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Do it, or say in one sentence why not."""
        try:
            self.run(context)
        except HoloreelError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class NeedsCore(Reporting):
    """An operator that needs the core environment."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only where there is one."""
        try:
            core_python()
        except HoloreelError as error:
            cls.poll_message_set(str(error))
            return False
        return True
