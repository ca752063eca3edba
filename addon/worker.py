# SPDX-License-Identifier: GPL-3.0-or-later
"""The one worker of this Blender: started when a picture is first asked for, ended with the add-on or with Blender."""

from pathlib import Path

from ..core.worker.client import Client
from . import preferences

LOG = "worker.log"

_client: Client | None = None
_settings: tuple[Path, str, int] | None = None


def worker() -> Client:
    """Return the client of the core environment that the preferences name now.

    Raises `HoloreelError` where there is none. A worker that runs with other preferences is ended.
    """
    global _client, _settings
    wanted = (preferences.core_python(), preferences.device(), preferences.cache_mb())
    if _client is None or _settings != wanted:
        close()
        python, backend, cache = wanted
        _client = Client(python, log=preferences.log_folder() / LOG, backend=backend, cache_mb=cache)
        _settings = wanted
    return _client


def running() -> int | None:
    """Return the process number of the worker, None where none runs."""
    return None if _client is None else _client.pid


def close() -> None:
    """End the worker, if there is one; the next picture starts another."""
    global _client, _settings
    client, _client, _settings = _client, None, None
    if client is not None:
        client.close()


def register() -> None:
    """Nothing is started before it is needed."""


def unregister() -> None:
    """End the worker."""
    close()
