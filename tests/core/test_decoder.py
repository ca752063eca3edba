# SPDX-License-Identifier: GPL-3.0-or-later
"""The decoder of full models: its formula, its files read by others' libraries, and files that are wrong."""

import io
import json
import pickle
import struct
import zipfile
from collections import OrderedDict
from contextlib import suppress

import numpy as np
import pytest
import safetensors
import torch
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.decoder import Decoder, decoder_path, read_decoder, read_pt, write_decoder, write_pt


@pytest.fixture
def decoder():
    """Weights that encode their place: hidden (100 row + column) / 64, output -(100 row + column) / 64."""
    hidden = (100 * np.arange(6)[:, None] + np.arange(12)) / 64
    output = -(100 * np.arange(3)[:, None] + np.arange(6)) / 64
    return Decoder(hidden, output, "clamp")


@pytest.mark.parametrize("activation", ["sigmoid", "clamp", "none"])
def test_the_formula(activation):
    random = np.random.default_rng(1)
    hidden, output = random.normal(size=(6, 12)), random.normal(size=(3, 6))
    decoder = Decoder(hidden, output, activation)
    features, origin, direction = random.normal(size=(2, 4, 9)), random.normal(size=3), random.normal(size=(2, 4, 3))
    colors = decoder.decode(features, origin, direction)
    assert colors.dtype == np.float64
    for place in np.ndindex(2, 4):
        x = [*features[place][3:], *origin, *direction[place]]
        units = [max(0.0, sum(float(np.float32(w)) * v for w, v in zip(row, x, strict=True))) for row in hidden]
        for c in range(3):
            raw = features[place][c] + sum(float(np.float32(w)) * u for w, u in zip(output[c], units, strict=True))
            color = {"sigmoid": 1 / (1 + np.exp(-raw)), "clamp": min(max(raw, 0.0), 1.0), "none": raw}[activation]
            assert colors[place][c] == pytest.approx(color, abs=1e-12)


def test_our_file_is_what_the_library_reads(tmp_path, decoder):
    path = decoder_path(tmp_path / "walk.000.ply")
    assert path.name == "walk.000.decoder.safetensors"
    write_decoder(path, decoder)
    with safetensors.safe_open(path, "np") as file:
        assert file.metadata() == {"activation": "clamp"}
        assert sorted(file.keys()) == ["hidden", "output"]
        np.testing.assert_array_equal(file.get_tensor("hidden"), decoder.hidden)
        np.testing.assert_array_equal(file.get_tensor("output"), decoder.output)


def test_the_librarys_file_is_read(tmp_path, decoder):
    from safetensors.numpy import save_file

    save_file({"output": decoder.output, "hidden": decoder.hidden}, tmp_path / "a.safetensors", {"activation": "none"})
    read = read_decoder(tmp_path / "a.safetensors")
    np.testing.assert_array_equal(read.hidden, decoder.hidden)
    np.testing.assert_array_equal(read.output, decoder.output)
    assert read.activation == "none"


class Network(torch.nn.Module):
    """The authors' network, as far as its state dict shows it."""

    def __init__(self):
        super().__init__()
        self.mlp1 = torch.nn.Conv2d(12, 6, kernel_size=1, bias=False)
        self.mlp2 = torch.nn.Conv2d(6, 3, kernel_size=1, bias=False)


def test_the_authors_file_both_ways(tmp_path, decoder):
    network = Network()
    torch.save(network.state_dict(), tmp_path / "a.pt")
    read = read_pt(tmp_path / "a.pt", "none")
    x = torch.rand(1, 12, 4, 5)
    with torch.no_grad():
        truth = network.mlp2(torch.relu(network.mlp1(x)))[0].permute(1, 2, 0).numpy()
    parts = x[0].permute(1, 2, 0).numpy()
    features = np.concatenate([np.zeros((4, 5, 3)), parts[..., :6]], axis=2)
    np.testing.assert_allclose(read.decode(features, parts[..., 6:9], parts[..., 9:]), truth, atol=1e-6)
    write_pt(tmp_path / "b.pt", decoder)
    network.load_state_dict(torch.load(tmp_path / "b.pt", weights_only=True))
    np.testing.assert_array_equal(network.mlp1.weight.detach().numpy()[:, :, 0, 0], decoder.hidden)
    np.testing.assert_array_equal(network.mlp2.weight.detach().numpy()[:, :, 0, 0], decoder.output)


def refuse(read, path) -> str:
    with pytest.raises(HoloreelError) as caught:
        read(path)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)
    return str(caught.value)


class Bomb:
    """Something that runs a function when it is unpickled."""

    def __reduce__(self):
        return exec, ("raise SystemExit('unpickled')",)


GOOD = {"mlp1.weight": torch.zeros(6, 12, 1, 1), "mlp2.weight": torch.zeros(3, 6, 1, 1)}


