"""Noise-model files: safetensors with model type, units and provenance as JSON metadata. Loading runs no code from the file."""

import inspect
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from torch import nn

import noiseflow
from noiseflow.installation import library_version, load_plugins
from noiseflow.io import check_output
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.wrapper import as_noise_model
from noiseflow.runs.outputs import TENSORS
from noiseflow.runs.run_folder import save_tensors

FORMAT_VERSION = 1


Kind = TypeVar("Kind", bound=type[NoiseModelBase])
_REGISTERED: dict[str, type[NoiseModelBase]] = {}


def register(kind: Kind) -> Kind:
    """Register a noise-model class so that its models can be saved and loaded. Use it as a class decorator.

    A program that loads such a file must register the class before `load`, because files contain parameters and no code.

    Args:
        kind: a concrete subclass of `NoiseModelBase`; its ``config()`` returns the arguments that recreate the model.

    Raises:
        TypeError: the class is not a noise model, or is abstract.
        ValueError: another class has the same name.

    Example:
        >>> import noiseflow, pathlib, tempfile, torch
        >>> @noiseflow.register
        ... class FixedNoise(noiseflow.NoiseModelBase):
        ...     def forward(self, signal):
        ...         return torch.distributions.Normal(signal, torch.ones_like(signal))
        ...     def config(self):
        ...         return {}
        >>> path = noiseflow.save(FixedNoise(), pathlib.Path(tempfile.mkdtemp()) / "fixed.safetensors")
        >>> type(noiseflow.load(path)).__name__
        'FixedNoise'
    """
    if not _is_model(kind):
        raise TypeError(f"{kind!r} is not a noise-model class; derive it from NoiseModelBase and define forward()")
    taken = kinds().get(kind.__name__)
    if taken is not None and (taken.__module__, taken.__qualname__) != (kind.__module__, kind.__qualname__):
        raise ValueError(f"{taken.__module__}.{taken.__qualname__} has the name {kind.__name__}; rename the class")
    _REGISTERED[kind.__name__] = kind
    return kind


def kinds() -> dict[str, type[nn.Module]]:
    """All noise-model classes that a file may name: public classes of this package, registered classes, and those of installed
    packages (entry points ``noiseflow.noise_models``)."""
    own = {name: kind for name in dir(noiseflow) if _is_model(kind := getattr(noiseflow, name))}
    return own | _REGISTERED | load_plugins("noiseflow.noise_models")


def _is_model(kind: Any) -> bool:
    return inspect.isclass(kind) and issubclass(kind, NoiseModelBase) and not inspect.isabstract(kind)


def save(
    model: nn.Module, path: str | Path, *, units: str | None = None, provenance: Mapping[str, Any] | None = None
) -> Path:
    """Save a noise model.

    Args:
        model: any model whose class is in `kinds`, on any device.
        path: target, ``.safetensors``.
        units: units of signal and observation; by default those of the model. `load` restores them.
        provenance: origin of the model, any JSON-serialisable mapping.

    Raises:
        ValueError: the class of the model is unknown, or the path cannot be written.

    Example:
        >>> import noiseflow, pathlib, tempfile
        >>> camera = noiseflow.PoissonGaussian(gain=2.0)
        >>> path = noiseflow.save(camera, pathlib.Path(tempfile.mkdtemp()) / "camera.safetensors", units="counts")
        >>> type(noiseflow.load(path)).__name__
        'PoissonGaussian'
    """
    path = check_output(path, suffixes=TENSORS)
    metadata = {
        "format": "noiseflow noise model",
        "format_version": str(FORMAT_VERSION),
        "library_version": library_version(),
        "model": json.dumps(_describe(model)),
        "units": units or str(getattr(model, "measured_in", "detector units")),
        "provenance": json.dumps(dict(provenance or {}), default=str),
        "fitted_range": json.dumps(as_noise_model(model).fitted_range),
    }
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()}
    save_tensors(path, tensors, metadata)
    return path


