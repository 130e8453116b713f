"""Files that users and their disks have spoilt in every way; `make_bad_files` writes them all into one folder."""

from __future__ import annotations

import json
import os
import pickle
import struct
from pathlib import Path

import h5py
import numpy as np
import tifffile
import torch
from safetensors.torch import save_file

import noiseflow
from noiseflow import io

DATA = Path(__file__).parent.parent / "noiseflow" / "data"
SHAPE = (9, 24, 32)
ANGLES = np.linspace(-60, 60, SHAPE[0])


def make_good_files(folder: Path) -> None:
    """Small sound files, which the bad cases combine with one bad one."""
    rng = np.random.default_rng(0)
    stack = (1 + rng.random(SHAPE)).astype(np.float32)
    io.write(folder / "tilts.mrc", stack, voxel_size=(4.0, 4.0, 4.0))
    np.savetxt(folder / "tilts.rawtlt", ANGLES)
    io.write(folder / "alone.mrc", stack)
    io.write(folder / "clean.mrc", stack[0])
    io.write(folder / "small.mrc", stack[0, :9, :9])
    only = np.zeros_like(stack)
    only[4] = stack[4]
    np.save(folder / "one-tilt.npy", only)
    np.savetxt(folder / "one-tilt.rawtlt", ANGLES)
    noiseflow.save(noiseflow.Gaussian(0.1), folder / "model.safetensors")
    for name in ("channel1_050ms.tif", "channel1_long.tif"):
        image = tifffile.imread(DATA / "exposures_miro" / name)
        tifffile.imwrite(folder / name.removeprefix("channel1_"), image[:128, :128])