@pytest.mark.parametrize(
    "content",
    [
        {}, [], 3, torch.zeros(3), {"mlp1.weight": GOOD["mlp1.weight"]}, GOOD | {"extra": torch.zeros(1)},
        GOOD | {"mlp1.weight": torch.zeros(12, 6, 1, 1)}, GOOD | {"mlp2.weight": torch.zeros(3, 6)},
        GOOD | {"mlp1.weight": torch.zeros(6, 12, 1, 1, dtype=torch.float64)}, GOOD | {"mlp2.weight": "zeros"},
        GOOD | {"mlp1.weight": torch.full((6, 12, 1, 1), torch.nan)}, GOOD | {"mlp2.weight": Bomb()}, Bomb(),
        Network(), OrderedDict(net=GOOD), {"mlp1.weight": torch.zeros(1).expand(6, 12, 1, 1)},
    ],
)  # fmt: skip
def test_a_pt_that_is_no_state_dict_is_refused(tmp_path, content):
    torch.save(content, tmp_path / "a.pt")
    assert "not the state dict of a decoder" in refuse(read_pt, tmp_path / "a.pt")


def test_damaged_pt_files_get_a_sentence(tmp_path, decoder):
    write_pt(tmp_path / "good.pt", decoder)
    data, path = (tmp_path / "good.pt").read_bytes(), tmp_path / "a.pt"
    for length in range(0, len(data), 61):
        path.write_bytes(data[:length])
        refuse(read_pt, path)
    for place in range(0, len(data), 7):
        damaged = bytearray(data)
        damaged[place] ^= 0x15
        path.write_bytes(damaged)
        with suppress(HoloreelError):  # zip files have bytes that nobody reads
            assert read_pt(path).hidden.shape == (6, 12)
    for other in (b"ply\n", pickle.dumps(GOOD["mlp1.weight"].numpy()), bytes(2 << 20)):
        path.write_bytes(other)
        refuse(read_pt, path)
    torch.save(GOOD, path, _use_new_zipfile_serialization=False)
    refuse(read_pt, path)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a/data.pkl", bytes(1 << 28))
    path.write_bytes(packed.getvalue())
    assert "unpacks to more" in refuse(read_pt, path)
    for absent in (tmp_path / "absent.pt", tmp_path):
        refuse(read_pt, absent)


def test_damaged_files_of_ours_get_a_sentence(tmp_path, decoder):
    path = tmp_path / "a.decoder.safetensors"
    write_decoder(path, decoder)
    data = path.read_bytes()
    for length in range(0, len(data) - 1, 13):
        path.write_bytes(data[:length])
        refuse(read_decoder, path)
    for place in range(len(data)):
        damaged = bytearray(data)
        damaged[place] ^= 0x15
        path.write_bytes(damaged)
        with suppress(HoloreelError):  # weights may be anything that is finite
            assert np.isfinite(read_decoder(path).output).all()
    entry = {"dtype": "F32", "shape": [6, 12], "data_offsets": [0, 288]}
    other = {"dtype": "F32", "shape": [3, 6], "data_offsets": [288, 360]}
    good = {"__metadata__": {"activation": "none"}, "hidden": entry, "output": other}

    def write(header: object, size: int = 360) -> None:
        text = json.dumps(header).encode()
        path.write_bytes(struct.pack("<Q", len(text)) + text + bytes(size))

    write(good)
    assert read_decoder(path).activation == "none"
    for header in (
        [], {}, good | {"hidden": 3}, good | {"__metadata__": {}}, good | {"__metadata__": {"activation": ["none"]}},
        good | {"__metadata__": {"activation": "tanh"}}, good | {"output": other | {"dtype": "F64"}},
        good | {"output": other | {"shape": [6, 3]}}, good | {"output": other | {"data_offsets": [288, 10**15]}},
        good | {"output": other | {"data_offsets": [-72, 0]}}, good | {"output": other | {"data_offsets": [0.0, 72.0]}},
        good | {"output": other | {"data_offsets": "ab"}},
    ):  # fmt: skip
        write(header)
        refuse(read_decoder, path)
    path.write_bytes(struct.pack("<Q", 2**63) + data[8:])
    refuse(read_decoder, path)
    path.write_bytes(bytes(2 << 20))
    assert "larger than a decoder" in refuse(read_decoder, path)
    refuse(read_decoder, tmp_path / "absent.decoder.safetensors")


@pytest.mark.parametrize(
    "change",
    [{"hidden": np.zeros((12, 6))}, {"output": np.zeros(18)}, {"output": np.full((3, 6), np.inf)}, {"activation": ""}],
)
def test_impossible_weights_are_value_errors(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        Decoder(**{"hidden": np.zeros((6, 12)), "output": np.zeros((3, 6)), "activation": "none"} | change)
