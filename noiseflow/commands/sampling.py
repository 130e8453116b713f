"""The commands `noiseflow sample` and `noiseflow evaluate`."""

from __future__ import annotations

import warnings
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from noiseflow.commands.console import (
    DeviceOption,
    JsonOption,
    Output,
    OverwriteOption,
    SeedOption,
    choose_device,
    output_file,
)
from noiseflow.progress import progress_shown
from noiseflow.runs.outputs import Outputs

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from torch import Tensor, nn

    from noiseflow.models.base import NoiseModelBase

_DTYPES = ("auto", "float32", "float64", "uint8", "uint16", "int16")

ConditionOption = Annotated[
    list[str] | None,
    typer.Option("--condition", metavar="NAME=VALUE", help="Condition of the model, such as gain=4; repeatable."),
]


def sample(
    model: Annotated[Path, typer.Argument(help="Noise-model file (.safetensors).")],
    clean: Annotated[Path, typer.Argument(help="Clean image or stack, in the model's units.")],
    output: Annotated[Path, output_file("Noisy image to write (.tif, .mrc, .npy).")],
    overwrite: OverwriteOption = False,
    seed: SeedOption = 0,
    device: DeviceOption = "auto",
    dtype: Annotated[
        str,
        typer.Option(
            help="float32, float64, uint8, uint16, int16, or auto: the clean file's integer type, or else uint16, int16 or int32 "
            "of a model that rounds, where it holds the noisy values, else float32."
        ),
    ] = "auto",
    condition: ConditionOption = None,
    json: JsonOption = False,
) -> None:
    """Add realistic noise to a clean image, stack, or array with any number of axes (4D as .npy)."""
    import torch

    import noiseflow
    from noiseflow import io
    from noiseflow.models.wrapper import as_noise_model

    with Outputs(model, clean, overwrite=overwrite) as outputs:
        outputs.file(output)
        outputs.options(output)
        if dtype not in _DTYPES:
            raise ValueError(f"--dtype {dtype} is unknown; choose {', '.join(_DTYPES)}")
        data, voxel_size = _read_any(clean, output)
        io.require_finite(data, clean)
        noise_model = as_noise_model(_at(noiseflow.load(model), condition).to(choose_device(device)))
        pieces, drawn = _pieces(noise_model, _tensor(data)), list[torch.Tensor]()
        generator = torch.Generator(noise_model.device).manual_seed(seed)
        with progress_shown(json_mode=json) as progress:
            for piece in pieces:
                drawn.append(noise_model(piece.to(noise_model.device)).sample(generator=generator).cpu())
                progress("Sampling", len(drawn), len(pieces), "")
        noisy = torch.cat(drawn).reshape(data.shape)
        kept = stored(noisy.numpy(), dtype, data.dtype, noise_model)
        io.write(output, kept, voxel_size=voxel_size)
    out = Output(json)
    for note in (notes := _notes(noise_model, data)):
        out.line(f"note: {note}")
    mean = float(noisy.double().mean())
    out.line(f"wrote {output}: {' x '.join(map(str, noisy.shape))} {kept.dtype}, mean {mean:.6g}")
    result = {"output": str(output), "shape": list(noisy.shape), "dtype": str(kept.dtype), "mean": mean, "seed": seed}
    out.result(result | {"notes": notes})