def load(path: str | Path) -> nn.Module:
    """Load a noise model, ready to use on the CPU.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is not a noise-model file, is damaged, names an unknown class, or is from a newer version of the
            library.

    Example:
        >>> import noiseflow, pathlib, tempfile
        >>> path = noiseflow.save(noiseflow.Gaussian(3.0), pathlib.Path(tempfile.mkdtemp()) / "camera.safetensors")
        >>> type(noiseflow.load(path)).__name__
        'Gaussian'
    """
    metadata, tensors = _open(Path(path))
    try:
        description = json.loads(metadata["model"])
        _check_sizes(description, sum(tensor.nbytes for tensor in tensors.values()))
        with torch.device("meta"):  # allocates no memory, whatever sizes the description claims
            _check_parameters(_build(description), tensors)
        model = _build(description)
        _check_parameters(model, tensors)
        model.load_state_dict(tensors, assign=True)  # in the precision that was saved
        fitted = tuple(map(float, json.loads(metadata.get("fitted_range", "null")) or ()))
    except (KeyError, TypeError, json.JSONDecodeError, AttributeError, OverflowError, RuntimeError) as error:
        raise ValueError(f"{path}: the model's description is damaged ({type(error).__name__}: {error})") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if any(not torch.isfinite(tensor).all() for tensor in tensors.values()):
        raise ValueError(f"{path}: some parameters are NaN or infinite; fit and save the model again")
    if fitted:
        model.fitted_range = fitted  # type: ignore[assignment]
    if metadata.get("units"):
        model.measured_in = metadata["units"]  # type: ignore[assignment]
    return model.eval()


def _check_parameters(model: nn.Module, found: Mapping[str, torch.Tensor]) -> None:
    expected = model.state_dict()
    common = set(expected) & set(found)
    unlike = {name for name in common if expected[name].shape != found[name].shape}
    wrong = sorted(set(expected) ^ set(found) | unlike)
    if wrong:
        names = ", ".join(name[-40:] for name in wrong[:3])
        raise ValueError(f"parameters do not fit a {type(model).__name__}: {names}; fit and save the model again")


def _check_sizes(
    description: Mapping[str, Any], num_bytes: int, *, depth: int = 0, deepest: int = 4, usual: int = 1024
) -> None:
    """Raise ValueError for descriptions that would waste memory or time: sizes larger than `usual` and than the stored parameters
    allow, and deeply nested models."""
    inner = description.get("models", {})
    if depth > deepest or len(inner) > deepest:
        raise ValueError("the description nests too many models; fit and save the model again")
    largest = max(_whole_numbers(description["arguments"]), default=0)
    # a bin, level or pixel of a model has at least one number in single precision
    if largest > max(num_bytes // torch.float32.itemsize, usual):
        raise ValueError(f"a size of {largest} with only {num_bytes} bytes of parameters; fit and save the model again")
    for child in inner.values():
        _check_sizes(child, num_bytes, depth=depth + 1)


def _whole_numbers(value: Any) -> Iterator[int]:
    """Absolute values of all integers in nested values."""
    if isinstance(value, int):
        yield abs(value)
    elif isinstance(value, (list, dict)):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _whole_numbers(item)


def _open(path: Path) -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; make a noise model with: noiseflow calibrate")
    if path.is_dir():
        raise ValueError(f"{path} is a folder; give the noise-model file inside it")
    if not path.is_file():  # reading a pipe could block forever
        raise ValueError(f"{path} is not a regular file; a noise model cannot be read from a pipe or a device")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = dict(file.metadata() or {})
            if metadata.get("format") != "noiseflow noise model":
                raise ValueError(f"{path} is not a noiseflow noise model; make one with: noiseflow calibrate")
            found = metadata.get("format_version", "")
            if not found.isdigit() or int(found) > FORMAT_VERSION:
                raise ValueError(f"{path} has format {found!r}, newer than {FORMAT_VERSION}; update noiseflow")
            return metadata, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{path} is not a noise-model file, or is damaged ({error})") from error


def _describe(model: nn.Module) -> dict[str, Any]:
    kind = type(model).__name__
    if kinds().get(kind) is not type(model):
        raise ValueError(f"{kind} is no known noise model; decorate it with @noiseflow.register, or add an entry point")
    inner = {name: _describe(child) for name, child in model.named_children() if type(child).__name__ in kinds()}
    return {"kind": kind, "arguments": model.config(), "models": inner}  # type: ignore[operator]


def _build(description: Mapping[str, Any]) -> nn.Module:
    known = kinds()
    if description["kind"] not in known:
        raise ValueError(f"unknown noise model {description['kind']!r}; import it (known: {', '.join(sorted(known))})")
    inner = {name: _build(child) for name, child in description.get("models", {}).items()}
    return known[description["kind"]](**description["arguments"], **inner)