def make_bad_files(folder: Path) -> None:
    """Everything that is wrong."""
    _images(folder)
    _other_formats(folder)
    _models(folder)
    texts = {
        "words.tlt": "zero\none\n",
        "short.tlt": "0\n1\n",
        "unknown.tlt": "nan\n" * SHAPE[0],
        "huge.tlt": "1e400\n" * SHAPE[0],
        "far.tlt": "1e30\n" * SHAPE[0],
        "script.tlt": "".join(f"{angle}_0\n" for angle in range(SHAPE[0])),
        "same.tlt": "5\n" * SHAPE[0],
        "blank.tlt": "\n\n",
        "wrong.xf": "1 0 0 1\n",
        "short.xf": "1 0 0 1 0 0\n",
        "no.mdoc": "[ZValue = 0]\nExposure = 3\n",
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    (folder / "binary.tlt").write_bytes(bytes(range(256)))
    os.mkfifo(folder / "pipe")


def _images(folder: Path) -> None:
    rng = np.random.default_rng(1)
    stack = (1 + rng.random(SHAPE)).astype(np.float32)
    io.write(folder / "whole.mrc", stack)
    whole = (folder / "whole.mrc").read_bytes()
    (folder / "cut.mrc").write_bytes(whole[: len(whole) // 2])
    (folder / "stub.mrc").write_bytes(whole[:500])
    (folder / "text.mrc").write_bytes(b"dear diary, " * 400)
    (folder / "garbage.mrc").write_bytes(rng.bytes(5000))
    for name, values in {
        "absurd.mrc": (10_000, 10_000, 10_000, 2),
        "negative.mrc": (-4, 5, 6, 2),
        "zero.mrc": (0, 0, 0, 2),
        "complex.mrc": (4, 4, 4, 4),
        "mode99.mrc": (4, 4, 4, 99),
    }.items():
        (folder / name).write_bytes(struct.pack("<4i", *values) + whole[16:])
    extended = struct.pack("<i", 2**31 - 1)
    (folder / "extended.mrc").write_bytes(whole[:92] + extended + whole[96:])
    for name, value in {"nan": np.nan, "inf": np.inf}.items():
        spoilt = stack.copy()
        spoilt[3, 4, 5] = value
        np.save(folder / f"{name}.npy", spoilt)
        np.savetxt(folder / f"{name}.tlt", ANGLES)
        np.save(folder / f"{name}2d.npy", spoilt[3])
    np.save(folder / "flat.npy", np.ones(SHAPE, np.float32))
    np.savetxt(folder / "flat.tlt", ANGLES)
    np.save(folder / "flat2d.npy", np.ones((128, 128)))
    np.save(folder / "complex.npy", stack.astype(complex))
    np.save(folder / "words.npy", np.array([["a", "b"]]))
    np.save(folder / "objects.npy", np.array([[_Bomb(), 1]], dtype=object), allow_pickle=True)
    np.save(folder / "four.npy", np.zeros((2, 2, 2, 2)))
    np.save(folder / "nothing.npy", np.zeros((0, 5)))
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (10000, 10000, 10000), }\n"
    (folder / "absurd.npy").write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(100))
    (folder / "pickle.npy").write_bytes(pickle.dumps(_Bomb()))
    tifffile.imwrite(folder / "colour.tif", np.arange(12288).astype(np.uint8).reshape(64, 64, 3), photometric="rgb")
    tifffile.imwrite(folder / "whole.tif", rng.integers(0, 999, (128, 128)).astype(np.uint16))
    whole = (folder / "whole.tif").read_bytes()
    (folder / "cut.tif").write_bytes(whole[: len(whole) // 2])
    (folder / "text.tif").write_bytes(b"not a picture" * 90)
    (folder / "absurd.tif").write_bytes(whole)
    with tifffile.TiffFile(folder / "absurd.tif", mode="r+") as tiff:
        for tag in ("ImageWidth", "ImageLength"):
            tiff.pages.first.tags[tag].overwrite(1_000_000)
    saturated = np.full((128, 128), 65535, np.uint16)
    saturated[:40] = rng.integers(100, 200, (40, 128))
    tifffile.imwrite(folder / "saturated.tif", saturated)
    for name in ("empty.mrc", "empty.tif", "empty.npy", "empty.tlt", "empty.safetensors"):
        (folder / name).write_bytes(b"")
    (folder / "image.jpeg").write_bytes(b"x" * 100)
    (folder / "folder").mkdir()
    (folder / "uneven").mkdir()
    for number, width in enumerate((8, 9)):
        tifffile.imwrite(folder / "uneven" / f"{number}.tif", np.zeros((8, width), np.uint8))


def _other_formats(folder: Path) -> None:
    for suffix in ("dm3", "dm4", "emd", "ser", "emi", "hspy", "h5", "nxs"):
        (folder / f"text.{suffix}").write_bytes(b"not what the suffix says " * 100)
    with h5py.File(folder / "absurd.h5", "w") as file:
        file.create_dataset("a", (10_000, 10_000, 10_000), "f4", chunks=(1, 100, 100), compression="gzip")
    with h5py.File(folder / "void.h5", "w"):
        pass
    with h5py.File(folder / "twins.h5", "w") as file:
        file["a"] = file["b"] = np.zeros(SHAPE)
    (folder / "void.zarr").mkdir()


def _models(folder: Path) -> None:
    sound = noiseflow.save(noiseflow.Gaussian(0.1), folder / "sound.safetensors")
    whole = sound.read_bytes()
    (folder / "cut.safetensors").write_bytes(whole[:-3])
    (folder / "huge.safetensors").write_bytes(struct.pack("<Q", 2**60) + whole[8:])
    (folder / "long.safetensors").write_bytes(struct.pack("<Q", 90_000_000) + whole[8:])
    (folder / "pickle.safetensors").write_bytes(pickle.dumps(_Bomb()))
    torch.save({"a": torch.zeros(2)}, folder / "torch.safetensors")
    save_file({"a": torch.zeros(2)}, folder / "other.safetensors")
    deep: dict[str, object] = {"kind": "Gaussian", "arguments": {}}
    for _ in range(200):
        deep = {"kind": "Digitised", "arguments": {}, "models": {"model": deep}}
    sound_model = {"kind": "Gaussian", "arguments": {}}
    for name, changes in {
        "future": {"format_version": "2"},
        "unknown": {"model": {"kind": "Magic", "arguments": {}}},
        "system": {"model": {"kind": "os.system", "arguments": {"command": "true"}}},
        "arguments": {"model": {"kind": "Gaussian", "arguments": {"nonsense": 1}}},
        "list": {"model": [1, 2]},
        "deep": {"model": deep},
        "wide": {"model": {"kind": "RadialFlow", "arguments": {"num_layers": 10**9}}},
        "maps": {
            "model": {"kind": "WithMaps", "arguments": {"shape": [60_000, 60_000]}, "models": {"model": sound_model}}
        },
        "bins": {
            "model": {"kind": "SplineFlow", "arguments": dict.fromkeys(("num_bins", "width", "neighbourhood"), 1023)}
        },
        "broad": {
            "parameters": 0.1,
            "model": {"kind": "RadialFlow", "arguments": {"width": 100_000}},
            "padding": 200_000,
        },
        "mismatch": {"model": {"kind": "Mixture", "arguments": {}}},
        "spoilt": {"parameters": float("nan"), "model": sound_model},
    }.items():
        _write_model(folder / f"{name}.safetensors", **changes)


def _write_model(
    path: Path, *, parameters: float = 0.1, model: object = None, format_version: str = "1", padding: int = 0
) -> None:
    described = {"kind": "Gaussian", "arguments": {}} if model is None else model
    metadata = {"format": "noiseflow noise model", "format_version": format_version, "model": json.dumps(described)}
    tensors = {name: torch.full_like(value, parameters) for name, value in noiseflow.Gaussian().state_dict().items()}
    if padding:
        tensors["padding"] = torch.zeros(padding)
    save_file(tensors, path, metadata=metadata)


class _Bomb:
    """Fails the test process where anything unpickles it."""

    def __reduce__(self) -> tuple[object, ...]:
        return (exec, ("raise SystemExit('a pickle was opened')",))