def _pieces(noise_model: NoiseModelBase, signal: Tensor) -> list[Tensor]:
    """Split the pixels into parts of about a million; whole images if the model needs images, or neighbours correlate. Raises
    ValueError if the model needs images and the signal has fewer than two axes.
    """
    import torch

    from noiseflow.fitting.signal_models import PART
    from noiseflow.models.correlated import Correlated

    if not (noise_model.needs_image or any(isinstance(part, Correlated) for part in noise_model.modules())):
        return list(torch.split(signal.reshape(-1), PART))
    if signal.ndim < 2:
        raise ValueError(f"{type(noise_model).__name__} needs images; the clean file has one axis; give (y, x)")
    images = signal.reshape(-1, *signal.shape[-2:])
    return list(torch.split(images, max(1, PART // images[0].numel())))


def _read_any(path: Path, output: Path) -> tuple[NDArray[Any], Any]:
    """Read the values of a file and its voxel size. Any number of axes is allowed from one ``.npy`` file to another. Raises
    ValueError as `noiseflow.io.read`.
    """
    import numpy as np

    from noiseflow import io

    if path.suffix.lower() == output.suffix.lower() == ".npy" and path.is_file():
        try:
            data = np.load(path, mmap_mode="r", allow_pickle=False)
        except (ValueError, OSError, EOFError):  # a damaged file; io.read reports what is wrong
            data = None
        if data is not None and data.ndim > 3 and data.dtype.kind in "buif":
            return data, None
    image = io.read(path)
    return image.data, image.voxel_size


def stored(noisy: NDArray[np.float32], dtype: str, given: np.dtype[Any], noise_model: NoiseModelBase) -> NDArray[Any]:
    """Convert the noisy values to the requested data type. Raises ValueError if an integer type was requested and some values
    are not whole or out of its range.

    `auto` keeps the integer type of the clean file if it holds the values. Otherwise it takes the first of uint16, int16
    and int32 that holds them if the model rounds to whole numbers, and float32 if it does not.
    """
    import numpy as np

    if dtype in ("float32", "float64"):
        return noisy.astype(dtype)
    kind = given if dtype == "auto" else np.dtype(dtype)
    whole = bool((noisy == np.round(noisy)).all())
    rounds = noise_model.step > 0 and float(noise_model.step).is_integer()
    own = [np.dtype(one) for one in (np.uint16, np.int16, np.int32)] if dtype == "auto" and rounds else []
    for one in (kind, *own) if whole else ():
        if one.kind in "iu" and np.iinfo(one).min <= noisy.min() and noisy.max() <= np.iinfo(one).max:
            return noisy.astype(one)
    if dtype == "auto" or kind.kind not in "iu":
        return noisy.astype(np.float64) if kind == np.float64 else noisy
    raise ValueError(
        f"--dtype {dtype} cannot hold the noisy values, {noisy.min():g} … {noisy.max():g}"
        f"{'' if whole else ', which are not whole numbers'}; use --dtype float32, or a model that rounds and clips (Digitised)"
    )


def _notes(noise_model: NoiseModelBase, data: NDArray[Any], *, few: float = 0.01) -> list[str]:
    """Warnings about clean pixels outside the range of the model, of which few may lie beyond a limit because of noise alone."""
    from noiseflow.metrics.evaluation import num_outside, outside_in_words

    found = outside_in_words(num_outside(noise_model, data), data.size)
    for limit, beyond in ((noise_model.low, data < noise_model.low), (noise_model.high, data > noise_model.high)):
        share = float(beyond.mean())
        if share > few:
            found.append(
                f"{share:.0%} of the clean pixels lie beyond the clipping limit {limit:g} of the model, where its output is "
                f"constant; is the clean image in {noise_model.measured_in}?"
            )
    return found


def evaluate(
    model: Annotated[Path, typer.Argument(help="Noise-model file (.safetensors).")],
    signal: Annotated[list[Path], typer.Option("--signal", help="Clean image; repeat for each pair.")],
    observation: Annotated[list[Path], typer.Option("--observation", help="Noisy image of each pair.")],
    baselines: Annotated[
        bool,
        typer.Option("--baselines", help="Fit Gaussian and Poisson to half of the pixels; evaluate all on the rest."),
    ] = False,
    condition: ConditionOption = None,
    seed: SeedOption = 0,
    device: DeviceOption = "auto",
    json: JsonOption = False,
) -> None:
    """Evaluate a noise model on pairs of clean and noisy images: likelihood and divergences, each with its noise floor."""
    import torch

    import noiseflow
    from noiseflow import metrics
    from noiseflow.distributions.pixels import needs_image
    from noiseflow.metrics.spatial import spatial_structure
    from noiseflow.statistics import own_random

    out = Output(json)
    where = choose_device(device)
    models: dict[str, nn.Module] = {"model": _at(noiseflow.load(model), condition).to(where)}
    pairs = _read_pairs(signal, observation)
    sizes = {image.shape[-2:] if needs_image(models["model"]) else () for image, _ in pairs}
    if len(sizes) > 1:
        raise ValueError(f"the model needs images of one size, and these have {sorted(map(tuple, sizes))}; crop them")
    shape = (-1, *sizes.pop())
    clean, noisy = (
        torch.cat([each.reshape(shape) for each in images]).to(where) for images in zip(*pairs, strict=True)
    )
    if baselines:
        half = torch.from_numpy(own_random(seed).random(clean.shape) < 0.5).to(where)
        with progress_shown(json_mode=json) as progress:
            for baseline in (noiseflow.Gaussian().to(where), noiseflow.Poisson().to(where)):
                random = torch.Generator().manual_seed(seed)
                fitted = noiseflow.fit(baseline, clean[half], noisy[half], generator=random, progress=progress)
                models[type(baseline).__name__] = fitted.noise_model
        noisy = torch.where(half, torch.nan, noisy)
    count = len(models) + len(pairs)
    with progress_shown(json_mode=json) as progress, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the evaluation: printed below, with the name of the model
        results, structures = {}, []
        for name, item in models.items():
            results[name] = metrics.evaluate(item, clean, noisy, skip_non_finite=baselines, seed=seed)
            progress("Judging", len(results), count, name)
        for pair in pairs:
            structures.append(spatial_structure(models["model"], *(image.to(where) for image in pair)))
            progress("Judging", len(results) + len(structures), count, "neighbours")
    out.table(metrics.TABLE_HEADER, [metrics.table_row(name, result) for name, result in results.items()])
    of_scores = "the model needs images: all its figures but the likelihood are those of normal scores, pixel by pixel"
    for note in (notes := [*results["model"].notes, *([of_scores] * needs_image(models["model"]))]):
        out.line(f"note: {note}")
    for path, structure in zip(observation, structures, strict=True):
        out.line(f"{path}: {structure.in_words()}")
    out.result(
        {
            "models": {name: asdict(result) for name, result in results.items()},
            "num_pixels": results["model"].num_pixels,
            "notes": notes,
            "spatial": [asdict(structure) for structure in structures],
        }
    )


def _at(model: nn.Module, condition: list[str] | None) -> nn.Module:
    """The model at a condition given as NAME=VALUE."""
    from noiseflow.models.conditioned import Conditioned

    pairs = [each.partition("=") for each in condition or []]
    try:
        values = {name: float(value) for name, _, value in pairs}
    except ValueError as error:
        given = " ".join(condition or [])
        raise ValueError(f"--condition {given} is not NAME=VALUE with a number; give for example gain=4") from error
    if isinstance(model, Conditioned):
        return model.at(values)
    if values:
        raise ValueError(f"this model does not depend on {', '.join(values)}; leave --condition out")
    return model


def _read_pairs(signals: list[Path], observations: list[Path]) -> list[tuple[Tensor, Tensor]]:
    import numpy as np

    from noiseflow import io

    if len(signals) != len(observations):
        raise ValueError(f"{len(signals)} --signal and {len(observations)} --observation files; give both of each pair")
    pairs = []
    for paths in zip(signals, observations, strict=True):
        clean, noisy = (io.read(path).data for path in paths)
        for data, path in zip((clean, noisy), paths, strict=True):
            io.require_finite(data, path)
        if clean.shape != noisy.shape:
            raise ValueError(f"{paths[0]} is {clean.shape} and {paths[1]} is {noisy.shape}; a pair must have one shape")
        if np.array_equal(clean, noisy):
            raise ValueError(f"{paths[0]} and {paths[1]} hold equal pixels; give the noisy image as --observation")
        pairs.append((_tensor(clean), _tensor(noisy)))
    return pairs


def _tensor(data: Any) -> Tensor:
    import numpy as np
    import torch

    return torch.from_numpy(np.ascontiguousarray(data, dtype=np.float32))
