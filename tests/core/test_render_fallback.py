# SPDX-License-Identifier: GPL-3.0-or-later
"""Choosing a backend, with and without the compiled kernels."""

import subprocess
import sys
import warnings

import pytest
import torch
from holoreel.core import render
from holoreel.core.errors import HoloreelError
from holoreel.core.render import cuda, native


@pytest.fixture
def no_kernels(monkeypatch, tmp_path):
    """A Holoreel in which nothing was compiled."""
    native.load_kernels.cache_clear()
    monkeypatch.setattr(native, "library_folders", lambda: [tmp_path])
    monkeypatch.setattr(render, "_warned", False)
    yield tmp_path
    native.load_kernels.cache_clear()


def test_kernels_are_taken_where_they_are():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert render.get_backend().__name__ == "holoreel.core.render.cpu"
    assert render.get_backend("reference").__name__ == "holoreel.core.render.reference"


def test_without_kernels_the_reference_runs_and_says_so_once(no_kernels):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        backends = [render.get_backend() for _ in range(3)]
    assert {backend.__name__ for backend in backends} == {"holoreel.core.render.reference"}
    assert len(caught) == 1
    assert "pip install" in str(caught[0].message)


def test_without_kernels_cpu_is_refused_with_a_remedy(no_kernels):
    with pytest.raises(HoloreelError, match="pip install"):
        render.get_backend("cpu")


def test_a_broken_library_is_named(no_kernels):
    (no_kernels / "holoreel_kernels.so").write_bytes(b"not a library")
    with pytest.raises(HoloreelError, match=r"holoreel_kernels\.so cannot be loaded"):
        render.get_backend("cpu")


def test_a_library_of_another_version_is_named(monkeypatch):
    native.load_kernels.cache_clear()
    monkeypatch.setattr(native, "ABI", -1)
    with pytest.raises(HoloreelError, match="of another version"):
        native.load_kernels()
    monkeypatch.undo()
    native.load_kernels.cache_clear()


@pytest.mark.parametrize(("text", "threads"), [("1", 1), ("3", 3), ("", None), ("none", "refused"), ("0", "refused")])
def test_number_of_threads(monkeypatch, text, threads):
    native.load_kernels.cache_clear()
    monkeypatch.setenv("HOLOREEL_THREADS", text)
    if threads == "refused":
        with pytest.raises(HoloreelError, match="HOLOREEL_THREADS"):
            native.load_kernels()
    else:
        assert native.load_kernels().holoreel_get_threads() == (threads or native.available_cores())
    native.load_kernels.cache_clear()


def test_unknown_backend():
    with pytest.raises(ValueError, match="no rasterizer backend"):
        render.get_backend("opengl")


def test_without_a_gpu_cuda_is_refused_with_a_remedy(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(HoloreelError, match=r"no NVIDIA GPU.*pip install"):
        render.get_backend("cuda")


def test_without_gsplat_cuda_is_refused_with_a_remedy(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", None)
    with pytest.raises(HoloreelError, match=r"gsplat.*pip install"):
        render.get_backend("cuda")


def test_auto_takes_the_gpu_where_it_can_and_warns_where_it_cannot(monkeypatch):
    monkeypatch.setattr(render, "_warned", False)
    monkeypatch.setattr(render, "_gpu_is_wanted", lambda: True)
    monkeypatch.setattr(cuda, "load_kernels", lambda: None)
    assert render.get_backend() is cuda
    monkeypatch.undo()
    monkeypatch.setattr(render, "_warned", False)
    monkeypatch.setattr(render, "_gpu_is_wanted", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.warns(UserWarning, match="Until then the CPU is used"):
        assert render.get_backend().__name__ == "holoreel.core.render.cpu"


def test_importing_the_package_does_not_import_torch():
    code = "import sys, holoreel.core.render, holoreel.core.render.native; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
